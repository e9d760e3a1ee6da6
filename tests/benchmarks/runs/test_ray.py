"""The same cells on a Ray cluster of two nodes, which lose a worker and then a node on the way."""

import json
import os
import signal
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.presets import load_preset
from benchmarks.runs.cell import run_cell
from benchmarks.runs.checkpoint import checkpoints
from benchmarks.runs.ray_backend import RayJob, run_remotely
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.insertion import Insertion
from tests.benchmarks.conftest import Command
from tests.benchmarks.runs.warm import Forked, wait_for
from tests.benchmarks.smoke import smoke_file

pytest.importorskip("ray", reason="needs the extra 'cluster'")

# Ray leaves sockets and processes to the garbage collector
pytestmark = pytest.mark.filterwarnings("ignore")

CELLS = ("rainbow-optimized-safe-s0", "dqn-optimized-safe-s0")


# of a node; Ray takes our word for the GPUs, it only counts them
SMALL = {
    "num_cpus": 1, "num_gpus": 1, "object_store_memory": 80 * 2**20, "include_dashboard": False,
}  # fmt: skip


def preset(folder: Path, timesteps: int, **changes: Any) -> Path:
    return smoke_file(
        folder, "small", track={"timesteps": timesteps},
        evaluation={"episodes": 1, "noise": [0.0]},
        runs=[{"methods": ["rainbow", "dqn"], "tracks": ["safe"]}], **changes,
    )  # fmt: skip


