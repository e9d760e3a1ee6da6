"""``study physics`` measures, stores, prints, and its tables can be checked."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.studies.robots.physics import Physics

SMALL = ["--poses", "4", "--steps", "16", "--rounds", "1", "--memory-steps", "20"]


def test_the_command_writes_what_it_prints(site: Any) -> None:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra physics)")
    here = site("physics")
    assert Physics.main(["--results", str(here.results), *SMALL]) == 0
    here.check(Physics, "tip of the peg")
    assert (here.results / "physics" / "model" / "coop_insertion.xml").is_file()
    parts = here.parts(Physics)
    for geometry in ("initial", "optimized"):
        assert 0.0 < parts[f"errors, {geometry}"]["tip"]["largest"] < 5e-5
    assert min(parts["speed"].values()) > 0.0
