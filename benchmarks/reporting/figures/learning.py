"""Training curves over seeds: the paper's learning figures and ours beyond them. No torch here."""

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.protocol import labels
from benchmarks.protocol.learners import LEARNERS
from benchmarks.protocol.metrics import HOLES, N_HOLES, SUCCESS, Metric
from benchmarks.protocol.plan import ABLATIONS
from benchmarks.protocol.presets import rows_of
from benchmarks.reporting.figures import style
from benchmarks.reporting.figures.comparisons import by_task, of_episodes
from benchmarks.reporting.figures.style import Picture
from benchmarks.reporting.results import Group, Results
from benchmarks.reporting.stats import mean_band, moving_average
from benchmarks.reporting.tables.beyond import tasks

STAGE_0_HOLES: Final = 4
EPISODES: Final = 10  # of the paper's moving average
WIDE: Final = 50  # episodes of the moving average where many lines share the axes
POINTS: Final = 300
BY_EPISODE: Final = frozenset({"episode_reward", "holes", "success", "duration"})

Curve = NDArray[np.float64]
Groups = dict[str, Group]

# figure name -> (column of curve.csv, axis label)
CURVES: Final[dict[str, tuple[str, str]]] = {
    "cumulative_reward": ("episode_reward", "Episode reward"),
    "holes": ("holes", "Holes per episode"),
    "success": ("success", "Success rate"),
    "max_q": ("mean_max_q", "Mean max Q (PPO: value)"),
    "loss": ("loss", "Loss, each learner's own"),  # a cross-entropy, or a Huber loss
    "duration": ("duration", "Episode duration (s)"),
}
RAW: Final = ("episode_reward", "duration")  # columns that are shown unsmoothed, too
BOUNDED: Final = {"success": SUCCESS, "holes": HOLES}  # by the best control and the optimum


def pictures(results: Results) -> list[Picture]:
    """All figures of a store."""
    if groups := _teams(results):  # a store with teams has no others
        return [Picture("team_success", partial(_over_ticks, groups))]
    if tasks(results):  # a preset about the task
        return [Picture("difficulty", partial(by_task, results))]
    learned = (
        picture
        for track in results.tracks()
        for picture in (*_learning(results, track), *_variants(results, track))
    )
    return [*learned, *of_episodes(results)]


def _learning(results: Results, track: str) -> Iterator[Picture]:
    """The paper's seven learning figures for the scored track; success alone for another."""
    learners = [results.group(method, track) for method in LEARNERS]
    learners.append(results.group("rainbow", track, ablation="none"))
    groups = {group.title: group for group in learners if group.known}
    if not any(group.curves() for group in groups.values()):
        return
    bounds, scored = results.references(track), track == results.scored
    for name, (column, label) in CURVES.items():
        if scored or name == "success":
            yield Picture(f"{track}_{name}", partial(_curves, groups, column, label, bounds=bounds))
    if scored:
        yield Picture(f"{track}_exploration", partial(_exploration, groups))


def _variants(results: Results, track: str) -> Iterator[Picture]:
    """Success over training of the ablations and of both geometries."""
    ablations = {
        title: results.group("rainbow", track, ablation=key)
        for key, title in labels.ABLATIONS.items()
    }
    shown = [group.ablation for group in ablations.values() if group.curves()]
    if len(shown) > 1 and not labels.ALL_OR_NONE.issuperset(shown):  # which other figures have
        bounds = results.references(track)
        yield Picture(f"{track}_ablation", partial(_by_component, ablations, bounds))
    geometries = {
        f"{name} geometry": results.group("rainbow", track, name)
        for name in ("optimized", "initial")
    }
    if all(group.curves() for group in geometries.values()):  # each has bounds of its own
        over_steps = partial(_curves, geometries, "success", "Success rate", window=WIDE)
        yield Picture(f"{track}_geometry", over_steps)


def _by_component(groups: Groups, bounds: Sequence[Group]) -> Figure:
    """Success without each component; many are split over two panels, with all and none in both."""
    drawn = [each for each in _coloured(groups) if each[1].curves()]
    removed = [name for name, group, _ in drawn if group.ablation not in labels.ALL_OR_NONE]
    columns = 2 if len(removed) > 3 else 1
    figure, panels = style.canvas(1, columns, (3.0 + 3.0 * columns, 3.9), sharey=True)
    for panel, axes in enumerate(panels):
        for name, group, colour in drawn:
            line = "--" if group.ablation == "none" else "-"
            if name not in removed or removed.index(name) % columns == panel:
                draw(axes, group.curves(), "success", name, colour, line, window=WIDE)
        _mark_bounds(axes, bounds, SUCCESS)
        style.finish(axes, "" if panel else "Success rate")
    return style.legend_below(figure, panels, 3)


