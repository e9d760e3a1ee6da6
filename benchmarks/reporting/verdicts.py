"""Does the paper reproduce? Sentences that can fail, from stored runs and the thresholds below.

Each has a paragraph for the README, and one of details. A claim without runs is left out. A claim
on fewer than three seeds, or fewer steps than the paper's, gets no verdict.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from benchmarks.protocol import labels
from benchmarks.protocol.metrics import HOLES
from benchmarks.protocol.paper_values import ABLATION as PRINTED_ABLATION
from benchmarks.protocol.paper_values import GEOMETRY_ABLATION, PERFORMANCE, TRAINING_STEPS
from benchmarks.reporting.compared import Comparison, Question, comparisons, differences, find
from benchmarks.reporting.results import SEEDS, Group, Results, tail_mean
from benchmarks.reporting.stats import Value, measured, over_seeds
from benchmarks.reporting.tables.paper import best_under_noise

# Thresholds. A test for each fails when it moves.
SIGNIFICANCE: Final = 0.05  # of a difference over seeds, after Holm: the field's custom
SUCCESS_LEAST: Final = 93.0  # %: the paper's mean less its standard deviation
SCRIPT_POINTS: Final = 25.0  # above the best script under the same masks
EQUAL: Final = 5.0  # points: two methods whose difference surely lies within succeed as often
LEARNS: Final = 50.0  # %: from half of the episodes on a method counts as having learned the task

BETTER, SAME, WORSE = "better", "same", "worse"
YES, IN_PART, NO = "Yes", "In part", "No"


class Verdict(NamedTuple):
    """Whether a claim of the paper holds, empty where that is open, and the text."""

    holds: str
    text: str


NOTHING: Final = Verdict("", "")


def sentences(results: Results) -> dict[str, str]:
    """The sentences by topic; topics without runs are left out."""
    compared = comparisons(results)
    claims = {
        "performance": performance(results, compared),
        "components": components(results, compared),
        "geometry": geometry(results, compared),
    }
    report = {
        "in_short": in_short([claim.holds for claim in claims.values()]),
        **{topic: claim.text for topic, claim in claims.items()},
        "printed": printed(results),
    }
    return {topic: sentence for topic, sentence in report.items() if sentence}


def in_short(claims: Sequence[str]) -> str:
    """One word for the claims that have a verdict; nothing if none has."""
    decided = [claim for claim in claims if claim]
    if not decided:
        return ""
    return f"**{decided[0] if len(set(decided)) == 1 else IN_PART}.**"


def outcome(comparison: Comparison) -> str:
    """Whether ours is better, worse, or neither at the level of significance."""
    difference = comparison.difference
    # all seeds differ by the same: there is no t, and no doubt
    alike = difference.n >= SEEDS and difference.low == difference.high != 0.0
    if not (comparison.p_holm < SIGNIFICANCE or alike):
        return SAME
    return BETTER if difference.mean > 0.0 else WORSE


def as_well(comparison: Comparison) -> str:
    """Whether theirs does better, or as well; the latter takes more than lack of significance."""
    if outcome(comparison) == WORSE:
        return "succeeds more often than Rainbow"
    difference = comparison.difference
    equal = difference.low > -EQUAL and difference.high < EQUAL
    return "succeeds as often as Rainbow" if equal else ""


def ground(row: Group) -> str:
    """Why a row's runs allow no verdict; empty if they do."""
    steps = min((int(run.config["track"]["timesteps"]) for run in row.runs), default=0)
    if steps < TRAINING_STEPS:
        return f"{steps:,} of the paper's {TRAINING_STEPS:,} steps"
    return few(row)


def few(row: Group) -> str:
    """A remark on too few seeds; empty if there are enough."""
    return "" if row.n >= SEEDS else f"{row.n} of {row.planned or SEEDS} seeds"


def in_common(comparison: Comparison) -> str:
    """A remark on too few common seeds; empty if there are enough."""
    n = comparison.difference.n
    return "" if n >= SEEDS else f"{n} seed{'s' * (n != 1)} in common"


