"""Scripts insert as their names say, and ``python -m benchmarks contact`` can be checked."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from benchmarks.__main__ import main as command
from benchmarks.reporting.verify import Report
from benchmarks.studies.robots import contact, trials


def test_each_script_finds_what_it_can() -> None:
    """Within clearance and chamfer a push does; beyond it takes a search."""
    pytest.importorskip("mujoco", reason="needs the extra physics")
    from benchmarks.methods.contact_scripts import SCRIPTS, Gains
    from coop_env.physics.contact.env import CoopInsertionContactEnv

    env = CoopInsertionContactEnv("standard")
    won = {
        (name, error): sum(trials.play(env, make(env, Gains()), "validate", 4, error)["success"])
        for name, make in SCRIPTS.items()
        for error in (1.0, 3.0)
    }
    assert all(won[name, 1.0] == 4 for name in SCRIPTS)
    assert won["stiff push", 3.0] == won["compliant push", 3.0] == 0
    assert won["moment-guided search", 3.0] >= 3
    assert won["spiral search", 3.0] >= 3


def test_searches_press_less_than_a_stiff_push() -> None:
    pytest.importorskip("mujoco", reason="needs the extra physics")
    from benchmarks.methods.contact_scripts import SCRIPTS, Gains
    from coop_env.physics.contact.env import CoopInsertionContactEnv

    env = CoopInsertionContactEnv("standard")
    found = {
        name: trials.play(env, make(env, Gains()), "validate", 3, 3.0)
        for name, make in SCRIPTS.items()
    }
    assert set(found["stiff push"]["failure"]) <= {"force", "snap"}
    for name in ("compliant push", "moment-guided search", "spiral search"):
        assert max(found[name]["force"]) < 0.5 * min(found["stiff push"]["force"])


def test_the_command_writes_what_it_prints_and_keeps_what_is_measured(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco", reason="needs the extra physics")
    from benchmarks.methods import contact_scripts

    monkeypatch.setattr(contact_scripts, "GRIDS", {"compliant push": {"hold": (3.0, 6.0)}})
    monkeypatch.setattr(
        contact_scripts, "SCRIPTS", {"compliant push": contact_scripts.CompliantPush}
    )
    docs, results = tmp_path / "docs", tmp_path / "results"
    docs.mkdir()
    page = docs / contact.PAGE
    page.write_text("# Page\n\n<!-- contact:begin -->\n<!-- contact:end -->\n", encoding="utf-8")
    words = ["--results", str(results), "--docs", str(docs), "--episodes", "2"]
    assert contact.main([*words, "--levels", "standard"]) == 0
    capsys.readouterr()
    monkeypatch.setattr(contact, "measure", None)  # it is not called again
    assert contact.main([*words, "--levels", "standard"]) == 0
    text = (results / "contact" / "scripts.md").read_text("utf-8").strip()
    assert text in capsys.readouterr().out
    assert text in page.read_text("utf-8")
    stored = json.loads((results / "contact" / "scripts.json").read_text("utf-8"))
    assert stored["levels"]["standard"]["compliant push"]["errors"][1]["success"] == [True, True]
    report = Report()
    contact.check(report, results, [], docs)
    assert report.problems == []
    page.write_text(page.read_text("utf-8").replace("compliant", "soft"), encoding="utf-8")
    report = Report()
    contact.check(report, results, [], docs)
    assert report.problems


def test_episodes_are_the_same_for_all_and_no_validation() -> None:
    given = trials.options("test", 3, 2.0, None)
    assert given == trials.options("test", 3, 2.0, None)
    assert given != trials.options("validate", 3, 2.0, None)
    x, y, *_ = given["error"]
    assert (x * x + y * y) ** 0.5 == pytest.approx(0.002)
    assert trials.options("test", 3, None, 0.2)["friction"] == 0.2


def test_without_mujoco_the_extra_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in [*sys.modules]:
        if name.startswith(("coop_env.physics", "benchmarks.methods.contact_scripts")):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "mujoco", None)
    assert command(["contact"]) == 2
    assert "sb3-rainbow-coop[physics]" in capsys.readouterr().err
