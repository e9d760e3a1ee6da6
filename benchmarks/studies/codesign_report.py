"""The stored co-design, the designs chosen by it, its tables, sentences and figure."""

import math
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from numpy.typing import ArrayLike
from scipy.stats import pearsonr, rankdata

from benchmarks.protocol.metrics import METRICS, SUCCESS
from benchmarks.reporting.figures.style import PALETTE, canvas, legend_below
from benchmarks.reporting.results import Results
from benchmarks.reporting.stats import Value, bootstrap, over_seeds
from benchmarks.reporting.tables.table import Number, Table, TableCell
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.base import read_stored
from coop_env.simulation.insertion_task import PAPER_TASK

#: the studies and what each varies
STUDIES: Final = {
    "lambdas": ("lambda1", "lambda2"),
    "heights": ("distal_length", "home_heave"),
}
SYMBOLS: Final = {"lambdas": "(λ1, λ2)", "heights": "(L2, home)"}
BASE: Final = "optimized"  # where all studies begin
ALL: Final = "all"  # its study
OF_ONE: Final = "central"  # the track of the policies on chosen designs: both robots at once
MOST: Final = 300  # ticks of an episode, the task's default
POLICIES: Final = "policies"
#: least rank correlations for which the area counts as a good proxy, and as one at all
GOOD, FAIR = 0.8, 0.3
FEW: Final = 20  # no verdict on fewer designs


class SearchResult:
    """The files of a co-design: ``asked``, ``summary`` (codesign.json), ``designs`` by name."""

    def __init__(self, folder: Path) -> None:
        self.folder, own = folder, RunFolder(folder)
        self.asked = own.config()
        self.summary: dict[str, Any] = read_stored(folder / "codesign.json")
        self.designs = own.rows("designs").set_index("design")

    @cached_property
    def chosen(self) -> pd.DataFrame:
        """The optimum on test starts, a row for each chosen design and seed."""
        return RunFolder(self.folder).rows("chosen").fillna({"chosen": ""})

    def row(self, design: str) -> dict[Any, Any]:
        """The row of a design."""
        return {"design": design, **self.designs.loc[design].to_dict()}

    def of_study(self, study: str) -> pd.DataFrame:
        """The designs of a study, and the one where it begins."""
        return self.designs[self.designs["study"].isin([study, ALL])]

    def front(self, study: str) -> pd.DataFrame:
        """The Pareto front of a study, the quickest design first."""
        rows = self.of_study(study)
        return rows[on_front(rows, self.summary["floor"])].sort_values("ticks")

    def choose(self) -> dict[str, str]:
        """The designs to be tested, and why: ``study: reason, reason; study: reason``."""
        named = self.designs.index[~self.designs.index.str.contains("-")]
        chosen: dict[str, list[str]] = {str(name): [] for name in named}
        success = float(self.designs.loc[BASE, "success"])  # type: ignore[arg-type]
        for study in STUDIES:
            rows, reasons = self.of_study(study), dict[str, list[str]]()
            picks = {
                "largest A_w": f"{study}-area",
                "quickest": quickest(rows, success),
                "surest": surest(rows),
            }
            for why, design in picks.items():
                reasons.setdefault(design, []).append(why)
            for design, whys in reasons.items():
                chosen.setdefault(design, []).append(f"{study}: {', '.join(whys)}")
        return {design: "; ".join(why) for design, why in chosen.items()}

    @cached_property
    def policies(self) -> Results:
        """The policies that were trained on the chosen designs."""
        return Results(Store(self.folder, POLICIES))


def on_front(rows: pd.DataFrame, floor: float) -> np.ndarray:
    """Rows on the Pareto front of success and ticks, among those at or above the floor."""
    success, ticks = rows["success"].to_numpy(), rows["ticks"].to_numpy()
    at_least = (success[:, None] >= success) & (ticks[:, None] <= ticks)
    better = at_least & ((success[:, None] > success) | (ticks[:, None] < ticks))
    return np.asarray((success >= floor) & ~better.any(axis=0))


def quickest(rows: pd.DataFrame, success: float) -> str:
    """Name of the design with the fewest ticks among those with at least this success, %."""
    sure = rows[rows["success"] >= success]
    return str(sure.sort_values(["ticks", "success"], ascending=[True, False]).index[0])


def surest(rows: pd.DataFrame) -> str:
    """Name of the design with the highest success; ties go to the fewest ticks."""
    return str(rows.sort_values(["success", "ticks"], ascending=[False, True]).index[0])


def rank_correlation(x: ArrayLike, y: ArrayLike) -> Value:
    """Spearman's rank correlation over pairs, with a 95 % interval by resampling the pairs.

    NaN where there are fewer than :data:`FEW` pairs, or one side is constant.
    """
    pairs = np.stack([np.asarray(x, float), np.asarray(y, float)])
    pairs = pairs[:, np.isfinite(pairs).all(axis=0)]
    if pairs.shape[1] < FEW or (np.ptp(pairs, axis=1) == 0.0).any():
        return Value(math.nan, n=0)

    def rho(x: Any, y: Any, axis: int = -1) -> Any:
        return pearsonr(*(rankdata(each, axis=axis) for each in (x, y)), axis=axis).statistic

    low, high = bootstrap([*pairs], rho, paired=True)
    return Value(float(rho(*pairs)), n=pairs.shape[1], low=low, high=high)


def to_markdown(result: SearchResult) -> str:
    """The whole report as Markdown."""
    summary, machine = result.summary, result.summary["machine"]
    runs = Store(result.folder, POLICIES).completed()
    spent = summary["cpu_seconds"] + sum(float(run.meta()["cpu_seconds"]) for run in runs)
    parts = [table(result).markdown().strip() for table in (_searched, _designs)]
    parts += [
        f"{result.asked['starts']} validation starts for each design, the same seeds for all; "
        f"{spent / 60.0:.0f} core-minutes of searches and trainings on "
        f"{machine['machine']['processor']}, begun at commit {machine['commit'][:9]}.",
        "![Fronts, chosen designs, and success by area](../results/codesign/figures/fronts.png)",
    ]
    return "\n\n".join(parts)