def performance(results: Results, compared: list[Comparison]) -> Verdict:
    """Rainbow against the paper's figure, the best script, masked DQN and the optimum."""
    greedy = results.group("rainbow", results.scored)
    ours = greedy.as_trained()
    if not ours.n:
        return NOTHING
    script = find(compared, Question.CONTROL, ours)
    rivals = [c for c in compared if (c.question, c.ours) == (Question.MASKED, ours)]
    others = [(c.theirs.title, c.theirs) for c in rivals]
    paper = PERFORMANCE["success"]["rainbow"]
    text = f"Rainbow succeeds in {_rate(ours)} of the test episodes (paper {paper} %)"
    text += f", the best script in {_rate(script.theirs)}." if script else "."
    for rival in rivals:
        if ground(rival.theirs):
            continue
        more = _but_greedily(rival, compared)
        trained = " As trained," if more else ""
        if as_good := as_well(rival):
            holes, mine = (row.value(HOLES).mean for row in (rival.theirs, ours))
            text += f"{trained} {rival.theirs.title} {as_good} (holes per episode {holes:.2f}, "
            text += f"Rainbow {mine:.2f}){more}."
        elif outcome(rival) == SAME:
            text += f"{trained} Rainbow is {_above(rival.difference)} {rival.theirs.title}, which "
            corrected = " after the correction for all learners" * (rival.p < SIGNIFICANCE)
            text += f"may be chance{corrected}{more}."
    if there := on_track(results, "terminal"):
        text += f" Where a collision ends the episode, {there}."
    text += under_noise(results, greedy)
    details = []
    if (optimum := results.group("optimum")).n:
        details.append(
            f"The exact optimum, which needs a model and no learning, reaches {_rate(optimum)}."
        )
    if ours != greedy:
        details.append(f"Greedily, Rainbow reaches {_rate(greedy)}.")
    if others:
        details.append(f"{'As trained, ' if ours != greedy else ''}{_joined(others)}.")
    learners = [("Rainbow", ours), *others]
    if all(row.curves() for _, row in learners):
        parts = [f"{name} {_show(_late(row, 'success', 100.0))} %" for name, row in learners]
        details.append(
            "In the last tenth of training, in which the weights go on changing, these are "
            f"{', '.join(parts)}."
        )
    if (planner := results.group("rrt_lattice")).n:
        details.append(f"{planner.name}, which needs a model too, reaches {_rate(planner)}.")
    why = ground(ours) or ("" if script else "no script was run")
    if script and not why and (theirs := few(script.theirs) or in_common(script)):
        why = f"best script: {theirs}"
    if why or script is None:
        (holds, verdict), so_far = Verdict("", "No verdict yet on the success rate"), f" ({why})"
    else:
        (holds, verdict), so_far = _on_success(ours, script), _so_far(ours)
    return Verdict(holds, _paragraphs(f"**{verdict}{so_far}.** {text}", details))


def _but_greedily(rival: Comparison, compared: list[Comparison]) -> str:
    """The greedy difference of two, if its outcome is not that as trained; empty otherwise."""
    for c in compared:
        same = (c.theirs.method, c.theirs.ablation) == (rival.theirs.method, rival.theirs.ablation)
        if c.question == Question.MASKED and same and outcome(c) != outcome(rival):
            return f"; greedily, Rainbow is {_above(c.difference)} it"
    return ""


def under_noise(results: Results, greedy: Group) -> str:
    """Ours and the best script under the observation noise that suits the script most, in place of
    random moves; empty where nothing was tested so.
    """
    chosen = best_under_noise(results, greedy.track)
    if chosen is None:
        return ""
    ours = greedy.at(chosen.level)
    lead = measured(differences(Question.CONTROL, ours, chosen)).signed(" points")
    return (
        f" With noise of {chosen.level.noise:g} on what it observes, where scripts do best, the "
        f"best script ({chosen.title}) reaches {_rate(chosen)}, Rainbow {_rate(ours)} ({lead})."
    )


def _on_success(ours: Group, script: Comparison) -> Verdict:
    if outcome(script) != BETTER:
        why = "a script does as well" if as_well(script) else "no lead over a script is shown"
        return Verdict(NO, f"The success rate does not reproduce: {why}")
    if ours.success().mean < SUCCESS_LEAST:
        return Verdict(
            IN_PART, "Rainbow beats the scripts but stays below the paper's success rate"
        )
    if script.difference.mean < SCRIPT_POINTS:
        near = f"less than {SCRIPT_POINTS:g} points above a script"
        return Verdict(YES, f"The success rate reproduces, {near}")
    return Verdict(YES, "The success rate reproduces")


