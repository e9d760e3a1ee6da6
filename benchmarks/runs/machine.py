"""The commit, versions and machine of a run."""

import importlib.metadata
import os
import platform
import subprocess
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

PACKAGES: Final = (
    *("torch", "stable-baselines3", "sb3-contrib", "gymnasium", "numpy", "numba", "ompl"),
    *("MinAtar", "Box2D"),
)
REPOSITORY: Final = Path(__file__).resolve().parents[2]


@lru_cache(maxsize=1)
def describe() -> dict[str, Any]:
    """Commit, dirty flag, versions and machine; unknown parts are the word "unknown"."""
    return {
        "commit": _git("rev-parse", "HEAD") or "unknown",
        # results are written while a run is on; only changed sources make a commit dirty
        "dirty": bool(_git("status", "--porcelain", "-uno", "--", "*.py", "*.yaml", ":!results")),
        "versions": {"python": platform.python_version(), **_versions()},
        "machine": {
            "processor": _processor(),
            "cores": os.cpu_count() or 0,
            "system": f"{platform.system()} {platform.machine()}",
        },
    }


def _git(*arguments: str) -> str:
    try:
        done = subprocess.run(
            ["git", *arguments], cwd=REPOSITORY, capture_output=True, text=True, timeout=20
        )
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _versions() -> dict[str, str]:
    result = dict.fromkeys(PACKAGES, "absent")
    for package in PACKAGES:
        with suppress(importlib.metadata.PackageNotFoundError):
            result[package] = importlib.metadata.version(package)
    return result


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or "unknown"