def _teams(results: Results) -> list[Group]:
    """The trained teams, with the components that most of them have."""
    tracks = results.tracks(teams=True)
    by_ablation = (
        [results.group("rainbow", track, ablation=ablation) for track in tracks]
        for ablation in labels.ABLATIONS
    )
    return max(([g for g in each if g.curves()] for each in by_ablation), key=len)


def _over_ticks(groups: Sequence[Group]) -> Figure:
    """Success of teams over ticks."""
    figure, (axes,) = style.canvas()
    forms: list[str] = []
    for group in groups:
        settings = group.settings or {}
        form = settings["team"]
        forms += [] if form in forms else [form]
        frames = [f.assign(timesteps=f["timesteps"] / rows_of(form)) for f in group.curves()]
        line = "--" if form != "central" and not settings.get("sight") else "-"
        colour = style.PALETTE[forms.index(form)]
        name = labels.track(group.track)
        draw(axes, frames, "success", name, colour, line, band=False, window=WIDE)
    style.finish(axes, "Success rate", "Ticks")
    return figure


def _coloured(groups: Groups) -> list[tuple[str, Group, str]]:
    """Groups with a colour each: methods have their own, ablations and geometries the next."""
    titles = {**labels.METHODS, "masked_dqn": labels.MASKED_DQN}
    methods = {title: style.METHOD_COLOURS.get(key) for key, title in titles.items()}
    return [
        (name, group, methods.get(name) or ("C7" if group.ablation == "none" else f"C{i}"))
        for i, (name, group) in enumerate(groups.items())
    ]


def _curves(
    groups: Groups, column: str, label: str, window: int = EPISODES,
    bounds: Sequence[Group] = (),
) -> Figure:  # fmt: skip
    figure, (axes,) = style.canvas()
    for name, group, colour in _coloured(groups):
        if column == "holes":
            _draw_stages(axes, group.curves(), name, colour)
        else:
            draw(axes, group.curves(), column, name, colour, window=window, raw=column in RAW)
    if column in BOUNDED:
        _mark_bounds(axes, bounds, BOUNDED[column])
    if column == "holes":
        _mark_stages(axes)
    if column == "mean_max_q":
        _mark_support(axes, groups)
    _mark_switches(axes, groups)
    if column == "loss" and axes.get_lines():
        axes.set_yscale("log")
    style.finish(axes, label)
    return style.legend_below(figure, [axes], 2)


def _mark_bounds(axes: Axes, bounds: Sequence[Group], metric: Metric) -> None:
    """Mark the track's best control and the optimum, by ``metric`` on the test episodes."""
    for row, line in zip(bounds, ("--", ":"), strict=False):
        level = row.value(metric).mean / metric.scale
        axes.axhline(level, color="0.4", linestyle=line, linewidth=0.9, label=row.acting_name)


def _mark_support(axes: Axes, groups: Groups) -> None:
    """The upper end of the support, above which a distributional value cannot go."""
    for group in groups.values():
        if group.method == "rainbow" and group.n:
            top = group.runs[0].config["track"]["hyperparameters"]["v_max"]
            if top is not None:
                axes.axhline(float(top), color="0.4", linestyle="--", linewidth=0.9, label="V_max")


def _mark_switches(axes: Axes, groups: Groups) -> None:
    """A dotted line where each seed's curriculum went from four holes to six."""
    label: str | None = "curriculum switch"
    for _, group, colour in _coloured(groups):
        for run in group.runs:
            step = run.training.get("curriculum_switch")
            if step is not None:
                axes.axvline(float(step), color=colour, linestyle=":", linewidth=0.9, alpha=0.8,
                             label=label)  # fmt: skip
                label = None


def _exploration(groups: Groups) -> Figure:
    figure, (above, below) = style.canvas(2, sharex=True)
    for name, group, colour in _coloured(groups):
        line = "--" if group.ablation == "none" else "-"  # where it lies on vanilla DQN's
        draw(above, group.curves(), "learning_rate", name, colour, line)
        if quantity := _quantity(group):
            draw(below, group.curves(), "noise", f"{name}: {quantity}", colour, line)
    for axes, label in ((above, "Learning rate"), (below, "Exploration")):
        _mark_switches(axes, groups)
        style.finish(axes, label)
        if axes.get_lines():
            axes.set_yscale("log")
    above.set_xlabel("")
    return style.legend_below(figure, [above, below], 2)