def components(results: Results, compared: list[Comparison]) -> Verdict:
    """What the six components are worth: together, over masked DQN, and one at a time."""
    full = results.group("rainbow", results.scored).as_trained()
    masked = results.group("rainbow", full.track, ablation="none")
    together = next((c for c in compared if c.ours == full and c.theirs in masked.both()), None)
    wanted = len(PRINTED_ABLATION) - 1
    singles, greedily = (
        [
            c
            for c in compared
            if c.question == question and c.ours.ablation in PRINTED_ABLATION and not ground(c.ours)
        ]
        for question in (Question.ABLATION, Question.GREEDILY)
    )
    if not together and len(singles) < wanted:
        return NOTHING
    paragraph, why = [], ground(full)
    if together:
        paragraph.append(
            f"Rainbow's success rate is {_above(together.difference)} that of masked DQN, "
            "which lacks them."
        )
        if change := _in_training(together):
            paragraph.append(f"In training, in which the weights go on changing, it is {change}.")
        theirs = ground(together.theirs) or in_common(together)
        why = why or (theirs and f"masked DQN: {theirs}")
    costs, greedily = ([c for c in each if outcome(c) == WORSE] for each in (singles, greedily))
    alone = [c for c in singles if c.difference.high < 0.0 and c not in costs]
    pays = together is not None and outcome(together) == BETTER
    if len(singles) < wanted:
        paragraph.append(
            f"Of {wanted} removals of one component, {len(singles)} have {SEEDS} seeds so far."
        )
    else:
        fewest = min(c.difference.n for c in singles)
        more = "" if all(c.difference.n == fewest for c in singles) else " or more"
        beyond = f"success beyond chance after the correction for {wanted} tests"
        costly = f"these cost {beyond}: {_listed(costs)}" if costs else f"none costs {beyond}"
        paragraph.append(
            f"Of {wanted} removals of one component, each on {fewest} seeds{more}, {costly}."
        )
        if alone:
            also = " as well" if costs else ""
            paragraph.append(f"Uncorrected, these do{also}: {_listed(alone)}.")
        if greedily:
            paragraph.append(f"Greedily, these do after the correction: {_listed(greedily)}.")
    if why:
        holds, verdict = "", f"No verdict yet on the components ({why})"
    elif len(singles) < wanted:
        holds = IN_PART if pays else NO
        verdict = f"Together, Rainbow's six components {'help' if pays else 'do not help'}"
    elif pays and len(costs) == wanted:
        holds, verdict = YES, "The ablation of the six components reproduces"
    elif costs or greedily:
        holds, verdict = IN_PART, "The ablation of the six components reproduces in part"
    elif pays:
        holds, verdict = NO, "Rainbow's six components help together, none is shown to alone"
    else:
        holds, verdict = NO, "The ablation of the six components does not reproduce"
    return Verdict(holds, " ".join([f"**{verdict}.**", *paragraph]))


def _in_training(comparison: Comparison) -> str:
    """The difference in the last tenth of training, seed by seed; empty without curves."""
    ours, theirs = (_ends(row, "success", 100.0) for row in (comparison.ours, comparison.theirs))
    change = measured([ours[seed] - theirs[seed] for seed in ours if seed in theirs])
    return _above(change) if change.n >= SEEDS else ""


def _ends(row: Group, column: str, scale: float = 1.0) -> dict[int, float]:
    """A column of the training curves in the last tenth of training, by seed."""
    trained = [run for run in row.runs if run.folder.has_rows("curve")]
    return {run.seed: scale * tail_mean(run.curve, column) for run in trained}


def _late(row: Group, column: str, scale: float = 1.0) -> Value:
    return over_seeds([*_ends(row, column, scale).values()])


def _listed(removals: list[Comparison]) -> str:
    """Components with what their removal changes."""
    names = (labels.ABLATIONS[c.ours.ablation].removeprefix("- ").lower() for c in removals)
    changes = (c.difference.signed(" points") for c in removals)
    return ", ".join(f"{name} ({by})" for name, by in zip(names, changes, strict=True))


