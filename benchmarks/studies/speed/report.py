"""What the speed benchmarks share: where a measurement comes from, and where it goes."""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.runs.machine import describe
from benchmarks.runs.store import write_text

T = TypeVar("T")


def provenance(name: str, argv: list[str] | None) -> dict[str, Any]:
    """The command, the machine and its load."""
    return {
        "command": " ".join([f"python -m benchmarks speed {name}", *(argv or [])]),
        "machine": describe(),
        "load": os.getloadavg()[0],
    }


def measured(what: str, measure: Callable[..., T], *arguments: Any) -> T:
    """``measure(*arguments)``, said on standard error before and after: it takes a while."""
    print(f"measuring {what} ...", end=" ", file=sys.stderr, flush=True)
    began = time.perf_counter()
    found = measure(*arguments)
    print(f"{time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return found


def write(results: Path, name: str, found: dict[str, Any], text: str) -> None:
    """Write ``speed/<name>.json`` and ``.md`` below the results folder, and print the text."""
    folder = results / "speed"
    write_text(folder / f"{name}.json", json.dumps(found, indent=1) + "\n")
    write_text(folder / f"{name}.md", text)
    print(text)
    print(f"Written to {folder / name}.json and .md")
