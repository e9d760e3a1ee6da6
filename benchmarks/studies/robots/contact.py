"""Scripts on the contact task: success, time and force over the hole's error and over friction.

    python -m benchmarks contact

Each script's gains are the best of a grid on validation episodes of each level, by success and then
by time, with errors up to 3 mm. The tests have errors of fixed size to any side, or as the task
draws them, tilts up to a degree, and friction as the task draws it, or errors of 3 mm and fixed
friction. With ``--vary`` both searches insert with other timesteps, contacts and play. Written to
``results/contact/`` and to ``docs/physics.md``; a level that this commit measured is not measured
again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium.error import DependencyNotInstalled
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn
from rich.progress import TimeElapsedColumn as Elapsed
from rich.progress import TimeRemainingColumn as Remaining

from benchmarks.errors import BenchmarkError, at_least
from benchmarks.reporting.stats import wilson
from benchmarks.reporting.verify import Report
from benchmarks.runs.machine import describe
from benchmarks.runs.store import write_text
from benchmarks.studies.robots.pages import check_tables, kept, publish
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
from benchmarks.studies.speed.report import table

BLOCK: Final = "contact"
VARIED: Final = "contact-varied"
PAGE: Final = "physics.md"
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
    from coop_env.physics.contact.env import CoopInsertionContactEnv

    env, grid = CoopInsertionContactEnv(level), GRIDS[name]
    best: tuple[tuple[float, float], Gains] | None = None
    for values in itertools.product(*grid.values()):
        gains = replace(Gains(), **dict(zip(grid, values, strict=True)))
        found = play(env, SCRIPTS[name](env, gains), "validate", episodes)
        score = (float(np.mean(found["success"])), -float(np.mean(found["time"])))
        if best is None or score > best[0]:
            best = score, gains
    assert best is not None  # of an empty grid there is one choice
    return {key: getattr(best[1], key) for key in grid}


def measure(level: str, episodes: int, tick: Callable[[], None]) -> Row:
    """All scripts of a level: their gains and their test episodes."""
    from benchmarks.methods.contact_scripts import SCRIPTS, Gains
    from coop_env.physics.contact.env import CoopInsertionContactEnv

    env = CoopInsertionContactEnv(level)
    found: Row = {}
    for name, make in SCRIPTS.items():
        gains = choose(level, name, episodes)
        tick()
        script = make(env, replace(Gains(), **gains))
        found[name] = {
            "gains": gains,
            "errors": [play(env, script, "test", episodes, error) for error in CONDITIONS],
            "frictions": [play(env, script, "test", episodes, TRAINED, f) for f in FRICTIONS],
        }
        tick()
    return found


def sensitivity(level: str, scripts: Row, episodes: int, tick: Callable[[], None]) -> list[Row]:
    """The searches, as their gains were chosen, under each of :data:`VARIANTS`."""
    from benchmarks.methods.contact_scripts import SCRIPTS, Gains
    from coop_env.physics.contact.env import CoopInsertionContactEnv
    from coop_env.physics.contact.task import resolve_task

    rows = []
    for variant, fields in VARIANTS.items():
        env = CoopInsertionContactEnv(replace(resolve_task(level), **fields))
        for name in (name for name in SEARCHES if name in scripts):
            script = SCRIPTS[name](env, Gains(**scripts[name]["gains"]))
            row = {"variant": variant, "script": name, "yields": yields(level, fields)}
            rows.append(row | play(env, script, "test", episodes))
        tick()
    return rows


def yields(level: str, fields: Row) -> float:
    """How far a peg sinks into a hole's flat rim until :data:`PRESSED` N are met, m."""
    from coop_env.physics.contact.env import CoopInsertionContactEnv
    from coop_env.physics.contact.task import resolve_task
    from coop_env.physics.model import Servos

    task = replace(resolve_task(level), **fields, force_limit=PRESSED, max_steps=1000)
    env = CoopInsertionContactEnv(task, servos=Servos(delta_stiffness=1000.0))
    env.reset(seed=0, options={"hole": 4, "error": [0.003, 0.0, 0.0, 0.0], "friction": 0.4})
    over = False
    while not over:
        *_, terminated, truncated, _ = env.step([0.0, 0.0, -0.1, 0.0, 0.0, 0.0])
        over = terminated or truncated
    return -float(min(env.batch.twin.inspect(0)[1].contact.dist, default=0.0))


def _tables(found: Mapping[str, Any]) -> Iterator[str]:
    what = "success (%) / median time of successes (s) / median peak force (N)"
    for level, scripts in found["levels"].items():
        yield table(
            f"Scripts, level `{level}`, over the hole's displacement: {what}",
            "script | " + " | ".join(map(shown, CONDITIONS)) + " | failures",
            [
                [name, *map(in_cell, one["errors"]), causes(one["errors"])]
                for name, one in scripts.items()
            ],
        )
    standard = found["levels"].get("standard", {})
    yield table(
        f"Scripts, level `standard`, {TRAINED:g} mm, over friction: {what}",
        "script | " + " | ".join(f"{f:g}" for f in FRICTIONS),
        [[name, *map(in_cell, one["frictions"])] for name, one in standard.items()],
    )