@contextmanager
def in_background() -> Iterator[None]:
    """As in a script's background ('ray start &' under SLURM), whose processes ignore SIGINT."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    """A cluster of one node."""
    from ray.cluster_utils import Cluster

    with tempfile.TemporaryDirectory(prefix="ray") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        patch.setenv("RAY_TMPDIR", folder)
        # beside other jobs a worker neither starves nor is lost to a slow start or their memory
        patch.setenv("RAY_worker_niceness", "0")
        patch.setenv("RAY_worker_register_timeout_seconds", "300")
        patch.setenv("RAY_memory_monitor_refresh_ms", "0")
        patch.setenv("RAY_health_check_period_ms", "1000")  # a lost node is seen sooner
        patch.delenv("CUDA_VISIBLE_DEVICES", raising=False)  # as make sets it, Ray counts none
        with in_background():
            cluster = Cluster(initialize_head=True, head_node_args=SMALL)
        yield cluster
        cluster.shutdown()


def harness(preset: Path, cluster: Any, results: Path, *words: str) -> Forked:
    place = ["--preset", str(preset), "--results", str(results), "--address", cluster.address]
    return Forked(results / "out.txt", ["run", *place, "--backend", "ray", *words])


def worker(run: RunFolder) -> dict[str, Any]:
    """What the worker of a run says of itself, once the run has a checkpoint."""
    try:
        data = json.loads((run.checkpoint / "worker.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return dict(data) if checkpoints(run.checkpoint) else {}


@pytest.mark.slow
@pytest.mark.usefixtures("warm")
def test_a_lost_worker_and_a_lost_node_change_nothing(cluster: Any, tmp_path: Path) -> None:
    log, few = tmp_path / "out.txt", preset(tmp_path, 600, checkpoint_seconds=0.0)
    with in_background():
        second = cluster.add_node(**SMALL)
    process = harness(few, cluster, tmp_path, "--gpus-per-run", "0.5", "--device", "cpu")
    runs = [Store(tmp_path, "small").run(cell) for cell in CELLS]
    raylet = second.all_processes["raylet"][0].process.pid
    stopped: dict[str, dict[str, Any]] = {}

    def both_have_begun() -> bool:
        for run in runs:
            if run.id not in stopped and (result := worker(run)):
                # whichever is first would be trained before the other has begun
                os.kill(result["run"], signal.SIGSTOP)
                stopped[run.id] = result
        return len(stopped) == 2

    wait_for(both_have_begun, log)
    workers = [stopped[run.id] for run in runs]
    on_second = [psutil.Process(result["pid"]).ppid() == raylet for result in workers]
    assert sorted(on_second) == [False, True]  # one run on each node
    on_head = on_second.index(False)
    os.kill(workers[on_head]["pid"], signal.SIGKILL)
    cluster.remove_node(second, allow_graceful=False)
    for result in workers:  # now that they are orphans, they save and end
        with suppress(ProcessLookupError):  # or the worker took it along
            os.kill(result["run"], signal.SIGCONT)
    code, out = process.wait(), log.read_text("utf-8")
    assert code == 0, out
    assert "Ray: 2 nodes, 2 CPUs, 2 GPUs, networks on cpu" in out
    for cell in CELLS:
        assert f"{cell}: lost its worker on" in out
        assert f"{cell}: done" in out
    loaded = load_preset(str(preset(tmp_path, 600)))
    local = Store.open(tmp_path / "local", "small", create=True)
    for run in runs:
        assert run.meta()["training"]["resumed_at"]
        assert run_cell(Insertion(loaded), Insertion(loaded).find(run.id), local)
        other = local.run(run.id)
        assert other.meta()["training"]["resumed_at"] == []
        for name in ("episodes.csv", "curve.csv", "config.yaml"):
            assert (run.path / name).read_bytes() == (other.path / name).read_bytes(), name
        assert not run.checkpoint.exists()


@pytest.mark.slow
@pytest.mark.usefixtures("warm")
def test_ctrl_c_leaves_a_checkpoint_and_no_process(cluster: Any, tmp_path: Path) -> None:
    endless, log = preset(tmp_path, 10_000_000, checkpoint_seconds=0.2), tmp_path / "out.txt"
    process = harness(endless, cluster, tmp_path, "--jobs", "1")
    runs = [Store(tmp_path, "small").run(cell) for cell in CELLS]
    result = wait_for(lambda: next(filter(None, map(worker, runs)), None), log)
    process.send_signal(signal.SIGINT)
    code, out = process.wait(), log.read_text("utf-8")
    assert code == 130, out
    assert "the same command resumes" in out
    with suppress(psutil.NoSuchProcess):
        assert psutil.Process(result["run"]).status() == psutil.STATUS_ZOMBIE
    assert sum(len(checkpoints(run.checkpoint)) for run in runs) == 1
    assert not any(run.is_complete() for run in runs)


def test_a_worker_that_sees_another_folder_refuses(tmp_path: Path) -> None:
    (tmp_path / "checkpoint").mkdir()
    for ticket in (None, '{"nonce": "of another"}'):
        if ticket is not None:
            (tmp_path / "checkpoint" / "ticket.json").write_text(ticket, encoding="utf-8")
        with pytest.raises(BenchmarkError, match="storage that all nodes share"):
            run_remotely(["train"], str(tmp_path), "mine")


class Lost(Exception):
    pass


class FakeRay:
    """Ray with a task that is lost as often as the test says."""

    class exceptions:
        TaskCancelledError = KeyError
        RayTaskError = IndexError
        RayError = Lost

    def __init__(self) -> None:
        self.submitted = 0
        self.losses = 0
        self.steps = 0.0
        self.folder: RunFolder

    def wait(self, references: list[int], timeout: float) -> tuple[list[int], list[int]]:
        return references, []

    def get(self, reference: int) -> int:
        if self.losses:
            self.losses -= 1
            self.steps += 0.01
            if self.steps < 0.035:
                self.folder.write_progress(self.steps, "")
            raise Lost
        return 0

    def submit(self, words: list[str], folder: RunFolder) -> tuple[int, str]:
        self.submitted += 1
        return self.submitted, str(self.submitted)


@pytest.mark.parametrize(("losses", "code"), [(0, 0), (6, 0), (7, 2)])
def test_a_run_that_is_lost_again_and_again_ends(losses: int, code: int, tmp_path: Path) -> None:
    ray: Any = FakeRay()
    ray.ray = ray
    ray.losses, ray.folder = losses, RunFolder(tmp_path)
    job = RayJob(ray, ["train"], RunFolder(tmp_path))
    while job.poll() is None:
        pass
    # three losses with progress between them, which count for nothing, then three in a row
    assert job.poll() == code
    assert ray.submitted == 1 + min(losses, 6)
    assert len(job.news()) == min(losses, 6)
    assert job.news() == []
    assert ("lost 4 times in a row (Lost)" in job.log.read_text("utf-8")) if code else True


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--address", "auto"], "--address auto: only with --backend ray"),
        (["--gpus-per-run", "0.5"], "--gpus-per-run 0.5: only with --backend ray"),
        (["--backend", "ray", "--gpus-per-run", "1.5"], "must be a fraction from 0 to 1, or a"),
        (["--backend", "ray", "--gpus-per-run", "-1"], "must be a fraction"),
        (["--backend", "ray", "--address", "127.0.0.1:1"], "no Ray cluster answers there"),
        (["--backend", "ray", "--address", "nonsense"], "no Ray cluster answers there"),
    ],
)
def test_bad_options_are_one_error(
    words: list[str], message: str, tmp_path: Path, refused: Command
) -> None:
    assert message in refused("run", "--preset", "smoke", "--results", str(tmp_path), *words)


def test_more_gpus_than_any_node_has_are_refused(
    cluster: Any, tmp_path: Path, refused: Command
) -> None:
    words = ["--backend", "ray", "--address", cluster.address, "--gpus-per-run", "2"]
    error = refused("run", "--preset", "smoke", "--results", str(tmp_path), *words)
    assert "--gpus-per-run 2: no node of the cluster has more than 1" in error


def test_without_ray_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Command
) -> None:
    monkeypatch.setitem(sys.modules, "ray.exceptions", None)
    words = ["run", "--preset", "smoke", "--results", str(tmp_path), "--backend", "ray"]
    assert "needs the extra 'cluster': pip install" in refused(*words)
