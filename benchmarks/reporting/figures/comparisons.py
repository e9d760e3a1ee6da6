"""Figures that compare methods on the test episodes: profiles, robustness, ablation."""

from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.protocol import labels, paper_values
from benchmarks.protocol.learners import LEARNERS
from benchmarks.protocol.metrics import N_HOLES
from benchmarks.protocol.plan import PLANNERS
from benchmarks.reporting.figures import style
from benchmarks.reporting.figures.style import Picture
from benchmarks.reporting.results import Group, Level, Results, complete
from benchmarks.reporting.stats import Value, mean_band, performance_profile
from benchmarks.reporting.tables.beyond import PLAYERS, error_levels, tasks
from benchmarks.reporting.tables.paper import NOISY, noise_levels

THRESHOLDS: Final = np.linspace(0.0, 1.0, 101)

Scores = list[NDArray[np.float64]]  # of each seed's test episodes


def of_episodes(results: Results) -> Iterator[Picture]:
    """Figures of the test episodes over all tracks, where there is something to compare."""
    if (drawn := _drawn(results)) and results.group("optimum").n:
        yield Picture("performance_profile", partial(_profiles, results, drawn))
    noisy = complete(row for row in results.rows(NOISY) if row.track in ("", results.scored))
    if noisy and len(noise_levels(results)) > 1:
        yield Picture("robustness", partial(_robustness, results, noisy))
    if error_levels(results):
        yield Picture("errors", partial(_errors, results))
    components = complete(
        results.group("rainbow", results.scored, ablation=name) for name in labels.ABLATIONS
    )
    if any(row.ablation not in labels.ALL_OR_NONE for row in components):
        references = results.references(results.scored)
        yield Picture("ablation_comparison", partial(_components, components, references))


def by_task(results: Results) -> Figure:
    """Success by task."""
    tracks = tasks(results)
    figure, (axes,) = style.canvas(size=(7.0, 5.2))
    for i, (label, (method, geometry)) in enumerate(PLAYERS.items()):
        rows = [results.group(method, track, geometry).as_trained() for track in tracks]
        if places := [(y, row.success()) for y, row in enumerate(rows) if row.n]:
            mean, arms = _arms([value for _, value in places])
            axes.errorbar(
                mean, [y + 0.1 * (i - 2.5) for y, _ in places], xerr=arms, fmt="o", markersize=4,
                capsize=2, color=style.METHOD_COLOURS.get(method, style.PALETTE[0]), label=label,
                markerfacecolor="white" if geometry == "initial" else None,
            )  # fmt: skip
    axes.set_yticks(range(len(tracks)), [track.replace("_", " ") for track in tracks])
    axes.invert_yaxis()
    axes.set_xlim(-2.0, 102.0)  # an interval of few seeds reaches beyond what is possible
    style.finish(axes, "", "Success rate (%), 95 % interval")
    return style.legend_below(figure, [axes], 3)


def _look(group: Group) -> dict[str, Any]:
    """Name, colour and line style of a group."""
    method = "masked_dqn" if group.ablation == "none" else group.method
    colour = style.METHOD_COLOURS.get(method, style.PALETTE[-1])
    line = style.TRACK_STYLES.get(group.track, "-.")
    return {"label": group.name, "color": colour, "linestyle": line}


def _drawn(results: Results) -> list[Group]:
    """Learners of the scored track, the best control for each knowledge, and planners."""
    result = complete(row for row in results.rows() if row.track in ("", results.scored))
    learners = [row for row in result if row.method in LEARNERS]
    controls = complete(row for row in map(results.control_of, learners) if row)
    planners = [row for row in result if row.method in PLANNERS]
    return [*{row.name: row for row in (*learners, *controls, *planners)}.values()]


def _holes(group: Group) -> Scores:
    return [rows["holes"].to_numpy(float) / N_HOLES for rows in group.tests()]


def _speeds(group: Group, optimum: Group) -> Scores:
    """Per seed and test episode that the optimum solves: its moves over the method's, or 0."""
    solved = (both[both["success_other"] == 1] for _, _, both in group.beside(optimum))
    return [(s["moves_first_other"] / s["moves_first"]).fillna(0).to_numpy() for s in solved]


