"""Each example runs in its short form, in an empty folder, and does what it says."""

import json
import re
import runpy
import sys
from pathlib import Path

import pytest

from sb3_rainbow import Rainbow
from tests.process import ROOT

NOTEBOOK = ROOT / "examples" / "rainbow.ipynb"
STEPS = 200  # of the notebook's trainings: past their first updates
# the short form's number, what is printed, what is left behind
SHORT = {
    "behaviour_cloning": (
        "1",
        r"held out: 0\.\d\d\n(.*\n)*Nothing",
        ["build/cloned-optimum-small-s0"],
    ),
    "cartpole": ("300", r"return after 300 steps: \d+\.\d ± \d", ["build/rainbow_cartpole"]),
    "contact_sac": ("300", r"peg inserted: \d+ of 20$", []),
    "drive_a_machine": ("0", r"filled: \d+ moves in \d\.\d\d s.*\ntip \d\.\d mm", []),
    "exact_resume": ("384", r"goes on at step 192 of 384\nweights equal to the bit: True", []),
    "images": ("150", r"share of balls caught: [01]\.\d\d", []),
    "insertion": ("320", r"of 20\nholes filled: \d\.\d\d of 6", ["build/rainbow_insertion"]),
    "masks": ("500", r"reach the goal: [01]\.\d\d; falls into water, ever: 0$", []),
    "own_3rrs": ("2", r"Rb 0\.\d+.*\n(.*\n){2}own: the optimum inserts from [012] of 2 starts", []),
    "own_delta": ("1", r"47 moves: \d\.\d\d s by .*\nmoves that are not free on their way:", []),
    "own_method": ("1", r"climb, seed 0, noise 0: Success .*\n(.*\n)*Nothing was stored", []),
}


def test_every_example_is_tried() -> None:
    assert {path.stem for path in (ROOT / "examples").glob("*.py")} == set(SHORT)


@pytest.fixture(autouse=True)
def empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """To run in; a variable that an example sets is as it was afterwards."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(ROOT / "results" / "data"))


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=pytest.mark.slow if n == "contact_sac" else ()) for n in sorted(SHORT)],
)
def test_an_example_does_what_it_says(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    number, pattern, left = SHORT[name]
    monkeypatch.setattr(sys, "argv", [name, number])
    ended: list[object] = []
    monkeypatch.setattr(sys, "exit", ended.append)  # the last that some do
    runpy.run_module(f"examples.{name}", run_name="__main__")
    assert not any(ended)
    printed = capsys.readouterr().out
    assert re.search(pattern, printed, re.MULTILINE), printed
    for model in left:
        assert Rainbow.load(tmp_path / model, buffer_size=1).policy is not None
    assert {path.name for path in tmp_path.iterdir()} <= {"build", "results"}


def test_the_notebook_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """All cells but the one that installs, as one program; its trainings are shortened."""
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    codes = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    assert "pip install" in codes[0]
    program, trainings = re.subn(r"learn\([\d_]+\)", f"learn({STEPS})", "\n".join(codes[1:]))
    assert trainings == 2
    assert all(not cell.get("outputs") for cell in cells)
    exec(program, {"__name__": "__main__"})
    printed = capsys.readouterr().out
    assert re.search(r"return: \d+", printed)
    assert re.search(r"holes filled: \d of 6", printed)
    assert (tmp_path / "scene.png").stat().st_size > 0
