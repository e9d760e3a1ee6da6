"""Does the paper reproduce? Sentences that can fail, from stored runs and the thresholds below.

A sentence whose runs are missing is left out; one that rests on fewer than three seeds, or on fewer
steps than the paper trains, says so and gives no verdict.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

from benchmarks.protocol import labels
from benchmarks.protocol.paper_values import ABLATION as PRINTED_ABLATION
from benchmarks.protocol.paper_values import GEOMETRY_ABLATION, PERFORMANCE, TRAINING_STEPS
from benchmarks.reporting.compared import (
    ABLATION,
    CONTROL,
    GEOMETRY,
    MASKED,
    SCRIPT,
    Comparison,
    comparisons,
    find,
)
from benchmarks.reporting.results import MAIN, Group, Results, tail_mean
from benchmarks.reporting.rows import Row, control_of, row_of, scored
from benchmarks.reporting.stats import Value, over_seeds

# Thresholds. A test for each fails when it moves.
SIGNIFICANCE: Final = 0.05  # of a difference over seeds, after Holm: the field's custom
SUCCESS_LEAST: Final = 93.0  # %: the paper's mean less its standard deviation
SCRIPT_POINTS: Final = 25.0  # above the best script under the same masks
LEARNS: Final = 50.0  # %: from half of the episodes on a method counts as having learned the task
SEEDS: Final = 3  # fewer are a lead

BETTER, SAME, WORSE = "better", "same", "worse"


def sentences(results: Results) -> dict[str, str]:
    """Sentences by what they speak of; only those whose runs are there."""
    compared = comparisons(results)
    report = {
        "performance": performance(results, compared),
        "components": components(results, compared),
        "geometry": geometry(results, compared),
        "printed": printed(results),
        "uncertain": uncertain(compared),
    }
    return {topic: sentence for topic, sentence in report.items() if sentence}


def outcome(comparison: Comparison) -> str:
    """Whether ours is better, worse, or neither at the level of significance."""
    if not comparison.p_holm < SIGNIFICANCE:
        return SAME
    return BETTER if comparison.difference.mean > 0.0 else WORSE


def ground(row: Row) -> str:
    """Why no verdict can rest on a row's runs; empty if one can."""
    runs = row.group.runs
    steps = min((int(run.config["track"]["timesteps"]) for run in runs), default=0)
    if steps < TRAINING_STEPS:
        return f"{steps:,} of the paper's {TRAINING_STEPS:,} steps"
    return "" if len(runs) >= SEEDS else f"{len(runs)} of {row.group.planned} seeds"


def performance(results: Results, compared: list[Comparison]) -> str:
    """Rainbow against the paper's figure, the best script, masked DQN and the optimum."""
    greedy = row_of(results, "rainbow", scored(results))
    ours = greedy.as_trained()
    if not ours.group.n:
        return ""
    script = find(compared, CONTROL, ours)
    others = [c.theirs for c in compared if (c.question, c.ours) == (MASKED, ours)]
    success = ours.success()
    n, planned = ours.group.n, ours.group.planned
    so_far = f" ({n} of {planned} seeds so far)" if n < planned else ""
    report = f"Rainbow{so_far} inserts in {_show(success)} % of the test episodes"
    if ours != greedy:
        report += f" as trained, {_show(greedy.success())} greedily"
    report += f" (paper {PERFORMANCE['success']['rainbow']}"
    optimum = row_of(results, "optimum")
    report += f", the exact optimum {_show(optimum.success())})" if optimum.group.n else ")"
    planner = row_of(results, "rrt_lattice")  # the strongest, which plans on the model
    if planner.group.n:
        report += f", {planner.name} in {_show(planner.success())}"
    if script:
        report += f", the best script under the same masks in {_show(script.theirs.success())}"
    for other in others:
        report += f", {other.name.partition(',')[0]} in {_show(other.success())}"
        greedily = replace(other, level=MAIN)
        if other.method == "maskable_ppo" and other != greedily:
            report += f" (greedily {_show(greedily.success())})"
    if why := ground(ours):
        return f"**No verdict yet on performance** ({why}): {report}."
    reached = success.mean >= SUCCESS_LEAST
    above = script is not None and outcome(script) == BETTER
    far = script is not None and script.difference.mean >= SCRIPT_POINTS
    if not above:
        verdict = "The success rate does not reproduce: a script does as well"
    elif not reached:
        verdict = "Learning pays, the success rate is missed"
    elif not far:
        verdict = f"The success rate reproduces, less than {SCRIPT_POINTS:g} points above a script"
    else:
        verdict = "The success rate reproduces"
    return f"**{verdict}**: with the reward repaired {report}."


