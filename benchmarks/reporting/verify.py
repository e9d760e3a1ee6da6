"""Check that tables, README and docs agree with the stored data they were made from.

Every number is made again from the rows of the runs and compared as text; nothing is trained.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import pandas as pd

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import DESIGN, Cell
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.pages import includes
from benchmarks.reporting.pages.readme import results_block, split
from benchmarks.reporting.tables.paper import build_tables
from benchmarks.reporting.tables.table import Table
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies import audit, failures
from benchmarks.studies.design import docs as design_docs
from benchmarks.studies.design.store import DesignStore, stored_geometry_rows

WRITTEN_BY: Final = re.compile(r"<!-- written by: python -m benchmarks readme --preset (\S+) -->")
TABLE_FILES: Final = (".csv", ".md", ".tex")


@dataclass
class Report:
    """What was checked, in words, and a sentence for each thing that disagrees."""

    checked: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def verify_all(results: Path, presets: list[str], readme: Path, docs: Path) -> Report:
    """Check the stores of ``presets`` (all under ``results`` if none is named), README and docs.

    Args:
        results: the results folder.
        presets: stores to check.
        readme: checked if it holds the block of one of these stores.
        docs: folder of pages; the blocks of the design study are checked if there is one.

    Raises:
        BenchmarkError: a store is missing or of another schema.
    """
    report = Report()
    names = presets or sorted(path.parent.name for path in results.glob("*/store.json"))
    if not names:
        raise BenchmarkError(f"{results} has no results; run: python -m benchmarks run")
    blocks = presets_of(readme)
    for name in names:
        store = Store.open(results, name)
        found = check_runs(store)
        if not found:  # rows that cannot be trusted make no tables
            found = verify(store, readme)
        report.problems += found
        report.checked.append(f"{store.folder}: tables of {len(store.completed())} runs")
        if name in blocks:
            report.checked.append(f"{readme}: its results, of preset {name}")
    if not any(name in names for name in blocks):
        report.checked.append(f"{readme}: shows none of these presets, not checked")
    report.problems += [
        f"{readme} shows preset '{name}', but {results / name} has no results"
        for name in blocks
        if not presets and name not in names
    ]
    if (results / "design" / "meta.json").is_file():
        report.problems += check_design(results, docs)
        report.checked.append(f"{results / 'design'}: table, and its blocks in {docs}")
    report.problems += check_summaries(results, names)
    for path in sorted((results / "classic").glob("*/store.json")):
        report.problems += check_classic(path.parent, docs)
        report.checked.append(f"{path.parent}: tables, and its block in {docs}")
    for path in sorted((results / "tune").glob("*/journal.log")):
        report.problems += check_search(path.parent)
        report.checked.append(f"{path.parent}: table")
    pages = [path for path in (readme, *sorted(docs.glob("*.md"))) if path.is_file()]
    for path in pages:
        of = {Path(name).parts[1] for name in includes.included(path.read_text(encoding="utf-8"))}
        if of and (not presets or of.intersection(presets)):
            report.problems += check_includes(results, path)
            report.checked.append(f"{path}: what it includes")
    return report


def verify(store: Store, readme: Path | None = None) -> list[str]:
    """Recompute every table of one store; returns one sentence for each thing that disagrees.

    Args:
        store: the results to check.
        readme: a README whose results block is checked too, if it was made from this store.
    """
    tables = build_tables(store)
    problems = check_tables(store.tables, tables)
    if readme is not None and store.folder.name in presets_of(readme):
        above, block, _ = split(readme.read_text(encoding="utf-8"))
        wanted = results_block(store, tables)
        if block != wanted:
            lines = above.count("\n")
            problems.append(_differs(readme, block, wanted, "the stored episodes", lines))
    return problems


def check_tables(folder: Path, tables: list[Table]) -> list[str]:
    """Whether ``folder`` holds these tables in all their forms, and no other."""
    problems = []
    made = set()
    for table in tables:
        for suffix, text in table.forms().items():
            path = folder / f"{table.name}{suffix}"
            made.add(path)
            if not path.is_file():
                problems.append(f"{path} is missing; the command `tables` writes it")
            elif (stored := path.read_text(encoding="utf-8")) != text:
                problems.append(_differs(path, stored, text, "the stored episodes"))
    problems += [
        f"{path} is made by no table of this version; delete it"
        for path in sorted(folder.glob("*"))
        if path.suffix in TABLE_FILES and path not in made
    ]
    return problems


def presets_of(readme: Path) -> list[str]:
    """The presets whose results a README shows."""
    if not readme.is_file():
        return []
    return WRITTEN_BY.findall(readme.read_text(encoding="utf-8"))


def check_runs(store: Store) -> list[str]:
    """Whether each complete run is what its settings say: its rows, seeds and initial states."""
    problems: list[str] = []
    starts: dict[tuple[str, int], str] = {}
    for run in [*store.completed(), *store.entered()]:
        try:
            problems += [f"{run.path}: {problem}" for problem in _check_run(run, starts)]
        except BenchmarkError as error:
            problems.append(str(error))
        except (KeyError, TypeError) as error:
            problems.append(f"{run.path}: config.yaml or meta.json lacks {error}")
    return problems


def _check_run(run: RunFolder, starts: dict[tuple[str, int], str]) -> list[str]:
    config, meta = run.config(), run.meta()
    cell = Cell(**config["cell"])
    if cell.id != run.id or meta["cell"] != run.id:
        return [f"holds the run '{cell.id}' by its config.yaml, '{meta['cell']}' by its meta.json"]
    if cell.method == DESIGN:
        run.rows("design")
        return []
    if cell.learns:
        run.rows("curve")
    noisy = cell.learns or bool(config.get("entry", {}).get("sha256"))
    evaluation = config["evaluation"]
    levels = evaluation["noise"] if noisy else [0.0]  # planners see the true state
    return _check_episodes(cell, evaluation["episodes"], levels, run.rows("episodes"), starts)


def _check_episodes(
    cell: Cell,
    episodes_per_seed: int,
    levels: list[float],
    rows: pd.DataFrame,
    starts: dict[tuple[str, int], str],
) -> list[str]:
    problems = []
    seeds = episode_seeds(cell.seed, episodes_per_seed)
    found = sorted(rows["noise"].astype(float).unique().tolist())
    if found != sorted(levels):
        problems.append(f"episodes.csv has noise {found}, not {levels}")
    for noise, group in rows.groupby("noise"):
        episodes = group.sort_values("episode")
        if episodes["episode"].tolist() != list(range(len(seeds))):
            problems.append(
                f"episodes.csv has {len(episodes)} rows at noise {noise}, not one for each of the "
                f"{len(seeds)} test episodes"
            )
        elif episodes["reset_seed"].tolist() != seeds:
            problems.append(f"episodes.csv has rows at noise {noise} of other than the test seeds")
    for seed, start in zip(rows["reset_seed"], rows["start"].astype(str), strict=True):
        if starts.setdefault((cell.geometry, seed), start) != start:
            problems.append(
                f"episodes.csv: the episode of seed {seed} began at {start}, in another run at "
                f"{starts[cell.geometry, seed]}"
            )
            break
    return problems


def check_summaries(results: Path, names: list[str]) -> list[str]:
    """Whether the audit's and the failure maps' tables follow from their rows."""
    pairs = [
        (path, failures.summary(failures.read(path)))
        for name in names
        for path in sorted((results / name / "failures").glob("*.csv"))
    ]
    scripted = results / "audit" / "scripted.csv"
    if scripted.is_file():
        pairs.append((scripted, audit.markdown(pd.read_csv(scripted))))
    problems = []
    for path, wanted in pairs:
        table = path.with_suffix(".md")
        stored = table.read_text(encoding="utf-8") if table.is_file() else ""
        if stored != wanted:
            problems.append(_differs(table, stored, wanted, f"the rows of {path.name}"))
    return problems


def check_design(results: Path, docs: Path) -> list[str]:
    """Whether the design study's table follows from its runs, and the docs from its data."""
    store = DesignStore(results)
    problems = []
    rows = {row["metric"]: row for row in store.rows("table").to_dict("records")}
    runs = store.rows("runs")
    for end, column in (("initial", "a_w_initial"), ("optimized", "a_w")):
        stored, wanted = float(rows["workspace"][f"{end}_mean"]), float(runs[column].mean())
        if abs(stored - wanted) > 1e-6:
            problems.append(
                f"{store.folder / 'table.csv'} gives {stored:.7g} as the {end} workspace, the mean "
                f"of runs.csv is {wanted:.7g}"
            )
    shown = {row["metric"]: row for row in stored_geometry_rows(results)}
    for metric, row in rows.items():
        problems += [
            f"{store.folder}: table.json gives {shown[metric][end]} as {metric}, {end}, "
            f"table.csv {row[end]}"
            for end in ("initial", "optimized")
            if shown[metric][end] != row[end]
        ]
    for path in sorted(docs.glob("*.md")):
        page = path.read_text(encoding="utf-8")
        wanted_page = design_docs.rewrite(page, store)
        if page != wanted_page:
            problems.append(_differs(path, page, wanted_page, f"the data in {store.folder}"))
    return problems