def _searched(result: SearchResult) -> Table:
    rows: list[list[TableCell]] = []
    for study, of in result.summary["studies"].items():
        bounds = (f"{name} {low:g} to {high:g}" for name, (low, high) in of["bounds"].items())
        mine, skipped = result.of_study(study), sum(of["skipped"].values())
        counts = ((mine["study"] == study).sum(), skipped, len(result.front(study)))
        value = rank_correlation(mine["a_w"], mine["success"])
        proxy = f"{value.mean:.2f} {value.interval_text(2)}: {verdict(value)}"
        name = [SYMBOLS[study], ", ".join(bounds), *map(str, counts)]
        rows.append([*name, proxy if value.n else "too few designs"])
    notes = [
        "Skipped designs have no score: their lengths break the paper's constraints, they cannot "
        "take their home pose, or have too little workspace for a start state.",
        "Front: success against mean ticks over the starts that were solved, of designs that "
        f"solve at least {result.summary['floor']:.1f} %, what the worse of the two given designs "
        "solves. A design that solves few starts solves the near ones, and so looks quick.",
        "Proxy: Spearman's rank correlation of A_w and the optimum's success over designs; 95 % "
        f"interval by resampling designs. Good from {GOOD:g}, rough from {FAIR:g}.",
    ]
    title = "Designs by the exact optimum, both robots moving at once"
    head = "Study | Bounds | Scored | Skipped | On the front | A_w as a proxy for success"
    return Table("search", title, head.split(" | "), rows, notes, left=(0, 1))


def verdict(value: Value) -> str:
    """The verdict on the area as a proxy, by the rank correlation's interval."""
    if value.low >= FAIR:
        return "good" if value.low >= GOOD else "rough"
    return "none" if value.high < FAIR else "at best rough"


def _designs(result: SearchResult) -> Table:
    rows: list[list[TableCell]] = []
    seconds = PAPER_TASK.dt
    for design, tests in result.chosen.groupby("design", sort=False):
        of = result.designs.loc[design]
        group = result.policies.group("rainbow", OF_ONE, str(design))
        margin, why = tests[["sigma_cone", "chosen"]].iloc[0]
        for study, symbols in SYMBOLS.items():
            why = why.replace(f"{study}:", symbols)
        named = [] if "-" in str(design) else [str(design)]
        rows.append(
            [
                "; ".join(filter(None, [*named, why])),
                *(f"{of[name]:.3f}" for name in STUDIES["lambdas"]),
                *(f"{1e3 * of[name]:.1f}" for name in STUDIES["heights"]),
                f"{of['a_w']:.3f}",
                "-" if math.isnan(margin) else f"{margin:.3f}",
                Number(over_seeds(tests["success"])),
                Number(over_seeds(seconds * tests["ticks"]), 2),
                Number(over_seeds(seconds * tests["ticks_all"]), 2),
                Number(group.value(SUCCESS)),
                Number(group.value(METRICS["time_first"]), 2),
            ]
        )
    notes = [
        f"Mean ± std over seeds, of {result.asked['seeds']} times 100 test starts, which no "
        "design was chosen by. Time to the first insertion where there is one; all: an "
        f"episode without one counting {seconds * result.summary['most']:.0f} s.",
        "Largest A_w: by differential evolution. Quickest: the fewest ticks of the designs "
        "that succeed at least as often as the one that the study begins from; surest: the "
        "most often; both by the optimum on validation starts.",
        "A_w and sigma_min at the design's own home. Optimum and policies move both robots "
        "at once.",
    ]
    head = (
        "Design | λ1 | λ2 | L2 (mm) | Home (mm) | A_w (rad²) | Least sigma_min in 28° | "
        "Optimum: success (%) | time (s) | time, all (s) | Policy: success (%) | Policy: time (s)"
    )
    return Table("designs", "The designs on test starts", head.split(" | "), rows, notes)


def fronts(result: SearchResult) -> Figure:
    """For each study success over ticks with the Pareto front, and success over the area."""
    figure, panels = canvas(len(STUDIES), 2, (7.2, 6.6))
    for row, study in enumerate(STUDIES):
        rows, front = result.of_study(study), result.front(study)
        of_ticks, of_area = panels[2 * row : 2 * row + 2]
        of_ticks.step(front["ticks"], front["success"], where="post", label="front", lw=1.2)
        chosen = result.chosen.groupby("design", sort=False)["chosen"].first()
        mine = [str(d) for d in chosen.index if d in rows.index or "-" not in str(d)]
        for axes, x in ((of_ticks, "ticks"), (of_area, "a_w")):
            axes.plot(rows[x], rows["success"], ".", color="0.75", ms=3, label="designs")
            for colour, design in zip(PALETTE[1:], mine, strict=False):
                of, label = result.designs.loc[design], chosen[design].partition(": ")[2] or design
                axes.plot(of[x], of["success"], "o", color=colour, label=label)
            axes.set(ylabel="success (%)", title=f"{SYMBOLS[study]}: the optimum")
        ticks = front["ticks"] if len(front) else rows["ticks"]
        of_ticks.set(
            xlabel="mean ticks of the starts solved", xlim=(min(ticks) - 1, max(ticks) + 1)
        )
        of_ticks.set_ylim(result.summary["floor"] - 6.0, 100.5)
        of_area.set_xlabel("$A_w$ (rad²)")
    return legend_below(figure, panels)
