"""Figures that compare methods on the test episodes: profiles, robustness, ablation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from benchmarks.protocol import labels, paper_values
from benchmarks.protocol.metrics import N_HOLES
from benchmarks.protocol.plan import LEARNERS, PLANNERS
from benchmarks.reporting.figures.curves import look
from benchmarks.reporting.figures.style import Picture, canvas, finish, legend_below
from benchmarks.reporting.results import Group, Level, Results
from benchmarks.reporting.rows import Row, complete, control_of, references, row_of, rows, scored
from benchmarks.reporting.stats import Value, profile_over_seeds
from benchmarks.reporting.tables.compare import printed_spread
from benchmarks.reporting.tables.paper import NOISY, noise_levels
from benchmarks.reporting.tables.uncertain import error_levels

THRESHOLDS: Final = np.linspace(0.0, 1.0, 101)

Scores = Sequence[NDArray[np.float64]]  # of each seed's test episodes


def comparisons(results: Results) -> list[Picture]:
    """Figures of the test episodes, over all tracks."""
    result = [
        Picture(
            "performance_profile",
            "Performance profiles: share of test episodes above a score, with 95 % bands over "
            "seeds. Left: holes filled of six. Right: the optimum's moves to the first insertion "
            "over the method's, 0 without an insertion.",
            partial(_profiles, results),
        ),
        Picture(
            "robustness",
            "Success rate over observation noise, with 95 % intervals, and the paper's two values.",
            partial(_robustness, results),
        ),
    ]  # fmt: skip
    if error_levels(results):
        result.append(Picture(
            "errors",
            "Success rate on the uncertain machine over the bound of its base's displacement, the "
            "tilt in proportion, with 95 % intervals.",
            partial(_errors, results),
        ))  # fmt: skip
    if components := _ablation_rows(results):
        result.append(Picture(
            "ablation_comparison",
            "Success rate with one component removed: ours (as trained, where tested so) with 95 % "
            "intervals, the paper's with its standard deviation.",
            partial(_ablation_comparison, components, references(results, scored(results))),
        ))  # fmt: skip
    return result


def _speeds(group: Group, optimum: Group) -> list[NDArray[np.float64]]:
    """Per seed and test episode that the optimum solves: its moves over the method's, or 0."""
    best = {run.seed: run.test() for run in optimum.runs}
    result = []
    for run in group.runs:
        if run.seed in best:
            both = run.test().merge(best[run.seed], on="episode", suffixes=("", "_best"))
            both = both[both["success_best"] == 1]
            result.append((both["moves_first_best"] / both["moves_first"]).fillna(0.0).to_numpy())
    return result


def _drawn(results: Results) -> dict[str, Group]:
    """Learners, of the controls the best of each knowledge, and planners, by name."""
    result = complete(rows(results))
    learners = [row for row in result if row.method in LEARNERS]
    controls = [control_of(results, row) for row in learners]
    planners = [row for row in result if row.method in PLANNERS]
    chosen = [*learners, *complete(row for row in controls if row), *planners]
    return {row.name: row.group for row in chosen}


def _on_uncertain(results: Results) -> dict[str, Group]:
    result = complete(rows(results, uncertain=True))
    return {row.name: row.group for row in result}


def _profile_scores(results: Results) -> list[tuple[str, Mapping[str, Scores]]]:
    """(panel, method -> scores of each seed's test episodes) of both panels."""
    optimum, methods = results.group("optimum"), _drawn(results)
    holes = {
        name: [run.test()["holes"].to_numpy(float) / N_HOLES for run in group.runs]
        for name, group in methods.items()
    }
    speeds = {name: _speeds(group, optimum) for name, group in methods.items()}
    return [
        ("Holes filled (of six)", holes),
        ("Optimum's moves over own, first insertion", {n: s for n, s in speeds.items() if s}),
    ]


def _profiles(results: Results) -> Figure:
    figure, panels = canvas(1, 2, (9.0, 5.2))
    looks = {name: look(group) for name, group in _drawn(results).items()}
    for axes, (label, methods) in zip(panels, _profile_scores(results), strict=True):
        for name, scores in methods.items():
            mean, low, high = profile_over_seeds(scores, THRESHOLDS)
            colour, style = looks[name]
            axes.step(THRESHOLDS, mean, style, where="post", color=colour, label=name,
                      linewidth=1.3)  # fmt: skip
            axes.fill_between(THRESHOLDS, low, high, step="post", color=colour, alpha=0.15,
                              linewidth=0)  # fmt: skip
        finish(axes, "Share of test episodes above", label)
        axes.set_ylim(-0.02, 1.02)
    legend_below(figure, panels, 3)
    return figure