def components(results: Results, compared: list[Comparison]) -> str:
    """What the six components are worth: together, over masked DQN, and one at a time."""
    full = row_of(results, "rainbow", scored(results)).as_trained()
    if not full.group.n:
        return ""
    together = next(
        (
            c
            for c in compared
            if (c.question, c.ours) == (MASKED, full) and c.theirs.method == "rainbow"
        ),
        None,
    )
    singles = [c for c in compared if c.question == ABLATION and c.ours.group.n]
    parts = []
    if together:
        parts.append(
            f"all six together change masked DQN's success by {_points(together)}, "
            f"{_significant(together)}"
        )
    costs = [c for c in singles if outcome(c) == WORSE]
    if singles:
        names = ", ".join(_component(c) for c in costs) or "none"
        parts.append(f"of {len(singles)} removed one at a time these cost: {names}")
    if not parts:
        return ""
    report = "; ".join(parts)
    short = [ground(row) for row in (full, *(c.ours for c in singles)) if ground(row)]
    if together and ground(together.theirs):
        short.append(f"masked DQN: {ground(together.theirs)}")
    if short:
        return f"**No verdict yet on the components** ({short[0]}): {report}."
    pays = together is not None and outcome(together) == BETTER
    whole = len(costs) == len(PRINTED_ABLATION) - 1
    verdict = "reproduces" if pays and whole else (
        "reproduces in part" if pays or costs else "does not reproduce")  # fmt: skip
    return f"**The ablation {verdict}**: {report}."


def _component(comparison: Comparison) -> str:
    ablation = comparison.ours.group.runs[0].config["cell"]["ablation"]
    return f"{labels.ABLATIONS[ablation].removeprefix('- ').lower()} ({_points(comparison)})"


def geometry(results: Results, compared: list[Comparison]) -> str:
    """The three rows of the paper's table: does each go in the paper's direction?"""
    track = scored(results)
    after = row_of(results, "rainbow", track).as_trained()
    before = row_of(results, "rainbow", track, "initial").as_trained()
    if not (before.group.n and after.group.n):
        return ""
    rows = [
        ("steps to 75 %", 1e-5, "steps_to_75", before.group.meta("steps_to_75"),
         after.group.meta("steps_to_75")),
        ("success", 1.0, "success", before.success(), after.success()),
        ("singular ends per 1000 training episodes", 1.0, "singular_per_1000",
         before.group.singular_per_1000(), after.group.singular_per_1000()),
    ]  # fmt: skip
    report, right = [], 0
    for name, scale, key, low, high in rows:
        rises = key == "success"
        right += (high.mean > low.mean) if rises else (high.mean < low.mean)
        unit = " (1e5)" if scale != 1.0 else " %" if rises else ""
        first, last = (Value(scale * v.mean, scale * v.std, v.n) for v in (low, high))
        digits = 2 if scale != 1.0 else 1
        report.append(
            f"{name} from {_show(first, digits)} to {_show(last, digits)}{unit} "
            f"(paper {' to '.join(GEOMETRY_ABLATION[key])})"
        )
    ends = {end: control_of(results, row, end) for end, row in
            (("initial", before), ("optimized", after))}  # fmt: skip
    if all(ends.values()):
        shown = " to ".join(_show(row.success()) for row in ends.values() if row)
        report.append(f"the best script from {shown} %")
    each = find(compared, GEOMETRY, before)
    text = "; ".join(report)
    if why := ground(before) or ground(after):
        return f"**No verdict yet on the design stage** ({why}): {text}."
    verdict = "reproduces" if right == len(rows) and each and outcome(each) == WORSE else (
        "reproduces in part" if right else "does not reproduce")  # fmt: skip
    return f"**The design stage's effect {verdict}**: {text}."


