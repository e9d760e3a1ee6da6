"""Fixtures of the harness's tests."""

from collections.abc import Callable, Iterator
from multiprocessing import get_all_start_methods
from pathlib import Path

import pytest

from benchmarks.cli import main
from tests.benchmarks.runs.warm import children, warm_up

Command = Callable[..., str]


@pytest.fixture
def done(capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs a command that ends well; returns what it printed."""

    def run(*words: str | Path) -> str:
        capsys.readouterr()
        assert main([*map(str, words)]) == 0, capsys.readouterr().err
        return capsys.readouterr().out

    return run


@pytest.fixture
def refused(capsys: pytest.CaptureFixture[str]) -> Command:
    """Runs a command that is bad input: exit code 2 and one line of error, which it returns."""

    def run(*words: str | Path) -> str:
        capsys.readouterr()
        assert main([*map(str, words)]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ")
        assert error.count("\n") == 1
        return error

    return run


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The test's own folder, in which it runs."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="session")
def warm() -> None:
    if "forkserver" not in get_all_start_methods():
        pytest.skip("needs os.fork")
    warm_up()


@pytest.fixture
def forked(warm: None) -> Iterator[None]:
    with children():
        yield
