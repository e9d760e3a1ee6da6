"""Figures of a fabricated store: which there are, and what they say."""

import io
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from benchmarks.cli import main
from benchmarks.reporting.figures.learning import draw, pictures
from benchmarks.reporting.figures.style import canvas, flat_png
from benchmarks.reporting.results import Results
from benchmarks.runs.store import Store
from tests.benchmarks import fabricated_store
from tests.process import ROOT, python

# the paper's
CURVES = ("cumulative_reward", "exploration", "holes", "success", "max_q", "loss", "duration")


def test_a_small_picture_keeps_its_colours() -> None:
    figure, (axes,) = canvas()
    for i in range(8):
        axes.plot([0, 1], [i, i], color=f"C{i}", linewidth=0.6)
        axes.fill_between([0, 1], i - 0.3, i + 0.3, color=f"C{i}", alpha=0.2)
    raw = io.BytesIO()
    figure.savefig(raw, format="png")
    small = flat_png(raw.getvalue())
    assert len(small) < 0.7 * len(raw.getvalue())
    before, after = (
        np.asarray(Image.open(io.BytesIO(data)).convert("RGB"), dtype=np.int64)
        for data in (raw.getvalue(), small)
    )
    assert np.abs(before - after).max() < 25


def test_a_picture_with_nothing_to_compare_is_not_drawn(tmp_path: Path) -> None:
    """Without the optimum there is no speed beside it, without levels nothing over noise."""
    store = fabricated_store.make_store(tmp_path, range(3), "shielded")
    names = {picture.name for picture in pictures(Results(store))}
    assert names & {"performance_profile", "robustness"} == set()
    assert "shielded_success" in names
    # all six components and none stand beside each other in the learning figures
    made = fabricated_store.make_store(
        tmp_path, [0], "paper", lambda cell: cell.ablation in ("full", "none")
    )
    names = {picture.name for picture in pictures(Results(made))}
    assert {"terminal_success", "repaired_success"} <= names
    assert not {name for name in names if "ablation" in name}


def test_a_band_over_few_evaluations_has_intervals_at_these_alone() -> None:
    """Not at means of two of them, where seeds seem to agree more."""
    steps = [100, 200, 300]
    frames = [
        pd.DataFrame({"timesteps": steps, "return": values})
        for values in ([0.0, 9.0, 5.0], [4.0, 5.0, 9.0], [2.0, 1.0, 1.0])
    ]
    axes = plt.figure().subplots()
    draw(axes, frames, "return", "", "k")
    drawn = np.asarray(axes.lines[0].get_xydata())
    np.testing.assert_allclose(drawn, [(100, 2.0), (200, 5.0), (300, 5.0)])
    plt.close()


@pytest.mark.slow
def test_figures_need_no_torch(tmp_path: Path) -> None:
    store = fabricated_store.make_store(tmp_path, range(2))
    code = (
        "import sys, benchmarks.reporting.verify, benchmarks.reporting.science;"
        "from benchmarks.cli import main;"
        "words = ['--preset', 'quick', '--results', sys.argv[1]];"
        "assert main(['tables', *words]) == main(['figures', *words]) == 0;"
        "heavy = {'torch', 'stable_baselines3', 'sb3_contrib', 'tensorboard'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    assert python("-c", code, str(tmp_path), cwd=ROOT).stdout.strip().endswith("\n[]")
    result = {picture.name: picture for picture in pictures(Results(store))}
    assert {path.stem for path in store.figures.iterdir()} == set(result)
    assert {f"safe_{name}" for name in CURVES} <= set(result)
    assert {"robustness", "performance_profile", "ablation_comparison"} <= set(result)
    for name in ("safe_cumulative_reward", "performance_profile"):  # drawn again, the same bytes
        data = (store.figures / f"{name}.png").read_bytes()
        assert data.startswith(b"\x89PNG")
        assert result[name].write(tmp_path).read_bytes() == data


@pytest.mark.parametrize("seeds", [1, 2])
def test_a_single_seed_has_no_interval_beside_those_over_seeds(tmp_path: Path, seeds: int) -> None:
    learners = fabricated_store.make_store(
        tmp_path, range(seeds), keep=lambda cell: cell.method == "rainbow"
    )
    results = Results(learners)
    (picture,) = (each for each in pictures(results) if each.name == "ablation_comparison")
    ours: Any = picture.draw().axes[0].containers[0]
    drawn = [bool(np.isfinite(bar).any()) for bar in ours.lines[2][0].get_segments() if len(bar)]
    assert len(drawn) == (7 if seeds == 2 else 0)  # the whole Rainbow and six ablations
    assert all(drawn)
    assert np.isfinite(ours.lines[0].get_xdata()).all()


def test_a_store_without_any_run_has_tables_of_what_is_missing(tmp_path: Path) -> None:
    store = Store.open(tmp_path, "cut", create=True)
    assert main(["report", "--preset", "cut", "--results", str(tmp_path)]) == 0
    assert "missing" in (store.tables / "performance.md").read_text(encoding="utf-8")
    assert not list(store.figures.glob("*"))