def _profiles(results: Results, drawn: list[Group]) -> Figure:
    figure, panels = style.canvas(1, 2, (9.0, 5.2))
    optimum = results.group("optimum")
    for axes, label, scores_of in (
        (panels[0], "Share of the six holes filled", _holes),
        (panels[1], "Optimum's moves over own, first insertion",
         partial(_speeds, optimum=optimum)),
    ):  # fmt: skip
        for group in drawn:
            if scores := scores_of(group):
                mean, low, high = mean_band([performance_profile(s, THRESHOLDS) for s in scores])
                look = _look(group)
                if group.method == "rrt_lattice":  # grey: six colours are enough
                    look |= {"color": style.PALETTE[-1], "linestyle": "--"}
                axes.step(THRESHOLDS, mean, where="post", linewidth=1.3, **look)
                axes.fill_between(THRESHOLDS, low, high, step="post", color=look["color"],
                                  alpha=0.15, linewidth=0)  # fmt: skip
        style.finish(axes, "Share of test episodes above", label)
        axes.set_ylim(-0.02, 1.02)
    return style.legend_below(figure, panels, 3)


def _success_over(axes: Axes, group: Group, levels: dict[float, Level], **look: Any) -> None:
    mean, arms = _arms([group.at(level).success() for level in levels.values()])
    look = {**_look(group), **look}
    axes.errorbar(list(levels), mean, arms, capsize=3, marker="o", markersize=4, **look)


def _arms(values: Sequence[Value]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Means (n,), and the lengths (2, n) of their intervals' arms."""
    mean, low, high = np.array([(value.mean, value.low, value.high) for value in values]).T
    return mean, np.maximum([mean - low, high - mean], 0.0)


def _printed(papers: Iterable[str]) -> tuple[list[float], list[float]]:
    """Means and spreads of what the paper prints."""
    pairs = [text.partition(" ± ") for text in papers]
    return [float(mean) for mean, *_ in pairs], [float(spread or 0.0) for *_, spread in pairs]


def _robustness(results: Results, noisy: list[Group]) -> Figure:
    figure, (axes,) = style.canvas(size=(7.0, 5.6))
    levels = noise_levels(results)
    for i, group in enumerate(noisy):  # side by side, or intervals hide each other
        shift = 0.008 * max(levels) * (i - 2.5)
        _success_over(axes, group, {x + shift: Level(x) for x in levels})
    axes.errorbar(
        list(paper_values.ROBUSTNESS), *_printed(paper_values.ROBUSTNESS.values()),
        fmt="kD--", markersize=4, capsize=3, linewidth=0.9, label="Rainbow DQN, paper: ± std",
    )  # fmt: skip
    optimum = results.group("optimum").success()
    if optimum.n:
        axes.axhline(optimum.mean, color="0.5", linewidth=0.9, label="Exact optimum (true state)")
    style.finish(axes, "Success rate (%)", "Observation noise (share of the normalized range)")
    return style.legend_below(figure, [axes], 2)


def _errors(results: Results) -> Figure:
    figure, (axes,) = style.canvas(size=(7.0, 5.2))
    rows, others = complete(results.rows(uncertain=True)), "other scripts and planners"
    best = [results.best_script(row) for row in rows]
    for group in rows:
        look: dict[str, Any] = {}
        if group.method not in (*LEARNERS, "rrt_connect", "optimum") and group not in best:
            look = {"color": style.PALETTE[-1], "label": others, "zorder": 1}
            others = "_"  # once in the legend
        _success_over(axes, group, {x: Level(error=x) for x in error_levels(results)}, **look)
    axes.set_ylim(-2, 102)
    style.finish(axes, "Success rate (%)", "Bound of the base's displacement (mm)")
    return style.legend_below(figure, [axes], 2)


def _components(rows: Sequence[Group], references: Sequence[Group]) -> Figure:
    figure, (axes,) = style.canvas(size=(6.0, 4.2))
    places = np.arange(len(rows))
    values = [row.as_trained().success() for row in rows]
    mean, arms = _arms(values)
    arms[:, [value.n == 1 for value in values]] = np.nan  # one seed's is over its episodes
    axes.errorbar(
        mean, places + 0.14, xerr=arms, fmt="o", markersize=4, capsize=2, color="C0",
        label=f"ours, {labels.track(rows[0].track)}: 95 % interval",
    )  # fmt: skip
    paper = paper_values.ABLATION
    papers = {i: paper[row.ablation] for i, row in enumerate(rows) if row.ablation in paper}
    means, spreads = _printed(papers.values())
    axes.errorbar(
        means, list(papers), xerr=spreads, fmt="kD", markersize=4, capsize=2, label="paper: ± std"
    )
    for i, row in enumerate(references):
        axes.axvline(row.success().mean, color="0.4", linestyle=("--", ":")[i],
                     linewidth=0.9, label=row.acting_name)  # fmt: skip
    axes.set_yticks(places, [labels.ABLATIONS[row.ablation] for row in rows])
    axes.invert_yaxis()
    low, high = axes.get_xlim()  # an interval of few seeds reaches beyond what is possible
    axes.set_xlim(max(low, 0.0), min(high, 101.0))
    style.finish(axes, "", "Success rate (%)")
    return style.legend_below(figure, [axes], 2)
