"""Whether the table of each search follows from its trainings' validation episodes."""

from __future__ import annotations

from pathlib import Path

from benchmarks.errors import BenchmarkError
from benchmarks.reporting.verify import Report, check_tables
from benchmarks.runs.store import RunFolder


def check(report: Report, results: Path, presets: list[str], docs: Path) -> None:
    """Verify every search under ``results``."""
    for path in sorted((results / "tune").glob("*/journal.log")):
        report.add(f"{path.parent}: table", check_search(path.parent))


def check_search(folder: Path) -> list[str]:
    """What of a search's table disagrees with its episodes.

    Raises:
        BenchmarkError: the extra ``tune`` is not installed.
    """
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
