"""What a run imports and compiles, in the process that :mod:`tests.benchmarks.runs.warm` forks."""

import os
import sys
import tempfile
from contextlib import redirect_stdout

os.environ |= {"CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}

import tests.benchmarks.runs.warm  # noqa: F401 - a fork begins there
from benchmarks.cli import main

with tempfile.TemporaryDirectory() as folder, redirect_stdout(sys.stderr):
    for cell in ("rainbow-optimized-safe-s0", "dqn-optimized-safe-s0", "rrt_connect-optimized-s0"):
        main(["train", "--preset", "smoke", "--results", folder, "--cell", cell])
