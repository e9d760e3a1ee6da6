"""Runs on a Ray cluster: the same command, the same store on storage that all nodes share.

Ray only places processes. A run whose worker or node is lost is placed again and goes on from its
last checkpoint; progress and results travel through the run's folder, as on one machine.
"""

import importlib
import json
import os
import signal
import socket
import sys
import time
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from benchmarks.errors import BenchmarkError
from benchmarks.runs.backends import GRACE_SECONDS, Backend, Job
from benchmarks.runs.store import RunFolder, write_text

RETRIES: Final = 3  # in a row without a step of progress
POLL_SECONDS: Final = 0.2
CONNECT_SECONDS: Final = 10.0
TICKET: Final = "ticket.json"  # from the harness: its nonce
WORKER: Final = "worker.json"  # from the worker: where it runs


def run_remotely(argv: Sequence[str], folder: str, nonce: str) -> int:
    """In a worker: run ``python -m benchmarks <argv>`` and return its exit code."""
    run = RunFolder(Path(folder))
    if _read(run.checkpoint / TICKET).get("nonce") != nonce:
        raise BenchmarkError(
            f"{folder} on {socket.gethostname()} is not the folder that the harness sees; "
            "--results must lie on storage that all nodes share"
        )
    # ray.cancel does nothing where the cluster was started in a script's background, which ignores
    # SIGINT, and its workers with it
    signal.signal(signal.SIGINT, signal.default_int_handler)
    job = Job(argv, run.log)
    place = {"nonce": nonce, "host": socket.gethostname(), "pid": os.getpid()}
    write_text(run.checkpoint / WORKER, json.dumps(place | {"run": job.process.pid}))
    try:
        while job.poll() is None:
            time.sleep(POLL_SECONDS)
    finally:  # ray.cancel raises KeyboardInterrupt here
        if job.poll() is None:
            job.stop()
            job.wait(GRACE_SECONDS)
    return int(job.process.returncode)


def _read(path: Path) -> dict[str, Any]:
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


class RayBackend(Backend):
    """Places runs on a Ray cluster.

    Args:
        address: of a running cluster, "auto" for the one that this machine belongs to; None starts
            a Ray of its own on this machine.
        gpus_per_run: GPUs, or the fraction of one, that Ray reserves for a run.
        jobs: runs at a time; None leaves it to the cluster's resources.

    Raises:
        BenchmarkError: Ray is not installed, there is no such cluster, or no node has such GPUs.
    """

    def __init__(self, address: str | None, gpus_per_run: float, jobs: int | None) -> None:
        if gpus_per_run < 0.0 or (gpus_per_run > 1.0 and gpus_per_run != int(gpus_per_run)):
            raise BenchmarkError(
                f"--gpus-per-run {gpus_per_run:g}: must be a fraction from 0 to 1, or a whole "
                "number"
            )
        try:
            importlib.import_module("ray.exceptions")
            self.ray: Any = importlib.import_module("ray")
        except ImportError as error:
            raise BenchmarkError(
                f"--backend ray needs the extra 'cluster': pip install '.[cluster]' ({error})"
            ) from error
        self.slots = sys.maxsize if jobs is None else jobs
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
        own: dict[str, Any] = {"include_dashboard": False} if address is None else {}
        if address is None and jobs is not None:
            own["num_cpus"] = jobs
        try:
            _reach(address)
            self.ray.init(address=address, log_to_driver=False, logging_level="CRITICAL", **own)
        except (OSError, ValueError, RuntimeError) as error:
            raise BenchmarkError(
                f"--address {address}: no Ray cluster answers there ({error}); start one with "
                "'ray start --head', or leave --address out to use this machine"
            ) from error
        most = max(node["Resources"].get("GPU", 0.0) for node in self._nodes())
        if gpus_per_run > most:
            self.close()
            raise BenchmarkError(
                f"--gpus-per-run {gpus_per_run:g}: no node of the cluster has more than {most:g}"
            )
        self._task = self.ray.remote(run_remotely).options(
            num_cpus=1, num_gpus=gpus_per_run, max_retries=0, scheduling_strategy="SPREAD"
        )

    def _nodes(self) -> list[dict[str, Any]]:
        return [node for node in self.ray.nodes() if node["Alive"]]

    def describe(self) -> str:
        """The cluster in a sentence."""
        nodes = self._nodes()
        total = {key: sum(n["Resources"].get(key, 0.0) for n in nodes) for key in ("CPU", "GPU")}
        word = "node" if len(nodes) == 1 else "nodes"
        return f"Ray: {len(nodes)} {word}, {total['CPU']:g} CPUs, {total['GPU']:g} GPUs"

    def submit(self, argv: Sequence[str], folder: RunFolder) -> tuple[Any, str]:
        """Hand a run to Ray; returns the reference of its exit code, and the run's nonce."""
        nonce = uuid.uuid4().hex
        write_text(folder.checkpoint / TICKET, json.dumps({"nonce": nonce}))
        return self._task.remote(list(argv), str(folder.path.resolve()), nonce), nonce

    def start(self, argv: Sequence[str], folder: RunFolder) -> Job:
        """Hand a run to Ray, which starts it when there is room."""
        return RayJob(self, argv, folder)

    def close(self) -> None:
        """Leave the cluster; a Ray of its own ends."""
        self.ray.shutdown()


