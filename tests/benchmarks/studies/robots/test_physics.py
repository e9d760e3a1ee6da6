"""``study physics`` measures, stores, prints, and its tables can be checked."""

from __future__ import annotations

import json
from typing import Any

import pytest

from benchmarks.studies.robots.physics import Physics

SMALL = ["--poses", "4", "--steps", "16", "--rounds", "1", "--memory-steps", "20"]


def test_the_command_writes_what_it_prints(site: Any) -> None:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra physics)")
    here = site("physics")
    assert Physics.main(["--results", str(here.results), *SMALL]) == 0
    here.check(Physics, "physics/physics.md", "tip of the peg")
    folder = here.results / "physics"
    assert (folder / "model" / "coop_insertion.xml").is_file()
    result = json.loads((folder / "physics.json").read_text("utf-8"))
    for geometry in ("initial", "optimized"):
        assert 0.0 < result["parts"][f"errors, {geometry}"]["tip"]["largest"] < 5e-5
    assert min(result["parts"]["speed"].values()) > 0.0
