"""The paper's learning figures and ours beyond them, from stored data alone: no torch."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.protocol import labels
from benchmarks.protocol.metrics import HOLES, N_HOLES, SUCCESS, Metric
from benchmarks.protocol.plan import ABLATIONS, LEARNERS
from benchmarks.protocol.presets import rows_of
from benchmarks.reporting.figures.comparisons import comparisons
from benchmarks.reporting.figures.curves import (
    EPISODES,
    curve_frames,
    draw_curve,
    draw_stages,
    mark_switches,
)
from benchmarks.reporting.figures.style import (
    METHOD_COLOURS,
    PALETTE,
    Picture,
    canvas,
    finish,
    legend_below,
)
from benchmarks.reporting.results import Group, Results
from benchmarks.reporting.rows import Row, complete, references, rows

STAGE_0_HOLES: Final = 4
WIDE: Final = 50  # episodes of the moving average where many lines share the axes

Groups = dict[str, Group]

# figure name -> (column of curve.csv, axis label, logarithmic, caption)
CURVES: Final[dict[str, tuple[str, str, bool, str]]] = {
    "cumulative_reward": (
        "episode_reward",
        "Episode reward",
        False,
        "Cumulative reward per episode: mean of the last ten, unsmoothed behind it",
    ),
    "success": ("success", "Success rate", False, "Success rate over training"),
    "max_q": ("mean_max_q", "Mean max Q", False, "Average maximum Q-value"),
    "loss": (
        "loss",
        "Loss",
        True,
        "Training loss: Rainbow's is a cross-entropy, DQN's a Huber loss, so that levels are not "
        "to be compared between methods",
    ),
    "duration": (
        "duration",
        "Episode duration (s)",
        False,
        "Duration of an episode: mean of the last ten, unsmoothed behind it",
    ),
}
RAW: Final = frozenset({"cumulative_reward", "duration"})


def pictures(results: Results) -> list[Picture]:
    """All figures of a store; of one with teams theirs alone."""
    if result := _teams(results):
        return result
    for track in results.tracks():
        result += _learning(results, track)
        result += _variants(results, track)
    if complete([*rows(results), *rows(results, uncertain=True)]):
        result += comparisons(results)
    return result


def _learning(results: Results, track: str) -> list[Picture]:
    """The paper's seven learning figures of one track."""
    groups = {labels.METHODS[method]: group for method, group in results.methods(track, LEARNERS)}
    if (masked := results.group("rainbow", track=track, ablation="none")).n:
        groups[labels.MASKED_DQN] = masked
    if not any(curve_frames(group) for group in groups.values()):
        return []
    bounds, of = references(results, track), labels.track(track)
    result = [
        Picture(
            f"{track}_{name}",
            f"{caption}, {of}.",
            partial(_curves, groups, column, label, log, name in RAW, bounds=bounds),
        )
        for name, (column, label, log, caption) in CURVES.items()
    ]
    result.insert(1, Picture(
        f"{track}_exploration", f"Learning rate, and noise magnitude or epsilon, {of}.",
        partial(_exploration, groups),
    ))  # fmt: skip
    result.insert(2, Picture(
        f"{track}_holes", f"Holes per episode by stage of the curriculum, {of}.",
        partial(_holes, groups, bounds),
    ))  # fmt: skip
    return result


def _variants(results: Results, track: str) -> list[Picture]:
    """Success over training of the ablations and of both geometries."""
    ablations = {
        title: results.group("rainbow", track=track, ablation=key)
        for key, title in labels.ABLATIONS.items()
    }
    geometries = {
        f"{name} geometry": results.group("rainbow", name, track)
        for name in ("optimized", "initial")
    }
    result = []
    for name, groups, caption in (
        ("ablation", ablations, "Success rate with one component removed: mean of the last fifty"),
        ("geometry", geometries, "Success rate on either geometry: mean of the last fifty"),
    ):
        if sum(bool(curve_frames(group)) for group in groups.values()) > 1:
            result.append(Picture(
                f"{track}_{name}", f"{caption}, {labels.track(track)}.",
                partial(_curves, groups, "success", "Success rate", window=WIDE,
                        band=name == "geometry", bounds=references(results, track)),
            ))  # fmt: skip
    return result


def _teams(results: Results) -> list[Picture]:
    """Success of all teams over ticks, with the components that most of them were trained with."""
    result = {
        ablation: {
            track: group
            for track in results.teams()
            if curve_frames(group := results.group("rainbow", track=track, ablation=ablation))
        }
        for ablation in labels.ABLATIONS
    }
    ablation = max(result, key=lambda name: len(result[name]))
    if not (groups := result[ablation]):
        return []
    caption = f"{labels.ABLATIONS[ablation]}: success rate over training, last fifty episodes."
    return [Picture("team_success", caption, partial(_over_ticks, results, groups))]


