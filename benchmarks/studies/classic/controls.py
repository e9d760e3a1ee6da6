"""Controls of the public tasks, without learning: random, one action, a script of a few lines.

A script sees what a learner sees, one observation at a time, and has no memory. MinAtar's are
written by hand and greedy: they look one move ahead and know how the game's objects move. Our own
were written on seeds from 1000 on, like Rainbow's settings.
"""

from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.protocol.plan import SCRIPTED

Image = NDArray[np.uint8]  # (channels, 10, 10), of MinAtar
Script = Callable[[Any], int]
#: actions for a batch of observations (n, ...) and its masks (n, actions), None where all may be
Act = Callable[[Any, Any], NDArray[Any]]

LAST: Final = 9  # the last row, and column, of a MinAtar game
UNSAFE: Final = 100.0  # more than any distance


def at_random(n: int, seed: int) -> Act:
    """Draws evenly from the allowed ones of ``n`` actions."""
    rng = np.random.default_rng(seed)

    def act(batch: NDArray[Any], masks: NDArray[np.bool_] | None) -> NDArray[Any]:
        allowed = np.ones((len(batch), n)) if masks is None else masks
        return (allowed * rng.random(allowed.shape)).argmax(axis=1)

    return act


def held(action: int) -> Act:
    """The same action all the time."""
    return lambda batch, _: np.full(len(batch), action)


def scripted(name: str) -> Act:
    """The script of an environment."""
    script = SCRIPTS[name]
    return lambda batch, _: np.array([script(each) for each in batch])


def _cart_pole(state: NDArray[np.float32]) -> int:
    """Push to where the pole falls."""
    _, _, angle, speed = state
    return int(3.0 * angle + speed > 0.0)


def _mountain_car(state: NDArray[np.float32]) -> int:
    """Push right while position and speed lie between parabolas, else left.

    The bounds are Zhiqing Xiao's
    (https://zhiqingxiao.github.io/rl-book/html/MountainCar-v0_ClosedForm.html).
    """
    position, speed = state
    low = min(0.03 - 0.09 * (position + 0.25) ** 2, 0.3 * (position + 0.9) ** 4 - 0.008)
    return 2 if low <= speed <= 0.07 - 0.07 * (position + 0.38) ** 2 else 0


def _acrobot(state: NDArray[np.float32]) -> int:
    """Turn the joint the way it turns already, against the first link: energy is added."""
    *_, first, second = state
    return 2 if second > first else 0


def _lunar_lander(state: NDArray[np.float32]) -> int:
    """Gymnasium's own heuristic, which asks its environment for the kind of action alone."""
    from gymnasium.envs.box2d.lunar_lander import heuristic

    return int(heuristic(SimpleNamespace(unwrapped=SimpleNamespace(continuous=False)), state))


def _at(image: Image, *channels: int) -> list[tuple[int, int]]:
    """Row and column of all that these channels show."""
    return [(int(y), int(x)) for channel in channels for y, x in np.argwhere(image[channel])]


def _heading(image: Image, trail: int, y: int, x: int) -> int:
    """1 for an object that goes right, else -1: its trail is behind it, at first off the edge."""
    return 1 if (image[trail, y, x - 1] if x > 0 else not image[trail, y, 1]) else -1


def _breakout(image: Image) -> int:
    """Go to where the ball comes down."""
    (_, paddle), (y, x), (last_y, last_x) = _at(image, 0, 1, 2)
    right, down = x - last_x, y > last_y or (y == last_y and y < LAST - 1)
    if right == 0:  # off a wall, or the first frame
        right = 1 if x == 0 else -1
    for _ in range(LAST - y if down else 0):
        if 0 <= x + right <= LAST:
            x += right
        else:
            right = -right
    return 0 if x == paddle else 1 if x < paddle else 2


def _freeway(image: Image) -> int:
    """Up if no car comes there within three frames; else stay or go back if none does, else up."""
    ((row, _),) = _at(image, 0)

    def safe(y: int) -> bool:
        return all(frames > 3 for frames in _arrivals(image, y))

    return 1 if safe(row - 1) else 0 if safe(row) else 2 if safe(row + 1) else 1