class RayJob(Job):
    """A run in Ray's hands."""

    def __init__(self, backend: RayBackend, argv: Sequence[str], folder: RunFolder) -> None:
        self.log = folder.log
        self._backend, self._argv, self._folder = backend, argv, folder
        self._code: int | None = None
        self._news: list[str] = []
        self._retries = 0
        self._submit()

    def _submit(self) -> None:
        self._share = self._folder.progress()[0]
        self._reference, self._nonce = self._backend.submit(self._argv, self._folder)

    def poll(self) -> int | None:
        if self._code is None:
            ready, _ = self._backend.ray.wait([self._reference], timeout=0)
            if ready:
                self._take()
        return self._code

    def _take(self) -> None:
        errors = self._backend.ray.exceptions
        try:
            code = int(self._backend.ray.get(self._reference))
        except errors.TaskCancelledError:
            self._code = 130
        except errors.RayTaskError as error:  # our own function failed: no use in trying again
            cause = getattr(error, "cause", None)
            self._fail(str(error if cause is None else cause))
        except errors.RayError as error:
            self._lost(type(error).__name__)
        else:
            if code < 0:
                self._lost(f"killed by signal {-code}")
            else:
                self._code = code

    def _lost(self, how: str) -> None:
        share = self._folder.progress()[0]
        self._retries = 0 if share > self._share else self._retries + 1
        if self._retries > RETRIES:
            self._fail(f"its worker was lost {self._retries} times in a row ({how})")
            return
        where = _read(self._folder.checkpoint / WORKER).get("host", "its node")
        self._news.append(f"lost its worker on {where} ({how}); resumes from its last checkpoint")
        self._submit()

    def _fail(self, text: str) -> None:
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("a", encoding="utf-8") as stream:
            stream.write(f"{text}\n")
        self._code = 2

    def place(self) -> str | None:
        worker = _read(self._folder.checkpoint / WORKER)
        return str(worker["host"]) if worker.get("nonce") == self._nonce else None

    def news(self) -> list[str]:
        news, self._news = self._news, []
        return news

    def stop(self) -> None:
        # one that waits for its turn never starts
        if self._code is None:
            self._backend.ray.cancel(self._reference, force=False, recursive=False)

    def wait(self, seconds: float) -> None:
        if self._code is None:
            self._backend.ray.wait([self._reference], timeout=max(0.1, seconds))


def _reach(address: str | None) -> None:
    """Try ``host:port`` for a moment, or raise OSError; Ray itself would try for minutes."""
    host, _, port = (address or "").rpartition(":")
    if host and "/" not in host and port.isdigit():
        socket.create_connection((host, int(port)), timeout=CONNECT_SECONDS).close()