def _quantity(group: Group) -> str:
    """Label of the column "noise": sigma, or epsilon without noisy layers; "" if neither."""
    if group.method == "rainbow" and ABLATIONS[group.ablation].get("noisy", True):
        return "noise magnitude"
    return "epsilon" if group.method in ("rainbow", "dqn") else ""


def _mark_stages(axes: Axes) -> None:
    """Mark how many holes each stage of the curriculum has."""
    for holes, stage in ((STAGE_0_HOLES, 0), (N_HOLES, 1)):
        axes.axhline(holes, color="0.6", linewidth=0.8)
        text = f"all of stage {stage}"
        axes.annotate(text, (1.01, holes), xycoords=("axes fraction", "data"), va="center",
                      fontsize=7, color="0.4", annotation_clip=False)  # fmt: skip
    axes.set_ylim(-0.2, N_HOLES + 0.6)


def _series(frame: pd.DataFrame, column: str, window: int) -> tuple[Curve, Curve]:
    """Steps and values of one run; columns of episodes as the mean of the last ``window``."""
    ended = frame.get("episodes", frame["timesteps"])
    counts = ended.diff().fillna(ended).clip(lower=1)
    rows = frame.assign(counts=counts)[["timesteps", column, "counts"]].dropna()
    steps, values = rows["timesteps"].to_numpy(float), rows[column].to_numpy(float)
    if column in BY_EPISODE:
        values = moving_average(values, window, rows["counts"])
    return steps, values


def _seed_curves(
    frames: Sequence[pd.DataFrame], column: str, window: int = EPISODES
) -> tuple[Curve, Curve]:
    """Steps (T,) that all seeds share, and the seeds' values there (seeds, T); empty if none."""
    curves = [_series(frame, column, window) for frame in frames]
    result = [(steps, values) for steps, values in curves if len(steps)]
    if not result:
        return np.empty(0), np.empty((0, 0))
    shared = result[0][0]
    if len(shared) < POINTS and all(np.array_equal(steps, shared) for steps, _ in result):
        return shared, np.stack([values for _, values in result])  # no interval in between
    start = max(steps[0] for steps, _ in result)
    grid = np.linspace(start, max(start, min(steps[-1] for steps, _ in result)), POINTS)
    return grid, np.stack([np.interp(grid, steps, values) for steps, values in result])


def draw(
    axes: Axes, frames: Sequence[pd.DataFrame], column: str, label: str, colour: str,
    line: str = "-", band: bool = True, window: int = EPISODES, raw: bool = False,
) -> None:  # fmt: skip
    """Mean over seeds with its band, and with ``raw`` the unsmoothed mean faintly behind."""
    grid, values = _seed_curves(frames, column, window)
    if not len(grid):
        return
    if raw:
        rough_grid, rough = _seed_curves(frames, column, 1)
        axes.plot(rough_grid, rough.mean(axis=0), color=colour, alpha=0.25, linewidth=0.7)
    mean, low, high = mean_band(values)
    axes.plot(grid, mean, line, color=colour, label=label, linewidth=1.4)
    if band:
        _band(axes, grid, low, high, color=colour)


def _band(axes: Axes, grid: Curve, low: Curve, high: Curve, **look: Any) -> None:
    """Student's 95 % interval; it is wide for few seeds, so the axes follow the means."""
    seen = axes.dataLim.frozen()
    axes.fill_between(grid, low, high, alpha=0.2, linewidth=0, **look)
    axes.dataLim.set(seen)


def _draw_stages(axes: Axes, frames: Sequence[pd.DataFrame], label: str, colour: str) -> None:
    """Holes per episode, dashed in stage 0 and solid in stage 1; each the mean of its own seeds.

    Where seeds are in different stages there is no band.
    """
    kept = [frame for frame in frames if frame["holes"].notna().any()]
    grid, values = _seed_curves(kept, "holes")
    if not len(grid):
        return
    rows = [np.searchsorted(f["timesteps"].to_numpy(float), grid).clip(0, len(f) - 1) for f in kept]
    stages = np.stack([f["stage"].to_numpy()[at] for f, at in zip(kept, rows, strict=True)])
    _, low, high = mean_band(values)
    for stage, line in ((0, "--"), (1, "-")):
        own = np.ma.masked_where(stages != stage, values)
        if not own.count():
            continue
        name, mean = f"{label}, stage {stage}", own.mean(axis=0)
        axes.plot(grid, mean, line, color=colour, label=name, linewidth=1.4)
        _band(axes, grid, low, high, color=colour, where=own.count(axis=0) == len(values))