def _robustness_lines(results: Results) -> dict[str, Group]:
    result = complete(rows(results, NOISY))
    return {row.name: row.group for row in result}


def _robustness(results: Results) -> Figure:
    figure, (axes,) = canvas(size=(7.0, 5.6))
    levels = noise_levels(results)
    for name, group in _robustness_lines(results).items():
        _error_bars(axes, levels, [group.success(Level(x)) for x in levels], name, look(group))
    printed = paper_values.ROBUSTNESS
    axes.errorbar(
        list(printed),
        [paper_values.mean(text) for text in printed.values()],
        yerr=[printed_spread(text) for text in printed.values()],
        fmt="kD--", markersize=4, capsize=3, linewidth=0.9, label="Rainbow DQN, paper",
    )  # fmt: skip
    optimum = results.group("optimum").success()
    if optimum.n:
        axes.axhline(optimum.mean, color="0.5", linewidth=0.9, label="Exact optimum (true state)")
    finish(axes, "Success rate (%)", "Observation noise (share of the normalized range)")
    legend_below(figure, [axes], 2)
    return figure


def _error_bars(
    axes: Axes, x: Sequence[float], values: Sequence[Value], label: str, style: tuple[str, str]
) -> None:
    mean = np.array([value.mean for value in values])
    error = np.array([
        [value.mean - value.low for value in values],
        [value.high - value.mean for value in values],
    ])  # fmt: skip
    axes.errorbar(
        x, mean, np.maximum(error, 0.0), label=label, capsize=3, marker="o", markersize=4,
        color=style[0], linestyle=style[1],
    )  # fmt: skip


def _errors(results: Results) -> Figure:
    figure, (axes,) = canvas(size=(7.0, 5.2))
    levels = error_levels(results)
    for name, group in _on_uncertain(results).items():
        values = [group.success(Level(error=level)) for level in levels]
        _error_bars(axes, levels, values, name, look(group))
    axes.set_ylim(-2, 102)
    finish(axes, "Success rate (%)", "Bound of the base's displacement (mm)")
    legend_below(figure, [axes], 2)
    return figure


def _ablation_rows(results: Results) -> list[tuple[str, str, Value, str]]:
    result = []
    for track in [scored(results)]:
        for key, title in labels.ABLATIONS.items():
            row = row_of(results, "rainbow", track, ablation=key).as_trained()
            if row.group.n:
                paper = paper_values.ABLATION.get(key, "")
                result.append((labels.track(track), title, row.success(), paper))
    return result


def _ablation_comparison(
    result: Sequence[tuple[str, str, Value, str]], references: Sequence[Row]
) -> Figure:
    figure, (axes,) = canvas(size=(6.0, 4.2))
    titles = list(dict.fromkeys(title for _, title, _, _ in result))
    tracks = list(dict.fromkeys(track for track, _, _, _ in result))
    for i, track in enumerate(tracks):
        mine = [(titles.index(title), value) for t, title, value, _ in result if t == track]
        values = [value for _, value in mine]
        mean = np.array([value.mean for value in values])
        error = np.array([mean - [v.low for v in values], [v.high for v in values] - mean])
        axes.errorbar(
            mean, [y + 0.14 * (i + 1) for y, _ in mine], xerr=np.maximum(error, 0.0),
            fmt="o", markersize=4, capsize=2, color=f"C{i}", label=f"ours, {track}",
        )  # fmt: skip
    printed = {title: paper for _, title, _, paper in result if paper}
    axes.errorbar(
        [paper_values.mean(text) for text in printed.values()],
        [titles.index(title) for title in printed],
        xerr=[printed_spread(text) for text in printed.values()],
        fmt="kD", markersize=4, capsize=2, label="paper",
    )  # fmt: skip
    for i, row in enumerate(references):
        axes.axvline(row.success().mean, color="0.4", linestyle=("--", ":")[i],
                     linewidth=0.9, label=row.acting_name)  # fmt: skip
    axes.set_yticks(range(len(titles)), titles)
    axes.invert_yaxis()
    finish(axes, "", "Success rate (%)")
    legend_below(figure, [axes], 2)
    return figure