def printed(results: Results) -> str:
    """Whether the paper's own reward teaches the task."""
    row = row_of(results, "rainbow", "printed").as_trained()
    if not row.group.n:
        return ""
    report = f"Rainbow inserts in {_show(row.success())} %"
    if script := control_of(results, row):
        report += f", the best script under the same masks in {_show(script.success())}"
    reward, holes = (_last_episodes(row.group, name) for name in ("episode_reward", "holes"))
    report += (
        f"; its last training episodes earn {_show(reward, 0)} and fill {_show(holes, 2)} holes"
    )
    if why := ground(row):
        return f"**No verdict yet on the reward as printed** ({why}): {report}."
    learns = "teaches" if row.success().mean >= LEARNS else "does not teach"
    return f"**The reward as printed {learns} the task**: {report}."


def uncertain(compared: list[Comparison]) -> str:
    """The best learner of the uncertain machine against the best script."""
    result = [each for each in compared if each.question == SCRIPT]
    if not result:
        return ""
    chosen = max(result, key=lambda each: each.ours.success().mean)
    verdict = {SAME: "scripts do as well", WORSE: "scripts stay ahead", BETTER: "learning pays"}
    return (
        f"**On the uncertain machine {verdict[outcome(chosen)]}**: {chosen.ours.name} inserts in "
        f"{_show(chosen.ours.success())} %, {chosen.theirs.name} in "
        f"{_show(chosen.theirs.success())} ({_points(chosen)})."
    )


def _last_episodes(group: Group, column: str) -> Value:
    return over_seeds([tail_mean(run.folder.rows("curve"), column) for run in group.runs])


def _points(comparison: Comparison) -> str:
    value = comparison.difference
    interval = "" if math.isnan(value.low) else f" {value.interval_text(1)}"
    return f"{value.mean:+.1f} points{interval}"


def _significant(comparison: Comparison) -> str:
    if comparison.difference.n < 2:
        return "on one seed"
    return {
        SAME: "no clear difference",
        BETTER: "a clear gain",
        WORSE: "a clear loss",
    }[outcome(comparison)]


def _show(value: Value, digits: int = 1) -> str:
    return "none" if math.isnan(value.mean) else value.text(digits)


def of_six(results: Results) -> list[tuple[str, str, Value | None, int]]:
    """The README's six rows: what, the paper's figure, ours, digits."""
    track = scored(results)
    ours = row_of(results, "rainbow", track).as_trained()
    initial = row_of(results, "rainbow", track, "initial").as_trained()
    dqn = row_of(results, "dqn", track).as_trained()
    masked = row_of(results, "rainbow", track, ablation="none").as_trained()
    rrt = row_of(results, "rrt_connect")
    script = control_of(results, ours)
    success = PERFORMANCE["success"]
    rows: list[tuple[str, str, Row | None]] = [
        ("Rainbow", success["rainbow"], ours),
        ("Rainbow, initial geometry", GEOMETRY_ABLATION["success"][0], initial),
        ("DQN of SB3, which knows no masks", success["dqn"], dqn),
        ("DQN with the same masks", "-", masked),
        ("RRT-Connect", success["rrt_connect"], rrt),
        ("Best script with the same masks", "-", script),
    ]
    return [
        (name, paper, row.success() if row and row.group.n else None, 1)
        for name, paper, row in rows
    ]  # fmt: skip
