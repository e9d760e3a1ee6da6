"""Scripts on the contact task, and learners beside them: success, time, force over the error.

Each script's gains are the best of a grid on validation episodes of each level, by success and then
by time, with errors up to 3 mm. The tests have errors of fixed size in any direction, or as the
task draws them; tilt and friction are always the task's. Last, a search inserts with other
timesteps, contacts and play, and an animation is drawn.
"""

import math
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from benchmarks.methods import contact_scripts
from benchmarks.protocol.labels import of_suite
from benchmarks.protocol.presets import CONTACT
from benchmarks.reporting.figures import style
from benchmarks.reporting.stats import wilson
from benchmarks.reporting.tables.table import Table, plain
from benchmarks.studies.base import Measured, Part, Tick, count, episode, read_stored, source
from benchmarks.studies.classic.results import SuiteResults, student, with_interval
from benchmarks.studies.media import write_animation
from benchmarks.studies.robots import trials
from benchmarks.studies.robots.trials import LEVEL, TRAINED, WHAT, Row, play, script_of
from coop_env.rendering import CAMERAS, render_frame

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
"""Variants of the simulation's assumptions: fields of the task."""
PRESSED: Final = 20.0  # N
SCENE: Final = (480, 368)  # px of the film
CHART: Final = (4.8, 1.76)  # inches of 100 px


def make(level: str, *, servos: Any = None, **fields: Any) -> Any:
    """The environment of a level, with other fields of its task."""
    from coop_env.physics.env import CoopInsertionContactEnv
    from coop_env.physics.task import resolve_task

    return CoopInsertionContactEnv(replace(resolve_task(level), **fields), servos=servos)


def choose(env: Any, name: str, grid: Mapping[str, Any], episodes: int) -> dict[str, float]:
    """A script's gains for a level: most successes on validation episodes, then the least time."""
    options = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]

    def score(gains: dict[str, float]) -> tuple[float, float]:
        result = play(env, script_of(name, env, gains), "validate", episodes)
        return float(np.mean(result["success"])), -float(np.mean(result["time"]))

    return max(options, key=score)


def measure(level: str, episodes: int, tick: Tick) -> Row:
    """All scripts of a level: their gains and their test episodes."""
    env, result = make(level), {}
    for name, grid in contact_scripts.GRIDS.items():
        gains = choose(env, name, grid, episodes)
        script = script_of(name, env, gains)
        errors = [play(env, script, "test", episodes, error) for error in trials.CONDITIONS]
        result[name] = {"gains": gains, "errors": errors}
        tick(len(result) / len(contact_scripts.GRIDS))
    return result


def sensitivity(level: str, measured: Row, episodes: int, tick: Tick) -> list[Row]:
    """The search with its chosen gains, under each of :data:`VARIANTS`."""
    gains, rows = measured[level][SEARCH]["gains"], []
    for variant, fields in VARIANTS.items():
        env = make(level, **fields)
        result = play(env, script_of(SEARCH, env, gains), "test", episodes)
        rows.append({"variant": variant, "yields": yields(level, fields), **result})
        tick(len(rows) / len(VARIANTS))
    return rows


def yields(level: str, fields: Row) -> float:
    """Depth to which a peg sinks into a hole's flat rim at a force of :data:`PRESSED` N, m."""
    from coop_env.physics.model import Servos

    servos = Servos(delta_stiffness=1000.0)
    env = make(level, servos=servos, **fields, force_limit=PRESSED, max_steps=1000)
    start = {"hole": 4, "error": [0.003, 0.0, 0.0, 0.0], "friction": 0.4}
    deque(episode(env, lambda _: [0.0, 0.0, -0.1, 0.0, 0.0, 0.0], seed=0, options=start), 0)
    return -float(min(env.batch.twin.inspect(0)[1].contact.dist, default=0.0))


