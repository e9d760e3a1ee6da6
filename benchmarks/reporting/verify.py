"""Check that stored runs are what their settings say, and that tables follow from them.

Every number is computed again from the rows of the runs and compared as text; nothing is trained.
The studies use the same functions on their own data.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Final

import pandas as pd

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.metrics import EXPLORING, GREEDY
from benchmarks.protocol.plan import DESIGN, Cell, explores
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.results import Result
from benchmarks.reporting.tables.table import Table
from benchmarks.runs.store import RunFolder, Store

TABLE_FILES: Final = (".csv", ".md", ".tex")


def check_tables(folder: Path, tables: Iterable[Table]) -> list[str]:
    """Differences between ``folder`` and these tables in all their forms."""
    wanted = {path: text for table in tables for path, text in table.files(folder).items()}
    problems = []
    for path, text in wanted.items():
        if path.is_file():
            problems += check_file(path, text, "the stored episodes")
        else:
            problems.append(f"{path} is missing; the command `tables` writes it")
    return problems + [
        f"{path} is made by no table of this version; delete it"
        for path in sorted(folder.glob("*"))
        if path.suffix in TABLE_FILES and path not in wanted
    ]


def check_runs(store: Store) -> list[str]:
    """Whether each complete run is what its settings say: rows, seeds, initial states, policy."""
    problems: list[str] = []
    starts: dict[tuple[object, ...], str] = {}
    for run in [*store.completed(), *store.entered()]:
        try:
            problems += [f"{run.path}: {problem}" for problem in _check_run(run, starts)]
        except BenchmarkError as error:
            problems.append(str(error))
        except (KeyError, TypeError) as error:
            problems.append(f"{run.path}: config.yaml or meta.json lacks {error}")
        except (AttributeError, ValueError) as error:  # text in place of a number or of a mapping
            problems.append(f"{run.path}: a value of its files is no value ({error})")
    return problems


def _check_run(run: RunFolder, starts: dict[tuple[object, ...], str]) -> list[str]:
    config, meta = run.config(), run.meta()
    cell = Cell(**config["cell"])
    if cell.id != run.id or meta["cell"] != run.id:
        return [f"holds the run '{cell.id}' by its config.yaml, '{meta['cell']}' by its meta.json"]
    if cell.method == DESIGN:
        run.rows("design")
        return []
    result = Result.read(run)
    if cell.learns and "entry" not in config:  # whatever its method is called
        _ = result.curve  # an error if it is missing
    problems = [*check_meta(run), *_check_episodes(result, cell, starts)]
    if run.policy.is_file() and run.policy_digest() != meta["training"].get("policy_sha256"):
        problems.append("policy.zip is not the policy whose digest its meta.json has")
    return problems


def check_meta(run: RunFolder) -> list[str]:
    """Whether meta.json has what pages and `plan` need."""
    _ = run.seconds(), run.seconds("cpu")  # an error if one is missing
    return [f"meta.json lacks '{k}'" for k in ("commit", "dirty", "machine") if k not in run.meta()]


def _check_episodes(result: Result, cell: Cell, starts: dict[tuple[object, ...], str]) -> list[str]:
    """Whether each level holds the seed's test episodes, and no level is missing."""
    problems = []
    evaluation, rows = result.config["evaluation"], result.episodes
    stream = evaluation.get("stream", "test")
    seeds = episode_seeds(cell.seed, evaluation["episodes"], stream)
    name, wanted = _levels(result, cell)
    column = rows[name] if name in rows else pd.Series([], dtype=float)
    stored = sorted(column.astype(float).unique().tolist())
    # as episodes.csv holds a number
    if stored != sorted(float(f"{value:.7g}") for value in wanted):
        problems.append(f"episodes.csv has {name} {stored}, not {wanted}")
    acting = {acting for _, _, acting in result.levels}
    brought = "entry" in result.config
    both = evaluation.get("exploring") and explores(cell.method) and not brought
    wanted_acting = [EXPLORING, GREEDY] if both else [GREEDY]
    if sorted(acting) != wanted_acting:
        problems.append(f"episodes.csv has acting {sorted(acting)}, not {wanted_acting}")
    task = str(result.config.get("track", {}).get("task"))
    where_from = (cell.geometry, task, bool(result.error))
    for (noise, error, acts), episodes in result.levels.items():
        where = f" at noise {noise}, error {error:g} mm, acting {acts}"
        problems += check_seeds(episodes, "reset_seed", seeds, where)
        for seed, start in zip(episodes["reset_seed"], episodes["start"].astype(str), strict=True):
            before = starts.setdefault((*where_from, error, seed), start)
            if before != start:
                problems.append(
                    f"episodes.csv: the episode of seed {seed} began at {start}, in another run "
                    f"at {before}"
                )
                return problems
    return problems


def check_seeds(rows: pd.DataFrame, column: str, seeds: list[int], where: str = "") -> list[str]:
    """Whether the rows of episodes.csv have the test episodes' numbers and seeds."""
    if rows["episode"].tolist() != list(range(len(seeds))):
        return [
            f"episodes.csv has {len(rows)} rows{where}, not one for each of the {len(seeds)} test "
            "episodes"
        ]
    wrong = rows[column].tolist() != seeds
    return [f"episodes.csv has rows{where} of other than the test seeds"] if wrong else []


def _levels(result: Result, cell: Cell) -> tuple[str, list[float]]:
    """A column of the episodes, and the levels that must be in it."""
    evaluation = result.config["evaluation"]
    if result.error:
        return "error", evaluation["errors"]
    entry = result.config.get("entry")  # a model has a digest, a planner none
    observed = entry["sha256"] if entry else cell.learns or cell.method.endswith("_observed")
    return "noise", evaluation["noise"] if observed else [0.0]  # the others see the true state


def check_file(path: Path, wanted: str, source: str) -> list[str]:
    """A sentence on the first line that differs from what the source makes now, if any."""
    stored = path.read_text(encoding="utf-8") if path.is_file() else ""
    if stored == wanted:
        return []
    old_lines, new_lines = stored.splitlines(), wanted.splitlines()
    where = f"{len(old_lines)} lines stored, {len(new_lines)} recomputed"
    for number, (old, new) in enumerate(zip(old_lines, new_lines, strict=False), start=1):
        if old != new:
            where = f"line {number}: stored {old!r}, recomputed {new!r}"
            break
    return [f"{path} differs from {source} ({where})"]
