"""Tables that pages include are the stored ones, and the stored ones follow from their rows."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.methods.scripts import SCRIPTS
from benchmarks.reporting.pages import includes
from benchmarks.reporting.verify import Report
from benchmarks.runs.store import write_csv, write_text
from benchmarks.studies import audit

PAGE = """# A page

<!-- include:begin results/audit/scripted.md (written by: python -m benchmarks readme) -->
<!-- include:end -->

And on.
"""


def store(folder: Path) -> Path:
    results = folder / "results"
    rows: list[dict[str, object]] = [
        {"track": "tuned", "script": script, "start": i, "return": 10.0 + k + i,
         "discounted": 5.0, "holes": 1, "moves": 30}
        for k, script in enumerate(SCRIPTS) for i in range(2)
    ]  # fmt: skip
    write_csv(results / "audit" / "scripted.csv", rows)
    import pandas as pd

    text = audit.markdown(pd.read_csv(results / "audit" / "scripted.csv"))
    write_text(results / "audit" / "scripted.md", text)
    return results


def test_an_include_is_filled_and_filled_again(tmp_path: Path) -> None:
    results = store(tmp_path)
    docs = tmp_path / "docs"
    write_text(docs / "page.md", PAGE)
    assert includes.rewrite_all(docs, results) == [docs / "page.md"]
    filled = (docs / "page.md").read_text(encoding="utf-8")
    assert "| tuned | insert | 10.5 ± 0.7 | 5.0 | 1.00 | 1.00 |" in filled
    assert filled.startswith("# A page\n")
    assert filled.endswith("\n\nAnd on.\n")
    includes.rewrite_all(docs, results)
    assert (docs / "page.md").read_text(encoding="utf-8") == filled


def test_what_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(BenchmarkError, match=r"includes results/audit/scripted.md, which is no"):
        includes.render(PAGE, tmp_path, "page.md")
    outside = PAGE.replace("results/audit/scripted.md", "results/../page.md")
    with pytest.raises(BenchmarkError, match="no file of"):
        includes.render(outside, store(tmp_path), "page.md")


def check(results: Path) -> list[str]:
    report = Report()
    audit.check(report, results, [], results)
    return report.problems


def test_a_changed_digit_is_seen(tmp_path: Path) -> None:
    results = store(tmp_path)
    assert check(results) == []
    table = results / "audit" / "scripted.md"
    write_text(table, table.read_text(encoding="utf-8").replace("10.5", "10.6"))
    (problem,) = check(results)
    assert problem.startswith(f"{table} differs from the rows of scripted.csv (line 3")