def tell_varied(found: Mapping[str, Any]) -> str:
    """The searches under each of :data:`VARIANTS` as Markdown."""
    machine = found["machine"]
    varied = table(
        f"What the simulation assumes, varied; errors to {TRAINED:g} mm",
        "level | script | variant | success (%) / median time (s) / median peak force (N) | "
        f"largest peak (N) | rim yields at {PRESSED:g} N (mm)",
        [
            [level, row["script"], row["variant"], in_cell(row), f"{max(row['force']):.1f}",
             f"{1e3 * row['yields']:.3f}"]
            for level, rows in found["levels"].items()
            for row in rows
        ],
    )  # fmt: skip
    return (
        f"{varied}\n\n{found['episodes']} episodes a row, as the task draws them, with the gains "
        f"of the tables above. Command: `{found['command']}`. {machine['machine']['processor']}, "
        f"commit {machine['commit'][:9]}."
    )


def tell(found: Mapping[str, Any]) -> str:
    """The measurements as Markdown."""
    machine, n = found["machine"], found["episodes"]
    low, high = (100.0 * share for share in wilson(n, n))
    chosen = "; ".join(
        f"{level}, {name}: " + ", ".join(f"{key} {value:g}" for key, value in one["gains"].items())
        for level, scripts in found["levels"].items()
        for name, one in scripts.items()
        if one["gains"]
    )
    return "\n\n".join(
        [
            *_tables(found),
            f"{n} episodes a cell (all of them successful: {low:.0f} to {high:.0f} %, 95 % "
            f"interval); to {TRAINED:g} mm errors are as the task draws them. "
            f"Gains chosen: {chosen}. Command: `{found['command']}`. "
            f"{machine['machine']['processor']}, commit {machine['commit'][:9]}.",
        ]
    )


def main(words: Sequence[str]) -> int:
    """Measure, print, write ``contact/`` below the results folder and the block of the docs."""
    line = argparse.ArgumentParser(
        prog="python -m benchmarks contact",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    line.add_argument("--results", type=Path, default=Path("results"))
    line.add_argument("--docs", type=Path, default=Path("docs"), help=f"folder of {PAGE}")
    line.add_argument("--episodes", type=at_least(2), default=EPISODES, help="of each cell")
    line.add_argument(
        "--film", action="store_true", help="draw a video of one insertion, and no more"
    )
    line.add_argument("--vary", action="store_true", help="vary what is assumed, and no more")
    line.add_argument("--levels", nargs="+", choices=LEVELS, default=list(LEVELS))
    given = line.parse_args(list(words))
    try:
        from benchmarks.methods.contact_scripts import SCRIPTS, Gains
    except DependencyNotInstalled as missing:
        raise BenchmarkError(str(missing)) from missing
    console, path = Console(soft_wrap=True), given.results / "contact" / "scripts.json"
    if given.film:
        return _film(path, console)
    if given.vary:
        return _vary(path, given, words, console)
    commit = describe()["commit"]  # what another one measured is measured again
    asked = {"episodes": given.episodes, "defaults": asdict(Gains()), "commit": commit}
    found = kept(path, asked, {"levels": {}})
    found |= {
        "command": " ".join(["python -m benchmarks contact", *words]),
        "machine": describe(),
        "episodes": given.episodes,
    }
    columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), Elapsed(), Remaining())
    with Progress(*columns, console=console, refresh_per_second=2) as progress:
        for level in given.levels:
            if level not in found["levels"]:
                task = progress.add_task(level, total=2 * len(SCRIPTS))
                tick = partial(progress.advance, task)
                found["levels"][level] = measure(level, given.episodes, tick)
                write_text(path, json.dumps(found) + "\n")
    publish(path, tell(found), given.docs / PAGE, BLOCK, console)
    return 0


def _vary(path: Path, given: Any, words: Sequence[str], console: Console) -> int:
    """The searches, with the gains that were stored, under each of :data:`VARIANTS`.

    Raises:
        BenchmarkError: no gains are stored.
    """
    if not path.is_file():
        raise BenchmarkError(f"{path} is missing: run python -m benchmarks contact first")
    stored = json.loads(path.read_text(encoding="utf-8"))["levels"]
    found: Row = {
        "command": " ".join(["python -m benchmarks contact", *words]),
        "machine": describe(),
        "episodes": given.episodes,
        "levels": {},
    }
    with Progress(console=console, refresh_per_second=2) as progress:
        for level in (level for level in SENSITIVE if level in given.levels and level in stored):
            tick = partial(progress.advance, progress.add_task(level, total=len(VARIANTS)))
            found["levels"][level] = sensitivity(level, stored[level], given.episodes, tick)
    path = path.with_name("varied.json")
    write_text(path, json.dumps(found) + "\n")
    publish(path, tell_varied(found), given.docs / PAGE, VARIED, console)
    return 0


def _film(path: Path, console: Console) -> int:
    """A film of the moment-guided search, with the gains that were stored."""
    from benchmarks.methods.contact_scripts import Gains
    from benchmarks.studies.robots.film import write_film

    stored = json.loads(path.read_text(encoding="utf-8"))["levels"] if path.is_file() else {}
    gains = stored.get("standard", {}).get("moment-guided search", {}).get("gains", {})
    console.print("Drawing: some ten seconds", markup=False)
    for written in write_film(path.parent, replace(Gains(), **gains)):
        console.print(f"{written}  {written.stat().st_size / 1000:.0f} kB", markup=False)
    return 0


def check(report: Report, results: Path, presets: list[str], docs: Path) -> None:
    """Verify that the tables, here and in the docs, follow from the stored episodes."""
    check_tables(report, results / "contact/scripts.json", tell, docs / PAGE, BLOCK)
    check_tables(report, results / "contact/varied.json", tell_varied, docs / PAGE, VARIED)
