"""Processes that tests start, and the files that git tracks."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent


def python(*argv: str, **options: Any) -> subprocess.CompletedProcess[str]:
    """A Python process that ended well, with what it wrote."""
    done = subprocess.run(
        [sys.executable, *argv], capture_output=True, text=True, check=False, **options
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done


def tracked(*patterns: str) -> list[str]:
    """The files of this clone that git tracks and that fit a pattern."""
    listed = subprocess.run(
        ["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, text=True, check=False
    )
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    return listed.stdout.split()
