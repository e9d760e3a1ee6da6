"""Scripts on the contact task: success, time and force over the hole's error and over friction.

    python -m benchmarks study contact

Each script's gains are the best of a grid on validation episodes of each level, by success and then
by time, with errors up to 3 mm. The tests have errors of fixed size to any side, or as the task
draws them, tilts up to a degree, and friction as the task draws it, or errors of 3 mm and fixed
friction. Last, both searches insert with other timesteps, contacts and play, and a film is drawn.
"""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from benchmarks.errors import at_least
from benchmarks.reporting.stats import wilson
from benchmarks.reporting.tables.table import plain
from benchmarks.studies.base import Measured, Part, Tick, source
from benchmarks.studies.robots.trials import (
    CONDITIONS,
    EPISODES,
    FRICTIONS,
    TRAINED,
    Row,
    causes,
    in_cell,
    play,
    shown,
)

LEVELS: Final = ("easy", "standard", "hard")
SENSITIVE: Final = ("standard", "hard")  # a round tip finds its hole anyway
SEARCHES: Final = ("moment-guided search", "spiral search")
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


def choose(level: str, name: str, episodes: int) -> dict[str, float]:
    """A script's gains for a level: most successes on validation episodes, then the least time."""
    from benchmarks.methods.contact_scripts import GRIDS, SCRIPTS, Gains
    from coop_env.physics.env import CoopInsertionContactEnv

    env, grid = CoopInsertionContactEnv(level), GRIDS[name]
    best: tuple[tuple[float, float], Gains] | None = None
    for values in itertools.product(*grid.values()):
        gains = replace(Gains(), **dict(zip(grid, values, strict=True)))
        result = play(env, SCRIPTS[name](env, gains), "validate", episodes)
        score = (float(np.mean(result["success"])), -float(np.mean(result["time"])))
        if best is None or score > best[0]:
            best = score, gains
    assert best is not None  # of an empty grid there is one choice
    return {key: getattr(best[1], key) for key in grid}


def measure(level: str, episodes: int, tick: Tick) -> Row:
    """All scripts of a level: their gains and their test episodes."""
    from benchmarks.methods.contact_scripts import SCRIPTS, Gains
    from coop_env.physics.env import CoopInsertionContactEnv

    env = CoopInsertionContactEnv(level)
    result: Row = {}
    for done, (name, make) in enumerate(SCRIPTS.items()):
        gains = choose(level, name, episodes)
        tick((done + 0.5) / len(SCRIPTS))
        script = make(env, replace(Gains(), **gains))
        result[name] = {
            "gains": gains,
            "errors": [play(env, script, "test", episodes, error) for error in CONDITIONS],
            "frictions": [play(env, script, "test", episodes, TRAINED, f) for f in FRICTIONS],
        }
        tick((done + 1) / len(SCRIPTS))
    return result


def sensitivity(level: str, scripts: Row, episodes: int, tick: Tick) -> list[Row]:
    """The searches, as their gains were chosen, under each of :data:`VARIANTS`."""
    from benchmarks.methods.contact_scripts import SCRIPTS, Gains
    from coop_env.physics.env import CoopInsertionContactEnv
    from coop_env.physics.task import resolve_task

    rows = []
    for variant, fields in VARIANTS.items():
        env = CoopInsertionContactEnv(replace(resolve_task(level), **fields))
        for name in (name for name in SEARCHES if name in scripts):
            script = SCRIPTS[name](env, Gains(**scripts[name]["gains"]))
            row = {"variant": variant, "script": name, "yields": yields(level, fields)}
            rows.append(row | play(env, script, "test", episodes))
        tick(len(rows) / (len(VARIANTS) * len(SEARCHES)))
    return rows


