"""The results of README.md and docs/results.md, written by a command from the stored runs.

A page holds a block of one of :data:`BODIES`, between two lines that name it; `verify` renders it
anew and compares.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.metrics import HOLES
from benchmarks.protocol.paper_values import PERFORMANCE
from benchmarks.reporting.pages import blocks
from benchmarks.reporting.results import Results
from benchmarks.reporting.rows import KNOWS
from benchmarks.reporting.tables.paper import build_tables
from benchmarks.reporting.tables.table import Cell, Table
from benchmarks.reporting.verdicts import headline_rows, sentences
from benchmarks.runs.store import Store

BEGIN: Final = "<!-- results:begin -->"
END: Final = "<!-- results:end -->"
SHORT: Final = ("safe", "memory", "printed", "uncertain", "geometry")  # the five of the README
# of the page of science: heading, sentences, tables, figures with what they show
SECTIONS: Final[tuple[tuple[str, tuple[str, ...], tuple[str, ...], dict[str, str]], ...]] = (
    ("What reproduces", ("safe", "memory", "printed", "ablation", "geometry"), ("performance",),
     {"performance_profile": "Share of test episodes above a score"}),
    ("Where learning pays, and where a script does as well", ("pays",), ("significance",), {}),
    ("The uncertain machine", ("uncertain",), ("uncertain",),
     {"errors": "Success over the size of the base's displacement"}),
    ("Noise on the observation", (), ("robustness",), {"robustness": "Success over noise"}),
    ("One component removed", (), ("ablation",),
     {"ablation_comparison": "Success with one component removed"}),
    ("The geometry", (), ("design", "geometry"), {}),
)  # fmt: skip


def short(store: Store, tables: list[Table]) -> str:
    """What README shows: where it comes from, five sentences, one table."""
    results, told = Results(store), sentences(Results(store))
    listed = "\n".join(f"- {told[topic]}" for topic in SHORT if topic in told)
    parts = [provenance(results, store.folder.name), headline_table(results).markdown(), listed]
    return "\n\n".join(part.strip() for part in parts if part)


def headline_table(results: Results) -> Table:
    """Table of at most eight rows: headlines, the best scripts with the same knowledge, ends."""
    header = ["Method", *KNOWS, "Success (%)", "Paper", "Holes", "Moves over optimum (%)"]
    made: list[list[Cell]] = []
    for row in headline_rows(results):
        printed = {} if results.uncertain(row.track) else PERFORMANCE["success"]
        paper = printed.get(row.method, "-")
        cells = [row.cell(row.success()), paper, row.cell(row.value(HOLES), HOLES.digits)]
        made.append([*row.head, *cells, row.cell(row.excess(results))])
    title = "Mean ± std over seeds of the test episodes, whose starts are the same for all"
    return Table("headline", title, header, made, left=(0, 1, 2))


def science(store: Store, tables: list[Table]) -> str:
    """What docs/results.md shows: sentences, tables and figures by question."""
    results, told = Results(store), sentences(Results(store))
    by_name = {table.name: table for table in tables}
    parts = [provenance(results, store.folder.name)]
    for heading, topics, names, figures in SECTIONS:
        parts.append(f"## {heading}")
        listed = "\n".join(f"- {told[topic]}" for topic in topics if topic in told)
        parts += [listed, *(by_name[name].markdown() for name in names)]
        parts += [
            f"![{alt}](../results/{store.folder.name}/figures/{name}.png)"
            for name, alt in figures.items()
            if (store.figures / f"{name}.png").is_file()
        ]
    return "\n\n".join(part.strip() for part in parts if part.strip())


BODIES: Final[dict[str, Callable[[Store, list[Table]], str]]] = {
    "results": short,
    "science": science,
}


def render(page: str, store: Store, tables: list[Table] | None = None) -> str:
    """A page with its block of results written afresh.

    Raises:
        BenchmarkError: the page has no block for it.
    """
    built = build_tables(store) if tables is None else tables
    for name, body in BODIES.items():
        if blocks.pattern(name).search(page):
            text = body(store, built)
            made = f"<!-- written by: python -m benchmarks readme --preset {store.folder.name} -->"
            begin = f"<!-- {name}:begin -->\n{made}"
            return blocks.fill(page, name, lambda _, text=text: text, begin)  # type: ignore[misc]
    names = " or ".join(f"<!-- {name}:begin --> and <!-- {name}:end -->" for name in BODIES)
    raise BenchmarkError(f"the page has no block between {names}; add both lines")


def provenance(results: Results, preset: str) -> str:
    """How many runs, how long, at which commit and on which machine."""
    missing = sum(results.planned.values()) - len(results.all())
    origin = blocks.provenance(preset, [run.folder for run in results.all()], max(0, missing))
    if not results.all():
        return origin
    return (
        f"{origin} Every number is recomputed from `results/{preset}` by "
        "`python -m benchmarks verify`."
    )


def rewrite(path: Path, store: Store) -> bool:
    """Rewrite the block of the page at ``path``; returns whether it changed.

    Raises:
        BenchmarkError: the file or its markers are missing.
    """
    return blocks.rewrite(path, lambda page: render(page, store))