def _over_ticks(results: Results, groups: Groups) -> Figure:
    figure, (axes,) = canvas()
    settings_of = {track: results.settings(track) or {} for track in groups}
    forms = list(dict.fromkeys(settings["team"] for settings in settings_of.values()))
    for track, group in groups.items():
        form = settings_of[track]["team"]
        rows = rows_of(form)
        frames = [f.assign(timesteps=f["timesteps"] / rows) for f in curve_frames(group)]
        line = "--" if form != "central" and not settings_of[track].get("sight") else "-"
        colour = PALETTE[forms.index(form)]
        draw_curve(axes, frames, "success", labels.track(track), colour, line, False, window=WIDE)
    finish(axes, "Success rate", "Ticks")
    return figure


def _coloured(groups: Groups) -> list[tuple[str, Group, str]]:
    """Methods in their own colours; ablations and geometries one after the other."""
    titles = {**labels.METHODS, "masked_dqn": labels.MASKED_DQN}
    methods = {title: METHOD_COLOURS.get(key) for key, title in titles.items()}
    return [
        (name, group, methods.get(name) or f"C{i}")
        for i, (name, group) in enumerate(groups.items())
    ]


def _curves(
    groups: Groups,
    column: str,
    label: str,
    log: bool = False,
    raw: bool = False,
    band: bool = True,
    window: int = EPISODES,
    bounds: Sequence[Row] = (),
) -> Figure:
    figure, (axes,) = canvas()
    for number, (name, group, colour) in enumerate(_coloured(groups)):
        frames, line = curve_frames(group), "-" if number < len(PALETTE) else "--"
        draw_curve(axes, frames, column, name, colour, line, band, raw, window)
    if column == "success":
        _mark_bounds(axes, bounds, SUCCESS, 100.0)
    if column == "mean_max_q":
        _mark_support(axes, groups)
    if band:
        mark_switches(axes, [(group, colour) for _, group, colour in _coloured(groups)])
    finish(axes, label)
    legend_below(figure, [axes], 2)
    if log and axes.get_lines():
        axes.set_yscale("log")
    return figure


def _mark_bounds(axes: Axes, bounds: Sequence[Row], metric: Metric, full: float = 1.0) -> None:
    """Where the best control of the track and the optimum are, on the test episodes."""
    for row, line in zip(bounds, ("--", ":"), strict=False):
        level = row.value(metric).mean / full
        axes.axhline(level, color="0.4", linestyle=line, linewidth=0.9, label=row.acting_name)


def _mark_support(axes: Axes, groups: Groups) -> None:
    """The upper end of the support, above which a distributional value cannot go."""
    for group in groups.values():
        for run in group.runs[:1]:
            top = run.config["track"]["hyperparameters"]["v_max"]
            if run.config["cell"]["method"] == "rainbow" and top is not None:
                axes.axhline(float(top), color="0.4", linestyle="--", linewidth=0.9, label="V_max")


def _exploration(groups: Groups) -> Figure:
    figure, (above, below) = canvas(2, sharex=True)
    for name, group, colour in _coloured(groups):
        frames = curve_frames(group)
        draw_curve(above, frames, "learning_rate", name, colour)
        quantity = _quantity(group)
        if quantity:
            draw_curve(below, frames, "noise", f"{name}: {quantity}", colour)
    for axes, label in ((above, "Learning rate"), (below, "Exploration")):
        mark_switches(axes, [(group, colour) for _, group, colour in _coloured(groups)])
        finish(axes, label)
        if axes.get_lines():
            axes.set_yscale("log")
    above.set_xlabel("")
    return figure


def _quantity(group: Group) -> str:
    """What "noise" holds: without noisy layers epsilon, of an actor-critic nothing."""
    cells = [run.config["cell"] for run in group.runs]
    if not all(cell["method"] in ("rainbow", "dqn") for cell in cells):
        return ""
    quiet = any(
        cell["method"] == "dqn" or not ABLATIONS[cell["ablation"]].get("noisy", True)
        for cell in cells
    )
    return "epsilon" if quiet else "noise magnitude"


def _holes(groups: Groups, bounds: Sequence[Row]) -> Figure:
    figure, (axes,) = canvas()
    for name, group, colour in _coloured(groups):
        draw_stages(axes, curve_frames(group), name, colour)
    _mark_bounds(axes, bounds, HOLES)
    for holes, stage in ((STAGE_0_HOLES, 0), (N_HOLES, 1)):
        axes.axhline(holes, color="0.6", linewidth=0.8)
        text = f"all of stage {stage}"
        axes.annotate(text, (0.995, holes), xycoords=("axes fraction", "data"), ha="right",
                      va="bottom", fontsize=7, color="0.4")  # fmt: skip
    mark_switches(axes, [(group, colour) for _, group, colour in _coloured(groups)])
    finish(axes, "Holes per episode")
    legend_below(figure, [axes], 2)
    axes.set_ylim(-0.2, N_HOLES + 0.6)
    return figure
