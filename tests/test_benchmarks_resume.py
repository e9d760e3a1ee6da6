"""A run that was cut off ends as an uninterrupted one; damaged checkpoints are set aside."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from benchmarks.cell import run_cell
from benchmarks.checkpoint import checkpoints
from benchmarks.plan import Cell
from benchmarks.presets import PRESETS, Preset, parse_preset
from benchmarks.store import RunFolder, Store
from benchmarks.train import ALGORITHMS, train

CELLS = [
    Cell("rainbow", "full", "optimized", "tuned", 0),
    Cell("rainbow", "no_noisy", "optimized", "tuned", 0),
    Cell("dqn", "full", "optimized", "tuned", 0),
]


@pytest.fixture(scope="module")
def preset() -> Preset:
    import yaml

    data = yaml.safe_load((PRESETS / "smoke.yaml").read_text(encoding="utf-8"))
    data["tracks"]["tuned"]["timesteps"] = 400
    data["evaluation"] = {"episodes": 1, "noise": [0.0]}
    # a low bar, so that the curriculum's switch lies within the run
    data["tracks"]["tuned"]["curriculum"] = {"threshold": -1.0, "window": 1}
    return parse_preset(data, "smoke", "smoke.yaml")


def stop_after(rounds: int) -> Callable[[], bool]:
    left = iter(range(rounds))
    return lambda: next(left, None) is None


def weights(model: object) -> dict[str, torch.Tensor]:
    state: dict[str, torch.Tensor] = model.policy.state_dict()  # type: ignore[attr-defined]
    return {name: value.clone() for name, value in state.items()}


def same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.fixture(scope="module")
def uninterrupted(
    preset: Preset, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[dict[str, torch.Tensor], str]]:
    runs = {}
    for cell in CELLS:
        folder = RunFolder(tmp_path_factory.mktemp(cell.id))
        trained = train(preset, cell, folder)
        assert trained is not None
        model, _ = trained
        runs[cell.id] = weights(model), (folder.path / "curve.csv").read_text(encoding="utf-8")
    return runs


@pytest.mark.parametrize("cell", CELLS, ids=lambda cell: cell.id)
def test_stopping_twice_at_odd_moments_changes_nothing(
    cell: Cell,
    preset: Preset,
    uninterrupted: dict[str, tuple[dict[str, torch.Tensor], str]],
    tmp_path: Path,
) -> None:
    folder = RunFolder(tmp_path)
    assert train(preset, cell, folder, stop_after(17)) is None
    assert train(preset, cell, folder, stop_after(40)) is None
    (kept,) = checkpoints(folder.checkpoint)
    assert kept.name == "step-0000000228"  # 17 rounds, then 40 more, of 4 environments
    trained = train(preset, cell, folder)
    assert trained is not None
    model, summary = trained
    expected, curve = uninterrupted[cell.id]
    assert same(weights(model), expected)
    assert (folder.path / "curve.csv").read_text(encoding="utf-8") == curve
    assert len(summary["resumed_at"]) == 2
    assert summary["timesteps"] == 400


def test_a_crash_loses_at_most_the_last_interval(
    preset: Preset,
    uninterrupted: dict[str, tuple[dict[str, torch.Tensor], str]],
    tmp_path: Path,
) -> None:
    import dataclasses

    eager = dataclasses.replace(preset, checkpoint_seconds=0.0)
    rng = np.random.default_rng(0)
    for crash in sorted(int(x) for x in rng.integers(5, 90, size=3)):
        folder = RunFolder(tmp_path / str(crash))
        calls = iter(range(crash))

        def fall(calls: object = calls) -> bool:
            # as when the process is killed: nothing is saved, nothing is closed
            if next(calls, None) is None:  # type: ignore[call-overload]
                raise KeyboardInterrupt
            return False

        with pytest.raises(KeyboardInterrupt):
            train(eager, CELLS[0], folder, fall)
        (kept,) = checkpoints(folder.checkpoint)
        assert kept.name == f"step-{4 * (crash - 1):010d}"
        trained = train(preset, CELLS[0], folder)
        assert trained is not None
        assert same(weights(trained[0]), uninterrupted[CELLS[0].id][0])


@pytest.mark.parametrize("name", ["state.pkl", "model.zip", "buffer.pkl"])
def test_a_damaged_checkpoint_is_named_and_kept_aside(
    name: str, preset: Preset, tmp_path: Path
) -> None:
    folder = RunFolder(tmp_path)
    train(preset, CELLS[0], folder, stop_after(40))
    (kept,) = checkpoints(folder.checkpoint)
    damaged = kept / name
    damaged.write_bytes(damaged.read_bytes()[: damaged.stat().st_size // 2])
    with pytest.warns(UserWarning, match=f"{kept.name} cannot be read"):
        assert train(preset, CELLS[0], folder, stop_after(3)) is None
    assert (folder.checkpoint / f"broken-{kept.name}" / name).is_file()


def test_a_disk_that_fills_up_keeps_the_last_checkpoint(
    preset: Preset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = RunFolder(tmp_path)
    train(preset, CELLS[0], folder, stop_after(10))

    def full(*arguments: object) -> None:
        raise OSError("no space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(OffPolicyAlgorithm, "save_replay_buffer", full)
        with pytest.raises(OSError, match="no space"):
            train(preset, CELLS[0], folder, stop_after(5))
    (kept,) = checkpoints(folder.checkpoint)
    assert kept.name == "step-0000000040"
    assert train(preset, CELLS[0], folder, stop_after(2)) is None


def test_a_complete_cell_is_skipped_and_its_policy_loads(preset: Preset, tmp_path: Path) -> None:
    cell = CELLS[0]
    store = Store.open(tmp_path, "smoke", create=True)
    assert not run_cell(preset, cell, store, stop_after(5))
    assert not store.run(cell.id).is_complete()
    assert run_cell(preset, cell, store)
    run = store.run(cell.id)
    assert not run.checkpoint.exists()
    assert run.meta()["training"]["resumed_at"] == [20]
    stamps = {path: path.stat().st_mtime_ns for path in run.path.iterdir()}
    assert run_cell(preset, cell, store)
    assert {path: path.stat().st_mtime_ns for path in run.path.iterdir()} == stamps
    model = ALGORITHMS["rainbow"].load(run.policy, device="cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        action, _ = model.predict(np.full(12, 0.5, np.float32), deterministic=True)
    assert 0 <= int(action) < 12
    assert (run.path / "policy.zip").stat().st_size < 2_000_000
    assert (run.path / "curve.csv").stat().st_size < 200_000
