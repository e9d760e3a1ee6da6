"""Fixtures of the harness's tests."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator

import pytest

from benchmarks.cli import main
from tests.benchmarks.runs.warm import Server


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs a command that is bad input: exit code 2 and one line of error, which it returns."""

    def run(*words: str) -> str:
        capsys.readouterr()
        assert main([*words]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert error.count("\n") == 1
        return error

    return run


@pytest.fixture(scope="session")
def warm() -> Iterator[Server]:
    """Its ``children()`` are the processes of a harness without the seconds of their imports."""
    if not hasattr(os, "fork"):
        pytest.skip("needs os.fork")
    learners = ("rainbow-optimized-safe-s0", "dqn-optimized-safe-s0")
    server = Server("smoke", *learners, "rrt_connect-optimized-s0")
    yield server
    server.close()


@pytest.fixture
def forked(warm: Server) -> Iterator[None]:
    with warm.children():
        yield
