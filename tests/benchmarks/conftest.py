"""Fixtures of the harness's tests."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from benchmarks.cli import main


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
