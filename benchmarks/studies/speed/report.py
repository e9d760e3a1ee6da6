"""Names that studies of the machines still take from here."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any, TypeVar

from benchmarks.reporting.tables.table import plain as table
from benchmarks.studies.speed.timing import in_turns, resident_mb

__all__ = ["in_turns", "measured", "resident_mb", "table"]

T = TypeVar("T")


def measured(what: str, measure: Callable[..., T], *arguments: Any) -> T:
    """``measure(*arguments)``, said on standard error before and after: it takes a while."""
    print(f"measuring {what} ...", end=" ", file=sys.stderr, flush=True)
    began = time.perf_counter()
    found = measure(*arguments)
    print(f"{time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return found