def write_film(path: Path, gains: Mapping[str, float]) -> None:
    """A GIF of a validation episode of the search at the largest error, the force below it."""
    env = make(LEVEL)
    start = trials.options("validate", 0, TRAINED, 0.2)
    steps = episode(env, script_of(SEARCH, env, gains), seed=0, options=start)
    shown = [(env.scene(), info.get("force", np.zeros(3))) for info in steps]
    forces, fps = np.array([force for _, force in shown]), env.metadata["render_fps"]
    look: dict[str, Any] = {"camera": replace(CAMERAS["dome"], distance=0.42), "panel": False}
    frames = []
    with style.style():
        for now in (*range(0, len(shown), 2), len(shown) - 1):
            scene = render_frame(shown[now][0], size=SCENE, **look)
            frames.append(np.concatenate([scene, _chart(forces, now, fps)]))
    write_animation(path, frames, fps / 2)


def _chart(forces: np.ndarray, now: int, fps: int) -> np.ndarray:
    """The force along the hole and across it, up to a moment."""
    figure, (axes,) = style.canvas(size=CHART)
    figure.set_dpi(100)
    time, across = np.arange(len(forces)) / fps, np.hypot(forces[:, 0], forces[:, 1])
    for values, name in ((forces[:, 2], "along the hole"), (across, "across")):
        axes.plot(time[: now + 1], values[: now + 1], label=name)
    axes.set_xlim(0.0, time[-1])
    axes.set_ylim(-0.5, 1.5 * max(forces[:, 2].max(), across.max()))  # room for the legend
    style.finish(axes, "force (N)", "time (s)")
    axes.legend(loc="upper left", ncols=2)
    drawn: Any = FigureCanvasAgg(figure)
    drawn.draw()
    return np.asarray(drawn.buffer_rgba())[..., :3].copy()


def varied(parts: Row) -> str:
    """The table of the varied assumptions."""
    rows = []
    for level in SENSITIVE:
        for row in parts.get(f"{level}, varied", []):
            if row.get("script", SEARCH) == SEARCH:  # older files have others, too
                numbers = [f"{max(row['force']):.1f}", f"{1e3 * row['yields']:.3f}"]
                rows.append([level, row["variant"], trials.in_cell(row), *numbers])
    title = f"What the simulation assumes, varied: {SEARCH}, errors to {TRAINED:g} mm"
    head = f"level | variant | {WHAT} | largest peak (N) | rim yields at {PRESSED:g} N (mm)"
    return plain(title, head, rows)


class Contact(Measured):
    """Scripts that insert in contact."""

    name, file, needs = "contact", "contact/scripts.json", ("mujoco", "physics")
    options = {"--episodes": count(trials.EPISODES, "episodes of each cell", 2)}  # noqa: RUF012

    def asked(self) -> dict[str, Any]:
        return super().asked() | {"defaults": asdict(contact_scripts.Gains())}

    def measures(self) -> dict[str, Part]:
        n, kept = self.given.episodes, self.result["parts"]
        return {
            **{level: partial(measure, level, n) for level in LEVELS},
            **{f"{level}, varied": partial(sensitivity, level, kept, n) for level in SENSITIVE},
        }

    def finish(self) -> None:
        gains = self.result["parts"][LEVEL][SEARCH]["gains"]
        write_film(self.folder / "insertion.gif", gains)

    @staticmethod
    def to_markdown(result: dict[str, Any]) -> str:
        n = result["asked"]["episodes"]
        low, high = (100.0 * share for share in wilson(n, n))
        rows, chosen = [], []
        scripts = [(level, *each) for level in LEVELS for each in result["parts"][level].items()]
        for level, name, one in scripts:
            failed = Counter(cause for row in one["errors"] for cause in row["failure"] if cause)
            causes = ", ".join(f"{cause} {times}" for cause, times in sorted(failed.items())) or "-"
            rows.append([level, name, *map(trials.in_cell, one["errors"]), causes])
            if gains := ", ".join(f"{gain} {value:g}" for gain, value in one["gains"].items()):
                chosen.append(f"{level}, {name}: {gains}")
        head = " | ".join(["level", "script", *map(trials.shown, trials.CONDITIONS), "failures"])
        table = plain(f"Scripts over the hole's displacement: {WHAT}", head, rows)
        note = (
            f"{n} episodes a cell (all of them successful: {low:.0f} to {high:.0f} %, "
            f"95 % interval); to {TRAINED:g} mm errors are as the task draws them. "
            f"Gains chosen: {'; '.join(chosen)}. {source(result)}"
        )
        return "\n\n".join([table, varied(result["parts"]), note])


