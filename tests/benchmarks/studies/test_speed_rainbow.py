"""``python -m benchmarks speed rainbow``: what it measures, and what it says."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.env_util import make_vec_env

from benchmarks.errors import BenchmarkError
from benchmarks.studies.speed import images
from benchmarks.studies.speed import rainbow as speed_rainbow
from benchmarks.studies.speed.setting import (
    BATCH_SIZE,
    CAPACITY,
    Seconds,
    measure_updates,
    ours,
)
from sb3_rainbow import Rainbow

SMALL = 3 * BATCH_SIZE


class Clockwork:
    """A contestant whose every step takes so many seconds."""

    def __init__(self, seconds: list[float]) -> None:
        self.seconds = iter(seconds)

    def __call__(self, kind: str, n: int) -> Seconds:
        if kind == "train":
            return Seconds(n * 1e-3, n * 1e-3)
        second = next(self.seconds)
        return Seconds(n * second, 2.0 * n * second)


def test_rates_are_medians_over_the_rounds() -> None:
    found = measure_updates({"a": Clockwork([0.1, 0.5, 0.2]), "b": Clockwork([1.0] * 3)}, 7, 3)
    assert found["a"]["learn_cpu"] == pytest.approx(5.0)
    assert found["a"]["learn_wall"] == pytest.approx(2.5)
    assert found["b"]["learn_cpu"] == pytest.approx(1.0)
    assert found["b"]["train_cpu"] == pytest.approx(1000.0)


@pytest.mark.parametrize("kind", ["learn", "train"])
def test_updates_are_counted_whatever_the_number_of_games(kind: str) -> None:
    one: dict[str, Any] = {"train_freq": 1, "gradient_steps": 1}
    model = Rainbow("MlpPolicy", make_vec_env("CartPole-v1", 4), learning_starts=8, **one)
    model.learn(40)
    before = model._n_updates
    ours(model, 8)(kind, 5)
    assert model._n_updates - before == 5


def test_the_memory_of_a_million_transitions_is_the_buffer_s_alone() -> None:
    # observations once, rewards, actions, ends and the tree; masks come with the first of them
    mask_bytes = 12
    expected = speed_rainbow.make_buffer().nbytes + mask_bytes * CAPACITY
    assert speed_rainbow.measure_memory() == pytest.approx(expected / 1e6, rel=0.1)


def test_each_learner_is_measured(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed_rainbow, "measure_replay", lambda _: {"sample_and_update_us": 1.0})
    monkeypatch.setattr(speed_rainbow, "measure_memory", lambda: 140.0)
    monkeypatch.setattr(images, "measure", lambda n, rounds: {})
    arguments = argparse.Namespace(no_compile=True, steps=5, rounds=1, results=tmp_path)
    found = speed_rainbow.measure_cpu(arguments, SMALL)
    names = {"SB3 DQN", "sb3-contrib QR-DQN", "Rainbow", "Rainbow, categorical"}
    assert set(found["updates"]) == names


def test_the_report_gives_the_ratios_of_the_rates() -> None:
    rates = {"SB3 DQN": 500.0, "Rainbow": 600.0}
    kinds = ("learn_cpu", "learn_wall", "train_cpu", "train_wall")
    found = {
        "command": "c",
        "load": 0.0,
        "rounds": 1,
        "steps": 1,
        "machine": {"machine": {"processor": "p"}, "commit": "0", "versions": {}},
        "updates": {name: dict.fromkeys(kinds, rate) for name, rate in rates.items()},
        "replay": {"sample_and_update_us": 10.0, "sample_transitions_us": 20.0},
        "memory_mb": 140.4,
        "images": {"MinAtar": {name: dict.fromkeys(kinds, rate) for name, rate in rates.items()}},
    }
    text = " ".join(speed_rainbow.tell(json.loads(json.dumps(found))).split())
    assert "| Rainbow | 600 | 1.20 |" in text
    assert "| Rainbow | SB3 DQN | 1.20 | 1.20 | 1.5 |" in text
    assert "| Rainbow on MinAtar | SB3 DQN | 1.20 | 1.20 | 0.91 |" in text
    assert "On images, Breakout by preset `minatar`" in text
    assert "12-action masks: 140 MB." in text


def test_the_gpu_table_at_its_batch_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speed_rainbow, "CUDA_BATCH_SIZES", (8, 16))
    arguments = argparse.Namespace(no_compile=True, steps=5, rounds=1)
    found = speed_rainbow.measure_cuda(arguments, SMALL, device="cpu")
    assert set(found["updates"]) == {"8", "16"}
    machine = {"machine": {"processor": "p"}, "commit": "0", "versions": {}}
    whole = {"command": "c", "load": 0.0, "rounds": 1, "steps": 5, "machine": machine, **found}
    text = " ".join(speed_rainbow.tell_cuda(whole).split())
    assert text.count("| SB3 DQN |") == text.count("| Rainbow |") == 2


def test_the_image_rows_have_the_three_methods() -> None:
    found = images.measure(n_steps=8, rounds=1)
    assert set(found["MinAtar"]) == {"SB3 DQN", "sb3-contrib QR-DQN", "Rainbow"}
    assert set(found["NatureCNN"]) == set(found["MinAtar"]) | {
        "Rainbow, by default two streams of 512"
    }
    assert all(rates["train_cpu"] > 0.0 for of in found.values() for rates in of.values())


def test_no_gpu_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    monkeypatch.setattr("torch.cuda.is_available", lambda: False)
    with pytest.raises(BenchmarkError, match="no CUDA device here"):
        speed_rainbow.main(["--device", "cuda"])
