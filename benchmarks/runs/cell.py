"""One cell from start to end: train or plan, test, store. Runs in a process of its own."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import DESIGN, Cell, settings
from benchmarks.protocol.presets import Preset
from benchmarks.protocol.seeding import derive
from benchmarks.runs import machine
from benchmarks.runs.store import RunFolder, Store


class StopFlag:
    """True once the process was asked to end (SIGTERM or Ctrl-C); a run then saves and stops.

    Args:
        parent: process id of the harness that started this process, if one did; when it is gone,
            killed without a word, that counts as being asked.
    """

    def __init__(self, parent: int | None = None) -> None:
        self.requested = False
        self.parent = parent

    def __call__(self) -> bool:
        orphaned = self.parent is not None and os.getppid() != self.parent
        return self.requested or orphaned

    def listen(self) -> None:
        """Let the signals set the flag; outside the main thread there are no signals to take."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGTERM, signal.SIGINT):
                signal.signal(number, self._set)

    def _set(self, number: int, frame: object) -> None:
        self.requested = True


def check_device(device: str) -> None:
    """Raise BenchmarkError if torch has no such device here."""
    if device == "cuda":
        import torch

        if not torch.cuda.is_available():
            raise BenchmarkError(
                f"--device {device}: torch {torch.__version__} sees no GPU here; use --device cpu"
            )


def run_cell(
    preset: Preset,
    cell: Cell,
    store: Store,
    stop_requested: Callable[[], bool] = lambda: False,
    wait: float = 0.0,
    device: str = "cpu",
) -> bool:
    """Run a cell to its end, or until ``stop_requested``; a complete one is left as it is.

    Args:
        preset: the experiment.
        cell: a cell of it.
        store: where its results go.
        stop_requested: asked between rounds of training.
        wait: seconds to wait for another process that works on the cell.
        device: where a learner's network lives: cpu or cuda.

    Returns:
        Whether the cell is complete.

    Raises:
        BenchmarkError: the cell's folder holds a run with other settings, or another process
            works on it.
    """
    folder = store.run(cell.id)

    def work() -> dict[str, Any] | None:
        clock = Clock()
        if cell.method == DESIGN:
            training: dict[str, Any] | None = _run_design(preset, folder)
        elif cell.learns:
            training = _run_learner(preset, cell, folder, stop_requested, device)
        else:
            training = _run_planner(preset, cell, folder, stop_requested)
        return None if training is None else _meta(preset, cell, training, clock)

    return run_once(folder, settings(preset, cell), work, cell.learns, wait)


def run_once(
    folder: RunFolder,
    config: Mapping[str, Any],
    work: Callable[[], dict[str, Any] | None],
    learns: bool,
    wait: float,
) -> bool:
    """Do a run's work under its lock unless it is done, and write what meta.json says of it.

    Args:
        folder: the run's.
        config: every setting that decides its result.
        work: returns what meta.json says, without the machine; None if it was stopped.
        learns: whether the run is complete only with a policy.
        wait: seconds to wait for another process that works on it.

    Returns:
        Whether the run is complete.

    Raises:
        BenchmarkError: the folder holds a run with other settings, or another process works on it.
    """
    folder.check_config(config)
    if folder.is_done(learns):
        return True
    with folder.lock(wait):
        if folder.is_done(learns):  # by the process that was waited for
            return True
        folder.reopen()
        folder.begin(config)
        made_by = machine.describe()  # now: the sources may change while the run is on
        record = work()
        if record is None:
            return False
        folder.write_meta({**record, **made_by})
        folder.drop_checkpoint()
        return True


def tell_end(cell_id: str, folder: RunFolder, complete: bool) -> int:
    """Say how a run that was started on its own has ended; returns the exit code."""
    if not complete:
        print(f"{cell_id}: stopped, the checkpoint is in {folder.path}; the same command resumes")
        return 130
    print(f"{cell_id}: complete, see {folder.path}")
    return 0


class Clock:
    """Wall and CPU time since its making."""

    def __init__(self) -> None:
        self._began = time.perf_counter(), time.process_time()

    def read(self) -> tuple[float, float]:
        """Seconds of both."""
        wall, cpu = self._began
        return time.perf_counter() - wall, time.process_time() - cpu


def _run_learner(
    preset: Preset,
    cell: Cell,
    folder: RunFolder,
    stop_requested: Callable[[], bool],
    device: str,
) -> dict[str, Any] | None:
    from benchmarks.evaluation.evaluate import evaluate_policy, model_policy
    from benchmarks.methods.learners import env_arguments
    from benchmarks.runs import policy_file
    from benchmarks.runs.training import train

    trained = train(preset, cell, folder, stop_requested, device)
    if trained is None:
        return None
    model, summary = trained
    folder.write_progress(1.0, "testing")
    began = time.perf_counter()
    summary["weights_sha256"] = policy_file.digest(model)
    policy_file.reduce_to_greedy(model)
    arguments = env_arguments(preset, cell, preset.tracks[cell.track])
    rows = evaluate_policy(model_policy(model), preset, cell.seed, arguments)
    folder.write_rows("episodes", rows)
    policy_file.save(model, folder.policy)
    return {**summary, "test_seconds": time.perf_counter() - began}


class _Stopped(Exception):
    """Asked to end; a planner has no checkpoint, its episodes are soon planned again."""


def _run_planner(
    preset: Preset, cell: Cell, folder: RunFolder, stop_requested: Callable[[], bool]
) -> dict[str, Any] | None:
    from benchmarks.evaluation.evaluate import evaluate_planner
    from benchmarks.methods.learners import env_arguments

    def tell(share: float) -> None:
        folder.write_progress(share, "")
        if stop_requested():
            raise _Stopped

    try:
        rows = evaluate_planner(preset, cell, env_arguments(preset, cell), tell)
    except _Stopped:
        folder.write_progress(0.0, "stopped")
        return None
    folder.write_rows("episodes", rows)
    return {}


def _run_design(preset: Preset, folder: RunFolder) -> dict[str, Any]:
    from benchmarks.methods.geometric_design import geometry_rows

    assert preset.design is not None
    folder.write_rows("design", geometry_rows(preset.design.runs))
    return {}


def _meta(preset: Preset, cell: Cell, training: dict[str, Any], clock: Clock) -> dict[str, Any]:
    wall, cpu = clock.read()
    # a resumed run's training time is the sum over its processes
    earlier = training.get("wall_seconds"), training.get("cpu_seconds")
    if earlier[0] is not None and earlier[1] is not None:
        tested = training["test_seconds"]
        wall, cpu = max(wall, earlier[0] + tested), max(cpu, earlier[1])
    return {
        "cell": cell.id,
        "preset": preset.name,
        "seeds": {
            "cell": cell.seed,
            "train": derive("train", cell.seed),
            "learner": derive("learner", cell.seed),
            "first_test_episode": derive("test", cell.seed, 0),
        },
        "training": training,
        "wall_seconds": wall,
        "cpu_seconds": cpu,
    }