def yields(level: str, fields: Row) -> float:
    """How far a peg sinks into a hole's flat rim until :data:`PRESSED` N are met, m."""
    from coop_env.physics.env import CoopInsertionContactEnv
    from coop_env.physics.model import Servos
    from coop_env.physics.task import resolve_task

    task = replace(resolve_task(level), **fields, force_limit=PRESSED, max_steps=1000)
    env = CoopInsertionContactEnv(task, servos=Servos(delta_stiffness=1000.0))
    env.reset(seed=0, options={"hole": 4, "error": [0.003, 0.0, 0.0, 0.0], "friction": 0.4})
    over = False
    while not over:
        *_, terminated, truncated, _ = env.step([0.0, 0.0, -0.1, 0.0, 0.0, 0.0])
        over = terminated or truncated
    return -float(min(env.batch.twin.inspect(0)[1].contact.dist, default=0.0))


def _tables(parts: Mapping[str, Any]) -> Iterator[str]:
    what = "success (%) / median time of successes (s) / median peak force (N)"
    for level in (level for level in LEVELS if level in parts):
        yield plain(
            f"Scripts, level `{level}`, over the hole's displacement: {what}",
            "script | " + " | ".join(map(shown, CONDITIONS)) + " | failures",
            [
                [name, *map(in_cell, one["errors"]), causes(one["errors"])]
                for name, one in parts[level].items()
            ],
        )
    yield plain(
        f"Scripts, level `standard`, {TRAINED:g} mm, over friction: {what}",
        "script | " + " | ".join(f"{f:g}" for f in FRICTIONS),
        [
            [name, *map(in_cell, one["frictions"])]
            for name, one in parts.get("standard", {}).items()
        ],
    )


def _varied(parts: Mapping[str, Any]) -> str:
    return plain(
        f"What the simulation assumes, varied: {SEARCHES[0]}, errors to {TRAINED:g} mm",
        "level | variant | success (%) / median time (s) / median peak force (N) | "
        f"largest peak (N) | rim yields at {PRESSED:g} N (mm)",
        [
            [level, row["variant"], in_cell(row), f"{max(row['force']):.1f}",
             f"{1e3 * row['yields']:.3f}"]
            for level in SENSITIVE
            for row in parts.get(f"{level}, varied", [])
            if row["script"] == SEARCHES[0]
        ],
    )  # fmt: skip


class Contact(Measured):
    """Scripts that insert in contact."""

    name, file, needs = "contact", "contact/scripts.json", ("mujoco", "physics")
    options = {  # noqa: RUF012
        "--episodes": {"type": at_least(2), "default": EPISODES, "help": "episodes of each cell"},
    }

    def asked(self) -> dict[str, Any]:
        from benchmarks.methods.contact_scripts import Gains

        return super().asked() | {"defaults": asdict(Gains())}

    def measures(self) -> dict[str, Part]:
        n, kept = self.given.episodes, self.result["parts"]
        return {
            **{level: partial(measure, level, n) for level in LEVELS},
            **{
                f"{level}, varied": lambda tick, of=level: sensitivity(of, kept[of], n, tick)  # type: ignore[misc]
                for level in SENSITIVE
            },
        }

    def finish(self) -> None:
        from benchmarks.methods.contact_scripts import Gains
        from benchmarks.studies.robots.film import write_film

        script = self.result["parts"]["standard"].get("moment-guided search", {"gains": {}})
        write_film(self.folder, replace(Gains(), **script["gains"]))

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        parts, n = result["parts"], result["asked"]["episodes"]
        low, high = (100.0 * share for share in wilson(n, n))
        chosen = "; ".join(
            f"{level}, {name}: "
            + ", ".join(f"{key} {value:g}" for key, value in one["gains"].items())
            for level in (level for level in LEVELS if level in parts)
            for name, one in parts[level].items()
            if one["gains"]
        )
        note = (
            f"{n} episodes a cell (all of them successful: {low:.0f} to {high:.0f} %, 95 % "
            f"interval); to {TRAINED:g} mm errors are as the task draws them. "
            f"Gains chosen: {chosen}. {source(result)}"
        )
        return "\n\n".join([*_tables(parts), note])

    @classmethod
    def files(cls, results: Path) -> dict[Path, str]:
        path = results / cls.file
        if not (files := super().files(results)):
            return {}
        result = json.loads(path.read_text(encoding="utf-8"))
        return files | {
            path.with_name("varied.md"): _varied(result["parts"]) + f"\n\n{source(result)}\n"
        }
