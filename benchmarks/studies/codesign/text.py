"""Tables and sentences of the co-design, from stored data alone, and their check."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.stats import rankdata, spearmanr

from benchmarks.protocol.metrics import METRICS, SUCCESS
from benchmarks.reporting.stats import Value, measured
from benchmarks.reporting.tables.table import Number, Table
from benchmarks.runs.store import Store
from benchmarks.studies.codesign.result import POLICIES, SearchResult
from benchmarks.studies.codesign.spaces import POPULATION, STUDIES, UNBUILT
from coop_env.simulation.insertion_task import PAPER_TASK

SYMBOLS: Final = {"lambdas": "(λ1, λ2)", "heights": "(L2, home)"}
#: least rank correlations for which the area counts as a good proxy, and as one at all
GOOD, FAIR = 0.8, 0.3
FEW: Final = 20  # designs, of which nothing is said


def rank_correlation(x: ArrayLike, y: ArrayLike, repetitions: int = 2_000) -> Value:
    """Spearman's rank correlation over pairs, with a 95 % interval by resampling the pairs.

    NaN where there are fewer than three pairs, or one side is constant.
    """
    pairs = np.stack([np.asarray(x, float), np.asarray(y, float)])
    pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
    n = pairs.shape[1]
    if n < 3 or (np.ptp(pairs, axis=1) == 0.0).any():
        return Value(math.nan, n=0)
    drawn = np.random.default_rng(0).integers(n, size=(repetitions, n))
    ranks = rankdata(pairs[:, drawn], axis=-1)
    ranks -= ranks.mean(axis=-1, keepdims=True)
    size = np.sqrt((ranks**2).sum(axis=-1).prod(axis=0))
    drawn_values = ranks.prod(axis=0).sum(axis=-1)[size > 0.0] / size[size > 0.0]
    low, high = np.quantile(drawn_values, [0.025, 0.975])
    return Value(float(spearmanr(*pairs).statistic), n=n, low=float(low), high=float(high))


def to_markdown(result: SearchResult) -> str:
    """All of it as Markdown."""
    summary, asked = result.summary, result.asked
    parts = [_searched(result).markdown().strip(), _proxies(result).markdown().strip()]
    sentences = [sentence(result, study) for study in STUDIES]
    parts.append(_designs(result).markdown().strip())
    machine = summary["machine"]
    spent = summary["cpu_seconds"] + sum(
        float(run.meta()["cpu_seconds"]) for run in Store(result.folder, POLICIES).completed()
    )
    source = (
        f"Command: `{summary['command']}`. {asked['starts']} validation starts for each design, "
        f"the same seeds for all; {spent / 60.0:.0f} core-minutes in all on "
        f"{machine['machine']['processor']}, begun at commit {machine['commit'][:9]}."
    )
    picture = "../results/codesign/figures/fronts.png"
    shown = f"![Fronts, chosen designs, and success by area]({picture})"
    return "\n\n".join([*parts, *sentences, source, shown])


def _searched(result: SearchResult) -> Table:
    rows: list[list[str | Number]] = []
    for study, of in result.summary["studies"].items():
        bounds = ", ".join(
            f"{name} {low:g} to {high:g}" for name, (low, high) in of["bounds"].items()
        )
        skipped = [str(of["skipped"][reason]) for reason in UNBUILT]
        scored = int((result.designs["study"] == study).sum())
        front = len(result.front(study))
        rows.append([SYMBOLS[study], bounds, str(scored), *skipped, str(front)])
    return Table(
        "search", "Designs by the exact optimum, both robots moving at once",
        ["Study", "Bounds (m)", "Scored", "Skipped: lengths", "home", "starts", "On the front"],
        rows,
        [
            "Skipped designs have no score: they "
            + ", or ".join(UNBUILT.values()) + ".",
            "Front: success against mean ticks over the starts that were solved, of designs that "
            f"solve at least {result.summary['floor']:.1f} %, the least of the designs that were "
            "there before; one that solves few reaches the nearest targets alone, and looks quick.",
        ],
        left=(0, 1),
    )  # fmt: skip


def _proxies(result: SearchResult) -> Table:
    rows: list[list[str | Number]] = []
    for study in STUDIES:
        mine = result.of_study(study)
        numbers = mine.index.str.extract(r"-(\d+)$")[0].astype(float).to_numpy()
        random = mine[numbers < _first_population(result, study)]
        good = mine[mine["success"] >= result.summary["floor"]]
        for name, part in (("all", mine), ("drawn at random", random), ("on or above", good)):
            values = [rank_correlation(part["a_w"], part[to]) for to in ("success", "ticks_all")]
            rows.append([SYMBOLS[study], name, str(len(part)), *map(_with_interval, values)])
    return Table(
        "proxy", "Rank correlations over designs",
        ["Study", "Designs", "n", "A_w, success", "A_w, ticks"],
        rows,
        [
            "Success and ticks are the optimum's; ticks over all starts, one that was not solved "
            f"counting all {result.summary['most']}.",
            f"Spearman's; 95 % intervals by resampling designs. Drawn at random: the first "
            f"{POPULATION} of the sampler. On or above: the least success of the front.",
        ],
        left=(0, 1),
    )  # fmt: skip


def _first_population(result: SearchResult, study: str) -> float:
    """The number of the first design that is no longer of the first population."""
    mine = result.designs[result.designs["study"] == study]
    numbers = mine.index.str.extract(r"-(\d+)$")[0].dropna().astype(int).sort_values()
    return float(numbers.iloc[POPULATION]) if len(numbers) > POPULATION else math.inf


def _with_interval(value: Value) -> str:
    return f"{value.mean:.2f} [{value.low:.2f}, {value.high:.2f}]" if value.n else "-"


def _designs(result: SearchResult) -> Table:
    rows: list[list[str | Number]] = []
    seconds = PAPER_TASK.dt
    for design, tests in result.chosen.groupby("design", sort=False):
        of = result.designs.loc[design]
        group = result.policies(str(design))
        lengths = [f"{of[name]:.3f}" for name in ("lambda1", "lambda2")]
        lengths += [f"{1e3 * of[name]:.1f}" for name in ("distal_length", "home_heave")]
        margin = tests["sigma_cone"].iloc[0]
        rows.append([
            label(str(design), tests), *lengths, f"{of['a_w']:.3f}",
            "-" if math.isnan(margin) else f"{margin:.3f}",
            Number(over(tests["success"])), Number(over(seconds * tests["ticks"]), 2),
            Number(over(seconds * tests["ticks_all"]), 2),
            Number(group.value(SUCCESS)), Number(group.value(METRICS["time_first"]), 2),
        ])  # fmt: skip
    return Table(
        "designs", "The designs on test starts",
        ["Design", "λ1", "λ2", "L2 (mm)", "Home (mm)", "A_w (rad²)", "Least sigma_min in 28°",
         "Optimum: success (%)", "time (s)", "time, all (s)", "Policy: success (%)",
         "Policy: time (s)"],
        rows,
        [
            f"Mean ± std over seeds, of {result.asked['seeds']} times 100 test starts, which no "
            "design was chosen by. Time to the first insertion where there is one; all: an "
            f"episode without one counting {seconds * result.summary['most']:.0f} s.",
            "Largest A_w: by differential evolution. Quickest: the fewest ticks of the designs "
            "that succeed at least as often as the one that the study begins from; surest: the "
            "most often; both by the optimum on validation starts.",
            "A_w and sigma_min at the design's own home. Optimum and policies move both robots "
            "at once.",
        ],
    )  # fmt: skip


def label(design: str, tests: pd.DataFrame) -> str:
    """What a chosen design is called."""
    why = str(tests["chosen"].iloc[0])
    for study, symbols in SYMBOLS.items():
        why = why.replace(f"{study}:", symbols)
    return why if "-" in design else "; ".join(filter(None, [design, why]))


def over(values: pd.Series[float]) -> Value:
    """A number of each seed as their mean, with its interval."""
    return measured(values.tolist(), lambda: (math.nan, math.nan))


def sentence(result: SearchResult, study: str) -> str:
    """Whether the area was a good proxy for success, by the rank correlation's interval."""
    mine = result.of_study(study)
    value = rank_correlation(mine["a_w"], mine["success"])
    if value.n < FEW:
        return f"{SYMBOLS[study]}: too few designs to say whether the area is a good proxy."
    if value.low >= GOOD:
        verdict = "a good proxy"
    elif value.high < FAIR:
        verdict = "no proxy"
    elif value.low >= FAIR:
        verdict = "a rough proxy"
    else:
        verdict = "at best a rough proxy"
    return f"{SYMBOLS[study]}: the area is {verdict} for the optimum's success."
