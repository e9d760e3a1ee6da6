"""``study physics`` measures, stores, prints, and its tables can be checked."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks.cli import main as command
from benchmarks.reporting import blocks
from benchmarks.studies.robots.physics import Physics

SMALL = ["--poses", "4", "--steps", "16", "--rounds", "1", "--memory-steps", "20"]


def test_the_command_writes_what_it_prints(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra physics)")
    docs, results = tmp_path / "docs", tmp_path / "results"
    docs.mkdir()
    page = docs / "physics.md"
    page.write_text("# Page\n\n<!-- physics:begin -->\n<!-- physics:end -->\n", encoding="utf-8")
    assert Physics.main(["--results", str(results), *SMALL]) == 0
    folder = results / "physics"
    text = (folder / "physics.md").read_text("utf-8")
    assert text.strip() in capsys.readouterr().out
    assert text.strip() in page.read_text("utf-8")
    assert (folder / "model" / "coop_insertion.xml").is_file()
    found = json.loads((folder / "physics.json").read_text("utf-8"))
    for geometry in ("initial", "optimized"):
        assert 0.0 < found["parts"][f"errors, {geometry}"]["tip"]["largest"] < 5e-5
    assert min(found["parts"]["speed"].values()) > 0.0
    assert not any(found for _, found in blocks.check(results, Physics.blocks(results)))
    page.write_text(page.read_text("utf-8").replace("tip of the peg", "tip"), encoding="utf-8")
    assert any(found for _, found in blocks.check(results, Physics.blocks(results)))


def test_without_mujoco_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    monkeypatch.delitem(sys.modules, "coop_env.physics.engine", raising=False)
    assert command(["study", "physics"]) == 2
    assert "sb3-rainbow-coop[physics]" in capsys.readouterr().err