def _arrivals(image: Image, row: int) -> Iterator[int]:
    """Fewest frames until each car of a row is in the chicken's column; 0 if it is there."""
    for x in np.flatnonzero(image[1, row]).tolist() if row <= LAST else ():
        for pace in range(1, 6):  # a car moves once in pace + 1 frames
            for heading in (1, -1):
                if image[1 + pace, row, (x - heading) % 10]:
                    gap = (4 - x) * heading % 10
                    yield 0 if gap == 0 else (gap - 1) * (pace + 1) + 1


def _moved(y: int, x: int, move: int, top: int) -> tuple[int, int]:
    """Where one of "n", left, up, right, down leads in Asterix and Seaquest."""
    down, right = ((0, 0), (0, -1), (-1, 0), (0, 1), (1, 0))[move]
    return min(max(y + down, top), LAST - 1), min(max(x + right, 0), LAST)


def _nearest(place: tuple[int, int], goals: list[tuple[int, int]]) -> int:
    return min(abs(place[0] - y) + abs(place[1] - x) for y, x in goals)


def _asterix(image: Image) -> int:
    """Towards the nearest treasure, or the middle, and out of the way of enemies."""
    ((y, x),) = _at(image, 0)
    goals = _at(image, 3) or [(5, 5)]

    def cost(move: int) -> float:
        place = _moved(y, x, move, 1)
        result = float(_nearest(place, goals))
        for row, column in _at(image, 1):
            gap = (place[1] - column) * _heading(image, 2, row, column)
            if row == place[0] and 0 <= gap <= 2:
                result += UNSAFE if gap < 2 else UNSAFE / 20.0
        return result

    return min(range(5), key=cost)


def _space_invaders(image: Image) -> int:
    """Fire below an alien, go to the nearest one's column, and not under a bullet or an alien."""
    ((_, x),) = _at(image, 0)
    columns = np.flatnonzero(image[1].any(axis=0))

    def cost(action: int) -> float:
        column = min(max(x + {1: -1, 2: 1}.get(action, 0), 0), LAST)
        near = image[[5, 5, 5, 1], [8, 7, 6, 8], column] > 0
        away = min(np.abs(columns - column), default=0)
        return float(near @ (UNSAFE, UNSAFE / 2.0, UNSAFE / 10.0, UNSAFE)) + away

    return min((3, 1, 2), key=cost)


def _seaquest(image: Image) -> int:
    """Fire at an enemy ahead; else to divers, to enemies' rows, and up with some when short of air.

    Surfacing without a diver ends the game.
    """
    ((y, x),) = _at(image, 0)
    ahead = -1 if image[1, y, min(x + 1, LAST)] else 1
    enemies, divers = _at(image, 5, 6), _at(image, 9)
    air, aboard = np.count_nonzero(image[7]), np.count_nonzero(image[8])
    rising = aboard == 6 or (aboard > 0 and air <= 2)
    bullet_near = any(row == y and abs(column - x) <= 1 for row, column in _at(image, 4))
    ahead_there = any(row == y and (column - x) * ahead > 0 for row, column in enemies)
    if ahead_there and not bullet_near and not rising and y > 0:
        return 5
    goals = [(0, x)] if rising else divers if divers and aboard < 6 else []
    goals = goals or [(row, x) for row, _ in enemies] or [(5, 5)]

    def cost(move: int) -> float:
        place = _moved(y, x, move, 0)
        if place[0] == 0 < y and not aboard:
            return 10.0 * UNSAFE
        return _danger(image, place, enemies) + _nearest(place, goals)

    return min(range(5), key=cost)


def _danger(image: Image, place: tuple[int, int], enemies: list[tuple[int, int]]) -> float:
    """Cost of a place in Seaquest: full if something is about to hit it, half if beside it."""
    gaps = [x - place[1] for y, x in enemies if y == place[0]]
    coming = [-gap * _heading(image, 3, place[0], place[1] + gap) for gap in gaps]
    bullets = [abs(x - place[1]) for y, x in _at(image, 4) if y == place[0]]
    if any(0 <= gap <= 1 for gap in coming) or any(gap <= 2 for gap in bullets):
        return UNSAFE
    return UNSAFE / 2.0 if any(abs(gap) <= 1 for gap in gaps) else 0.0


SCRIPTS: Final[dict[str, Script]] = dict(zip(SCRIPTED, (
    *(_cart_pole, _acrobot, _mountain_car, _lunar_lander),
    *(_asterix, _breakout, _freeway, _seaquest, _space_invaders),
), strict=True))  # fmt: skip