def check_classic(folder: Path, docs: Path) -> list[str]:
    """Whether a store of the classic tasks has the tables of its runs, and the docs its block."""
    from benchmarks.studies.classic import docs as block
    from benchmarks.studies.classic.presets import load_preset
    from benchmarks.studies.classic.results import Results
    from benchmarks.studies.classic.tables import build_tables as build_classic

    store = Store.open(folder.parent, folder.name)
    classic = Results(load_preset(folder.name), store)
    problems = check_tables(store.tables, build_classic(classic))
    for path in sorted(docs.glob("*.md")):
        page = path.read_text(encoding="utf-8")
        if block.begin(folder.name) in page:
            root = Path(os.path.relpath(folder, docs)).as_posix()
            wanted = block.rewrite(page, classic, root)
            if page != wanted:
                problems.append(_differs(path, page, wanted, f"the runs in {folder}"))
    return problems


def check_search(folder: Path) -> list[str]:
    """Whether the table of a search follows from its trainings' validation episodes."""
    try:
        from benchmarks.studies.tuning.study import Search
        from benchmarks.studies.tuning.tune import results_table
    except ImportError as error:
        raise BenchmarkError(f"{folder} cannot be checked without the extra 'tune'") from error
    settings = RunFolder(folder).config()["search"]
    path = folder / "search.md"
    title = path.read_text(encoding="utf-8").split("**")[1] if path.is_file() else ""
    search = Search(folder, settings["sampler"], None)
    return check_tables(folder, [results_table(search, folder, settings["seeds"], title)])


def check_includes(results: Path, path: Path) -> list[str]:
    """Whether the files that a page includes are still what the page shows."""
    page = path.read_text(encoding="utf-8")
    try:
        wanted = includes.render(page, results, str(path))
    except BenchmarkError as error:
        return [str(error)]
    if page == wanted:
        return []
    return [_differs(path, page, wanted, "the files that it includes")]


def _differs(path: Path, stored: str, wanted: str, source: str, above: int = 0) -> str:
    """A sentence on the first line that differs; ``above`` lines come before ``stored``."""
    old_lines, new_lines = stored.splitlines(), wanted.splitlines()
    where = f"{len(old_lines)} lines stored, {len(new_lines)} recomputed"
    for number, (old, new) in enumerate(zip(old_lines, new_lines, strict=False), start=1 + above):
        if old != new:
            where = f"line {number}: stored {old!r}, recomputed {new!r}"
            break
    return f"{path} differs from {source} ({where})"
