"""The results of README.md and of two pages of docs/: sentences, tables and figures of a store."""

from __future__ import annotations

from typing import Final

from benchmarks.reporting.blocks import provenance
from benchmarks.reporting.results import Results
from benchmarks.reporting.tables.paper import build_tables
from benchmarks.reporting.tables.table import Number, Table, TableCell
from benchmarks.reporting.verdicts import of_six, sentences
from benchmarks.runs.store import Store

PAPER: Final = ("Performance", "Ablation", "Geometry", "As printed")  # docs/results.md
SHORT: Final = ("performance", "components", "geometry")  # the sentences of the README
# of the page of science: heading, sentences, tables, figures with what they show
SECTIONS: Final[tuple[tuple[str, tuple[str, ...], tuple[str, ...], dict[str, str]], ...]] = (
    ("Performance", ("performance",), ("performance", "controls"),
     {"performance_profile": "Share of test episodes above a score"}),
    ("Ablation", ("components",), ("ablation",),
     {"ablation_comparison": "Success with one component removed"}),
    ("Geometry", ("geometry",), ("geometry", "design"), {}),
    ("As printed", ("printed",), (), {}),
    ("All methods", (), ("leaderboard", "significance"), {}),
    ("Noise on the observation", (), ("robustness",), {"robustness": "Success over noise"}),
    ("The uncertain machine", ("uncertain",), ("uncertain",),
     {"errors": "Success over the size of the base's displacement"}),
)  # fmt: skip


def short(store: Store) -> str:
    """What README shows: three sentences and a table of six rows."""
    results = Results(store)
    report = sentences(results)
    parts = [report[topic] for topic in SHORT if topic in report]
    return "\n\n".join(part.strip() for part in [*parts, six(results).markdown()])


def six(results: Results) -> Table:
    """The README's table: success rates, paper and ours."""
    made: list[list[TableCell]] = [
        [name, paper, Number(value, digits) if value else "missing"]
        for name, paper, value, digits in of_six(results)
    ]
    return Table("six", "Success rate (%) on the test episodes", ["Method", "Paper", "Ours"], made)


def science(store: Store, beyond: bool = False) -> str:
    """Sentences, tables and figures by question: the paper's, or those beyond the paper."""
    results, report = Results(store), sentences(Results(store))
    by_name = {table.name: table for table in build_tables(store)}
    parts = []
    for heading, topics, names, figures in SECTIONS:
        if beyond is (heading in PAPER):
            continue
        shown = [report[topic] for topic in topics if topic in report]
        shown += [by_name[name].markdown() for name in names if by_name[name].rows]
        if not shown:
            continue
        parts += [f"## {heading}", *shown]
        parts += [
            f"![{alt}](../results/{store.folder.name}/figures/{name}.png)"
            for name, alt in figures.items()
            if (store.figures / f"{name}.png").is_file()
        ]
    if not beyond:
        parts.append(origin(results, store.folder.name))
    return "\n\n".join(part.strip() for part in parts if part.strip())


def origin(results: Results, preset: str) -> str:
    """How many runs, how long, at which commit and on which machine."""
    missing = sum(results.planned.values()) - len(results.all())
    text = provenance(preset, [run.folder for run in results.all()], max(0, missing))
    if not results.all():
        return text
    return (
        f"{text} Every number is recomputed from `results/{preset}` by "
        "`python -m benchmarks verify`."
    )