class Entry(NamedTuple):
    """A method's episodes under each error, the last as the task draws it."""

    level: str
    name: str
    seeds: str
    errors: list[dict[str, Any]]
    success: str
    look: dict[str, Any]


def levels(results: SuiteResults) -> dict[str, str]:
    """The preset's contact tasks on the scripts' machine, which has no errors: key and level."""
    return {
        key: task.env_kwargs["level"]
        for key, task in results.preset.tasks.items()
        if task.env == CONTACT and "sim_to_real" not in task.env_kwargs
    }


def _of(rows: pd.DataFrame, error: float | None) -> dict[str, Any]:
    """The episodes under an error, in the form of the scripts'."""
    rows = rows[rows["error"].isna() if error is None else rows["error"] == error]
    return {str(k): v for k, v in rows.fillna({"failure": ""}).to_dict("list").items()}


def _entries(results: SuiteResults) -> Iterator[Entry]:
    """Learners, level by level, and the scripts that the study ``contact`` has stored."""
    path = results.root / Contact.file
    stored = read_stored(path)["parts"] if path.is_file() else {}
    for task, level in levels(results).items():
        for method in results.preset.methods:
            if not (runs := [run.folder.rows("contact") for run in results.runs(task, method)]):
                continue
            value = student([trials.medians(_of(rows, trials.DRAWN))[0] for rows in runs])
            value = replace(value, low=max(value.low, 0.0), high=min(value.high, 100.0))
            rows = pd.concat(runs)
            yield Entry(
                *(level, of_suite(method), str(len(runs))),
                [_of(rows, error) for error in trials.CONDITIONS],
                with_interval(value, 1),
                {"color": style.METHOD_COLOURS.get(method, style.PALETTE[-1])},
            )
        for number, (name, one) in enumerate(stored.get(level, {}).items()):
            success = f"{trials.medians(one['errors'][-1])[0]:.1f}"
            look = {"color": str(0.15 + 0.2 * number), "linestyle": "--"}
            yield Entry(level, name, "-", one["errors"], success, look)


def learner_tables(results: SuiteResults) -> list[Table]:
    """Success, time and force over the hole's error; none without such a task."""
    if not (entries := list(_entries(results))):
        return []
    head = ["Level", "Method", "Seeds"]
    same = "The same test episodes for all; medians over the episodes of all seeds. "
    return [
        Table(
            "contact",
            f"Contact task, the hole displaced as the task draws it, {trials.shown(trials.DRAWN)}",
            [*head, "Success (%) [95 %]", "Time (s)", "Peak force (N)"],
            [[*e[:3], e.success, *trials.in_cell(e.errors[-1]).split(" / ")[1:]] for e in entries],
            [f"{same}Time of successes. Rainbow and DQN act in twelve moves."],
            left=(0, 1),
        ),
        Table(
            "displacement",
            f"Contact task over the hole's displacement: {WHAT}",
            [*head, *map(trials.shown, trials.CONDITIONS)],
            [[*e[:3], *map(trials.in_cell, e.errors)] for e in entries],
            [f"{same}Beyond {TRAINED:g} mm is outside of training."],
            left=(0, 1),
        ),
    ]


def draw_learners(results: SuiteResults) -> Figure:
    """Success, time and force over the hole's error: learners solid, scripts dashed."""
    shown_levels = [*levels(results).values()]
    size = (3.6 * len(shown_levels), 6.4)
    figure, axes = style.canvas(3, len(shown_levels), size, sharex=True, sharey=False)
    grid = np.array(axes).reshape(3, len(shown_levels))
    for entry in _entries(results):
        column = grid[:, shown_levels.index(entry.level)]
        values = zip(*map(trials.medians, entry.errors[: len(trials.ERRORS)]), strict=True)
        for each, line in zip(column, values, strict=True):
            each.plot(trials.ERRORS, line, label=entry.name, linewidth=1.2, **entry.look)
    for level, column in zip(shown_levels, grid.T, strict=True):
        column[0].set_title(f"level {level}")
        column[-1].set_xlabel("displacement of the hole (mm)")
    for each, what in zip(grid[:, 0], ("success (%)", "time (s)", "peak force (N)"), strict=True):
        each.set_ylabel(what)
    return style.legend_below(figure, axes)
