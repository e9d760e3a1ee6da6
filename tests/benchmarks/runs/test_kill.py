"""Runs killed at random moments, or at chosen file operations, end as if nothing had happened.

Weights are compared bit by bit, curves and episodes byte by byte. The kills are SIGKILLs of a
process that trains; a warm server forks it, so that its imports are paid once.
"""

import os
import random
import shutil
import signal
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from stable_baselines3.common.save_util import load_from_zip_file

from benchmarks.protocol.plan import expand
from benchmarks.protocol.presets import load_preset
from benchmarks.runs.checkpoint import checkpoints
from benchmarks.runs.store import RunFolder, Store
from tests.benchmarks.runs.warm import Forked
from tests.benchmarks.smoke import smoke_file

KILLS = 5  # of each of four cells, by the clock
INSIDE = 3  # of these, surely inside training
CRASHES = 10  # at file operations, half of them among the last

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("warm")]


def left_by(run: RunFolder) -> dict[str, Any]:
    """What a complete run leaves, as far as it may not depend on interruptions."""
    _, parameters, _ = load_from_zip_file(run.policy, device="cpu")
    assert parameters is not None
    weights: Any = parameters["policy"]
    times = ("wall_seconds", "cpu_seconds", "test_seconds", "resumed_at", "made_with")
    unlike = {*times, "policy_sha256"}  # of a file that keeps times: its weights count
    return {
        **{name: value.numpy().tobytes() for name, value in weights.items()},
        **{name: (run.path / name).read_bytes() for name in ("curve.csv", "episodes.csv")},
        **{key: value for key, value in run.meta()["training"].items() if key not in unlike},
    }


@pytest.fixture(scope="module")
def preset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    track: dict[str, Any] = {
        "timesteps": 240,
        "hyperparameters": {"net_arch": [32, 32], "n_atoms": 11},
        # a low bar, so that the curriculum's switch lies within the run
        "curriculum": {"threshold": -1.0, "window": 1},
        # more state to lose: visited configurations, and rollouts of an actor-critic
        "mask_singularities": True,
        "mask_visited": 5,
        "ppo": {"n_steps": 8, "batch_size": 16, "n_epochs": 2},
    }
    return smoke_file(
        tmp_path_factory.mktemp("preset"), "kill", track=track, checkpoint_seconds=0.0,
        evaluation={"episodes": 1, "noise": [0.0, 0.01]},
        runs=[
            {"methods": ["rainbow", "dqn", "maskable_ppo"], "tracks": ["safe"]},
            {"methods": ["rainbow"], "tracks": ["safe"], "ablations": ["no_noisy"]},
        ],
    )  # fmt: skip


@pytest.fixture(scope="module")
def scratch() -> Iterator[Path]:
    """A folder in memory, where there is one: hundreds of checkpoints are flushed to it."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as name:
        yield Path(name)


def train(preset: Path, cell: str, results: Path, crash: int | None = None) -> Forked:
    results.mkdir(parents=True, exist_ok=True)
    words = ["train", "--preset", str(preset), "--results", str(results), "--cell", cell]
    return Forked(results / "log.txt", words, crash)


@dataclass
class Ended:
    """What a run left that nothing interrupted, its seconds, and its operations on files."""

    left: dict[str, Any]
    seconds: float
    operations: int


@pytest.fixture(scope="module")
def uninterrupted(preset: Path, scratch: Path) -> dict[str, Ended]:
    ended = {}
    for cell in (each.id for each in expand(load_preset(str(preset)))):
        results = scratch / "uninterrupted" / cell
        began = time.monotonic()
        assert train(preset, cell, results, crash=-1).wait() == 0, (results / "log.txt").read_text()
        seconds, operations = time.monotonic() - began, (results / "log.txt.count").read_text()
        ended[cell] = Ended(left_by(Store(results, "kill").run(cell)), seconds, int(operations))
    return ended


def newest(run: RunFolder) -> int:
    """Steps of the newest checkpoint."""
    return max((int(path.name.split("-")[1]) for path in checkpoints(run.checkpoint)), default=0)


def test_kills_at_random_moments_change_nothing(
    preset: Path, uninterrupted: dict[str, Ended], scratch: Path
) -> None:
    rng = random.Random(0)
    for cell, ended in uninterrupted.items():
        results, longest = scratch / cell, 0.4 * ended.seconds
        run, kills, inside = Store(results, "kill").run(cell), 0, 0
        while kills < KILLS or inside < INSIDE:
            before = newest(run)
            process = train(preset, cell, results)
            time.sleep(rng.uniform(0.0, longest))
            # every fourth time the run is asked to stop, as Ctrl-C does
            asked = rng.random() < 0.25
            number = rng.choice([signal.SIGTERM, signal.SIGINT]) if asked else signal.SIGKILL
            process.send_signal(number)
            code = process.wait()
            if code == 0:  # the run was faster than the signal
                assert left_by(run) == ended.left
                shutil.rmtree(results)
                longest *= 0.8
            elif number == signal.SIGKILL:
                assert code == -signal.SIGKILL
                kills += 1
                came = (run.checkpoint / "saving").exists() or newest(run) > before
                inside += came
                # the machine has slowed down since it was measured, perhaps
                longest *= 1.0 if came else 1.1
        assert train(preset, cell, results).wait() == 0, (results / "log.txt").read_text()
        assert left_by(run) == ended.left


def test_a_kill_at_any_file_operation_changes_nothing(
    preset: Path, uninterrupted: dict[str, Ended], scratch: Path
) -> None:
    cell, ended = next(iter(uninterrupted.items()))
    operations = ended.operations
    assert operations > 40
    rng = random.Random(1)
    # the last: rows, policy, meta.json, the end of the checkpoint
    last = range(operations - 12, operations)
    points = rng.sample(range(last.start), CRASHES // 2) + rng.sample(last, CRASHES // 2)
    for point in points:
        results = scratch / str(point)
        code = train(preset, cell, results, crash=point).wait()
        # how often progress is told depends on the clock, so the very last may not come
        assert code == -signal.SIGKILL or (code == 0 and point > operations / 2)
        assert train(preset, cell, results).wait() == 0, (results / "log.txt").read_text()
        run = Store(results, "kill").run(cell)
        assert left_by(run) == ended.left
        assert not list(run.path.rglob("*.tmp*"))
        shutil.rmtree(results)
