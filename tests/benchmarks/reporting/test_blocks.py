"""Generated blocks of pages: includes, blocks of which the data are missing, the gallery."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pandas as pd
import pytest

from benchmarks.cli import parser
from benchmarks.errors import BenchmarkError
from benchmarks.methods.scripts import SCRIPTS
from benchmarks.reporting import blocks
from benchmarks.runs.store import write_csv, write_text
from benchmarks.studies import audit, catalogue

ROOT = Path(__file__).resolve().parents[3]
GALLERY = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
INCLUDE = "<!-- include:begin results/audit/scripted.md (written by: x) -->\n<!-- include:end -->\n"


def store(folder: Path) -> Path:
    """Results with a table of scripts."""
    results = folder / "results"
    rows: list[dict[str, object]] = [
        {"track": "tuned", "script": script, "start": i, "return": 10.0 + k + i,
         "discounted": 5.0, "holes": 1, "moves": 30}
        for k, script in enumerate(SCRIPTS) for i in range(2)
    ]  # fmt: skip
    write_csv(results / "audit" / "scripted.csv", rows)
    table = audit.markdown(pd.read_csv(results / "audit" / "scripted.csv"))
    write_text(results / "audit" / "scripted.md", table)
    return results


def test_an_include_is_filled_and_filled_again(tmp_path: Path) -> None:
    results, page = store(tmp_path), tmp_path / "docs" / "page.md"
    write_text(page, f"# A page\n\n{INCLUDE}\nAnd on.\n")
    known = {"include": blocks.include(results)}
    assert blocks.rewrite(results, known) == [page]
    filled = page.read_text(encoding="utf-8")
    line = "| tuned | insert | 10.5 ± 0.7 | 5.0 | 1.00 | 1.00 |"
    assert line in " ".join(filled.split())
    assert filled.startswith("# A page\n")
    assert filled.endswith("\n\nAnd on.\n")
    assert blocks.rewrite(results, known) == []
    assert [problems for _, problems in blocks.check(results, known)] == [[]]


@pytest.mark.parametrize("name", ["results/audit/none.md", "results/../page.md", "page.md"])
def test_an_include_of_what_is_not_there_is_named(name: str, tmp_path: Path) -> None:
    read = blocks.include(store(tmp_path))
    with pytest.raises(BenchmarkError, match="is no file of"):
        read(name)


def test_a_block_without_its_data_stays() -> None:
    def missing(_: str) -> str:
        raise KeyError

    page = "a\n<!-- one:begin x -->\nold\n<!-- one:end -->\nb\n"
    assert blocks.render(page, {"one": missing}) == page
    assert "\n\nx\n\n" in blocks.render(page, {"one": lambda said: said})


def test_every_committed_picture_is_shown() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "results/*.png", "results/*.gif"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    shown = set(re.findall(r"!\[\]\(\.\./(results/[^)]+)\)", GALLERY))
    assert {*listed.stdout.split()} - shown == set()


def test_the_commands_of_the_gallery_exist() -> None:
    commands = re.findall(r"^ {4}python -m benchmarks (\w+) (.*)", GALLERY, re.MULTILINE)
    assert len(commands) >= 8
    for verb, words in commands:
        if verb == "study":
            assert words.split()[0] in catalogue.STUDIES
        else:
            parser().parse_args([verb, *words.split()])


def test_a_changed_digit_is_seen(tmp_path: Path) -> None:
    results = store(tmp_path)
    assert audit.Audit.problems(results) == []
    table = results / "audit" / "scripted.md"
    write_text(table, table.read_text(encoding="utf-8").replace("10.5", "10.6"))
    (problem,) = audit.Audit.problems(results)
    assert problem.startswith(f"{table} differs from the data in")
    assert "(line 5" in problem