def geometry(results: Results, compared: list[Comparison]) -> Verdict:
    """The three rows of the paper's table: does each go in the paper's direction?"""
    track = results.scored
    after = results.group("rainbow", track).as_trained()
    before = results.group("rainbow", track, "initial").as_trained()
    if not (before.n and after.n):
        return NOTHING
    pair, report, right = (before, after), [], 0
    for name, key, unit, digits, (low, high) in (
        ("success rate", "success", " %", 1, [row.success() for row in pair]),
        ("number of training steps to 75 % success (1e5)", "steps_to_75", "", 2,
         [_steps(row) for row in pair]),
        ("number of singularity terminations in 1000 training episodes", "singular_per_1000", "", 1,
         [row.singular_per_1000() for row in pair]),
    ):  # fmt: skip
        right += (high.mean > low.mean) if key == "success" else (high.mean < low.mean)
        report.append(
            f"{name} {_verb(low, high)} from {_show(low, digits)} to {_show(high, digits)}{unit} "
            f"(paper {' to '.join(GEOMETRY_ABLATION[key])})"
        )
    each = find(compared, Question.GEOMETRY, before)
    if why := ground(before) or ground(after) or (in_common(each) if each else ""):
        holds, verdict, so_far = "", "No verdict yet on optimizing the 3-RRS", f" ({why})"
    else:
        so_far = _so_far(before, after)
        if each is None or outcome(each) != WORSE:  # ours is the initial one
            holds, verdict = NO, "The gain from optimizing the 3-RRS does not reproduce"
        elif right == 3:
            holds, verdict = YES, "The gain from optimizing the 3-RRS reproduces"
        else:
            holds, verdict = IN_PART, "The gain from optimizing the 3-RRS reproduces in part"
    text = f"**{verdict}{so_far}.** Rainbow's {report[0]}."
    details = [f"Its {'; its '.join(report[1:])}."]
    scripts = [results.control_of(row, row.geometry) for row in pair]
    if all(scripts):
        low, high = (row.success() for row in scripts if row)
        details.append(
            f"The success rate of the best script {_verb(low, high)} from {_show(low)} to "
            f"{_show(high)} %."
        )
    return Verdict(holds, _paragraphs(text, details))


def printed(results: Results) -> str:
    """Whether the paper's own reward teaches the task."""
    row = results.group("rainbow", "printed").as_trained()
    if not row.n:
        return ""
    if why := ground(row):
        verdict = f"No verdict yet on the reward as printed** ({why})."
    else:
        learns = "teaches" if row.success().mean >= LEARNS else "does not teach"
        verdict = f"The reward as printed {learns} the task.**"
    earn, fill = _show(_late(row, "episode_reward"), 0), _show(_late(row, "holes"), 2)
    details = [f"Rainbow's last training episodes earn {earn} and fill {fill} holes."]
    return _paragraphs(f"**{verdict} {on_track(results, 'printed')}.", details)


def on_track(results: Results, track: str) -> str:
    """Success of Rainbow, masked DQN and the best script; empty where Rainbow was not run."""
    ours = results.group("rainbow", track).as_trained()
    masked = results.group("rainbow", track, ablation="none").as_trained()
    script = results.control_of(ours)
    rows = {"Rainbow": ours, "masked DQN": masked, "the best script": script}
    return _joined([(name, row) for name, row in rows.items() if row and row.n]) if ours.n else ""


def _steps(row: Group) -> Value:
    """Training steps to 75 % success, in 1e5, over seeds; infinite if one never reached it."""
    value = row.steps_to_75()
    return value if value.n == row.n else Value(math.inf, n=row.n)


def _verb(before: Value, after: Value) -> str:
    if after.mean == before.mean or math.isnan(after.mean - before.mean):
        return "goes"
    return "rises" if after.mean > before.mean else "falls"


def _above(change: Value) -> str:
    """``25.0 points [16.6, 33.4] above``, or below."""
    direction = "above" if change.mean >= 0.0 else "below"
    if direction == "below":
        change = Value(-change.mean, change.std, change.n, -change.high, -change.low)
    return f"{change.signed(' points').removeprefix('+')} {direction}"


def _so_far(*rows: Group) -> str:
    row = min(rows, key=lambda each: each.n / max(each.planned, 1))
    return f" ({row.n} of {row.planned} seeds so far)" if row.n < row.planned else ""


def _paragraphs(text: str, details: Sequence[str]) -> str:
    return "\n\n".join(filter(None, [text, " ".join(details)]))


def _rate(row: Group) -> str:
    return f"{_show(row.success())} %{row.lead}"


def _joined(rows: Sequence[tuple[str, Group]]) -> str:
    (name, row), *others = rows
    parts = [f"{name} inserts in {_rate(row)}", *(f"{n} in {_rate(r)}" for n, r in others)]
    return " and ".join(filter(None, [", ".join(parts[:-1]), parts[-1]]))


def _show(value: Value, digits: int = 1) -> str:
    if math.isinf(value.mean):
        return "never on some seed"
    return "none" if math.isnan(value.mean) else value.text(digits)
