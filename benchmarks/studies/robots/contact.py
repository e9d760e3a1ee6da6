"""Scripts on the contact task: success, time and force over the hole's error.

    python -m benchmarks study contact

Each script's gains are the best of a grid on validation episodes of each level, by success and then
by time, with errors up to 3 mm. The tests have errors of fixed size to any side, or as the task
draws them, tilts up to a degree, and friction as the task draws it. Last, a search inserts with
other timesteps, contacts and play, and a film is drawn.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np

from benchmarks.reporting.stats import wilson
from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Measured, Part, Tick, count, episode, source
from benchmarks.studies.robots import trials
from benchmarks.studies.robots.trials import CONDITIONS, TRAINED, WHAT, Row, play

LEVELS: Final = ("easy", "standard", "hard")
SENSITIVE: Final = ("standard", "hard")  # a round tip finds its hole anyway
SEARCH: Final = "moment-guided search"
VARIANTS: Final[dict[str, Row]] = {
    "timestep 2 ms, contact 5 ms, no play: the task": {},
    "timestep 1 ms": {"timestep": 0.001},
    "timestep 1 ms, contact 2.5 ms": {"timestep": 0.001, "contact_time": 0.0025},
    "contact 10 ms": {"contact_time": 0.010},
    "contact 20 ms": {"contact_time": 0.020},
    "play of 0.5 degrees": {"effector_play": math.radians(0.5)},
}
"""What the simulation assumes, varied: fields of the task."""
PRESSED: Final = 20.0  # N


def make(level: str, *, servos: Any = None, **fields: Any) -> Any:
    """The environment of a level, with other fields of its task."""
    from coop_env.physics.env import CoopInsertionContactEnv
    from coop_env.physics.task import resolve_task

    return CoopInsertionContactEnv(replace(resolve_task(level), **fields), servos=servos)


def choose(env: Any, name: str, episodes: int) -> dict[str, float]:
    """A script's gains for a level: most successes on validation episodes, then the least time."""
    from benchmarks.methods.contact_scripts import GRIDS, SCRIPTS, Gains

    grid = GRIDS[name]
    options = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]

    def score(gains: dict[str, float]) -> tuple[float, float]:
        result = play(env, SCRIPTS[name](env, Gains(**gains)), "validate", episodes)
        return float(np.mean(result["success"])), -float(np.mean(result["time"]))

    return max(options, key=score)


def measure(level: str, episodes: int, tick: Tick) -> Row:
    """All scripts of a level: their gains and their test episodes."""
    from benchmarks.methods.contact_scripts import SCRIPTS, Gains

    env, result = make(level), {}
    for done, (name, kind) in enumerate(SCRIPTS.items()):
        gains = choose(env, name, episodes)
        tick((done + 0.5) / len(SCRIPTS))
        script = kind(env, Gains(**gains))
        result[name] = {
            "gains": gains,
            "errors": [play(env, script, "test", episodes, error) for error in CONDITIONS],
        }
        tick((done + 1) / len(SCRIPTS))
    return result


def sensitivity(level: str, gains: Row, episodes: int, tick: Tick) -> list[Row]:
    """The search, as its gains were chosen, under each of :data:`VARIANTS`."""
    from benchmarks.methods.contact_scripts import SCRIPTS, Gains

    rows = []
    for variant, fields in VARIANTS.items():
        env = make(level, **fields)
        result = play(env, SCRIPTS[SEARCH](env, Gains(**gains)), "test", episodes)
        rows.append({"variant": variant, "yields": yields(level, fields), **result})
        tick(len(rows) / len(VARIANTS))
    return rows


def yields(level: str, fields: Row) -> float:
    """How far a peg sinks into a hole's flat rim until :data:`PRESSED` N are met, m."""
    from coop_env.physics.model import Servos

    servos = Servos(delta_stiffness=1000.0)
    env = make(level, servos=servos, **fields, force_limit=PRESSED, max_steps=1000)
    start = {"hole": 4, "error": [0.003, 0.0, 0.0, 0.0], "friction": 0.4}
    deque(episode(env, lambda _: [0.0, 0.0, -0.1, 0.0, 0.0, 0.0], seed=0, options=start), 0)
    return -float(min(env.batch.twin.inspect(0)[1].contact.dist, default=0.0))


def varied(parts: Row) -> str:
    """The table of what the simulation assumes."""
    return plain(
        f"What the simulation assumes, varied: {SEARCH}, errors to {TRAINED:g} mm",
        f"level | variant | {WHAT} | largest peak (N) | rim yields at {PRESSED:g} N (mm)",
        [
            [
                *(level, row["variant"], trials.in_cell(row)),
                *(f"{max(row['force']):.1f}", f"{1e3 * row['yields']:.3f}"),
            ]
            for level in SENSITIVE
            for row in parts.get(f"{level}, varied", [])
            if row.get("script", SEARCH) == SEARCH  # older files have others, too
        ],
    )


class Contact(Measured):
    """Scripts that insert in contact."""

    name, file, needs = "contact", "contact/scripts.json", ("mujoco", "physics")
    options = {"--episodes": count(trials.EPISODES, "episodes of each cell", 2)}  # noqa: RUF012

    def asked(self) -> dict[str, Any]:
        from benchmarks.methods.contact_scripts import Gains

        return super().asked() | {"defaults": asdict(Gains())}

    def measures(self) -> dict[str, Part]:
        n, kept = self.given.episodes, self.result["parts"]
        return {
            **{level: partial(measure, level, n) for level in LEVELS},
            **{
                f"{level}, varied": lambda tick, of=level: sensitivity(
                    of, kept[of][SEARCH]["gains"], n, tick
                )  # type: ignore[misc]
                for level in SENSITIVE
            },
        }

    def finish(self) -> None:
        from benchmarks.studies.robots.film import write_film

        script = self.result["parts"]["standard"].get(SEARCH, {"gains": {}})
        write_film(self.folder / "insertion.gif", script["gains"])

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        n = result["asked"]["episodes"]
        scripts = [(level, *each) for level in LEVELS for each in result["parts"][level].items()]
        low, high = (100.0 * share for share in wilson(n, n))
        chosen = "; ".join(
            f"{level}, {name}: {', '.join(f'{k} {v:g}' for k, v in one['gains'].items())}"
            for level, name, one in scripts
            if one["gains"]
        )
        table = plain(
            f"Scripts over the hole's displacement: {WHAT}",
            " | ".join(["level", "script", *map(trials.shown, CONDITIONS), "failures"]),
            [
                [level, name, *map(trials.in_cell, one["errors"]), trials.causes(one["errors"])]
                for level, name, one in scripts
            ],
        )
        note = (
            f"{n} episodes a cell (all of them successful: {low:.0f} to {high:.0f} %, "
            f"95 % interval); to {TRAINED:g} mm errors are as the task draws them. "
            f"Gains chosen: {chosen}. {source(result)}"
        )
        return "\n\n".join([table, varied(result["parts"]), note])
