"""Scripted ways to earn a reward: doing the task, farming the reward, moves at random."""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv
from coop_env.simulation import batch, task
from coop_env.simulation.observation import make_observation
from coop_env.simulation.state import OUTCOME

Moves = list[int]
SCRIPTS: Final = ("insert", "insert one", "farm", "oscillate", "random")
DETOUR: Final = 2


class Simulator:
    """Moves copies of a state with the environment's own kernel, geometry and reward."""

    def __init__(self, env: CoopInsertionEnv) -> None:
        self._packed = task.pack(env.params)
        self._transform, _ = make_observation("paper", True, env.params)

    def step(self, states: NDArray[np.void], actions: NDArray[np.int64]) -> NDArray[np.void]:
        """Move states (n,) in place; their outcomes (n,)."""
        outcomes = np.zeros(len(states), OUTCOME)
        rows = np.zeros((len(states), self._transform.shape[1]), np.float32)
        batch.step_batch(states, actions, self._packed, self._transform, outcomes, rows)
        return outcomes

    def paid(self, states: NDArray[np.void], actions: NDArray[np.int64]) -> NDArray[np.float64]:
        """Reward (n,) of each move; -inf if it is refused, inserts or ends the episode."""
        outcome = self.step(states, actions)
        barred = outcome["violation"] | outcome["inserted"] | outcome["terminated"]
        return np.where(barred, -np.inf, outcome["reward"])

    def best_cycle(self, state: NDArray[np.void]) -> tuple[float, int]:
        """The largest reward of a move and its reverse at a state (1,), and that move."""
        actions = np.arange(task.N_ACTIONS)
        states = np.repeat(state, task.N_ACTIONS)
        paid = self.paid(states, actions) + self.paid(states, actions ^ 1)
        best = int(np.argmax(paid))
        return float(paid[best]), best

    def around(
        self, start: np.void, way: Moves, detour: int
    ) -> Iterator[tuple[Moves, NDArray[np.void]]]:
        """States (1,) up to ``detour`` moves off a way, each once, and the moves to get there."""
        front: list[tuple[Moves, NDArray[np.void]]] = [([], np.array([start]))]
        for move in way:
            moves, state = front[-1]
            ahead = state.copy()
            self.step(ahead, np.array([move]))
            front.append(([*moves, move], ahead))
        seen: set[bytes] = set()
        for depth in range(detour + 1):
            new = []
            for moves, state in front:
                key = state["offset"].tobytes()
                if key not in seen:
                    seen.add(key)
                    yield moves, state
                    new.append((moves, state))
            if depth == detour:
                return
            front = []
            for moves, state in new:
                ahead = np.repeat(state, task.N_ACTIONS)
                made = np.isfinite(self.paid(ahead, np.arange(task.N_ACTIONS)))
                front += [([*moves, a], ahead[a : a + 1]) for a in np.flatnonzero(made).tolist()]

    def play(self, state: NDArray[np.void], moves: Sequence[int]) -> NDArray[np.void]:
        """Outcomes of moves one after another, up to the episode's end; the state is moved."""
        outcomes = []
        for move in moves:
            outcome = self.step(state, np.array([move]))
            outcomes.append(outcome)
            if outcome["terminated"][0] or outcome["truncated"][0]:
                break
        return np.concatenate(outcomes)


def moves_of(
    script: str, env: CoopInsertionEnv, simulator: Simulator, plans: list[Moves], seed: int
) -> Moves:
    """The moves of a script from the environment's state, at most as many as an episode has."""
    length = int(env.params.task.max_moves)
    if script == "insert":
        return [move for plan in plans for move in plan]
    if script == "insert one":
        return plans[0] if plans else []
    if script == "random":
        return random_moves(env, simulator, length, seed)
    # the last move of a plan would insert
    way = plans[0][:-1] if plans and script == "farm" else []
    options = []
    for prefix, state in simulator.around(env.state, way, DETOUR if script == "farm" else 0):
        paid, cycle = simulator.best_cycle(state)
        options.append((paid * (length - len(prefix)), prefix, cycle))
    _, prefix, cycle = max(options, key=lambda option: option[0])
    left = length - len(prefix)
    return prefix + [cycle, cycle ^ 1] * (left // 2) + [cycle] * (left % 2)


def random_moves(env: CoopInsertionEnv, simulator: Simulator, length: int, seed: int) -> Moves:
    """Moves drawn evenly from the masks."""
    rng = np.random.default_rng(seed)
    state = np.array([env.state])
    moves: Moves = []
    while len(moves) < length:
        moves.append(int(rng.choice(np.flatnonzero(state[0]["mask"]))))
        outcome = simulator.step(state, np.array(moves[-1:]))
        if outcome["terminated"][0]:
            break
    return moves
