"""What the speed benchmarks share: taking turns, where a figure comes from, and where it goes."""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Hashable, Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import psutil

from benchmarks.errors import at_least
from benchmarks.reporting.tables.table import Table
from benchmarks.runs.machine import describe
from benchmarks.runs.store import write_text
from benchmarks.studies.speed.setting import seconds_of

T = TypeVar("T")
Name = TypeVar("Name", bound=Hashable)


def in_turns(
    actions: Mapping[Name, Callable[[], Any]], rounds: int, n_calls: int = 1, unit: float = 1.0
) -> dict[Name, float]:
    """CPU time of a call, in ``unit`` s: medians over rounds in turns; the first is not counted."""
    times: dict[Name, list[float]] = {name: [] for name in actions}
    for _ in range(rounds + 1):
        for name, action in actions.items():
            times[name].append(seconds_of(action, n_calls).cpu / unit)
    return {name: statistics.median(values[1:]) for name, values in times.items()}


def resident_mb() -> float:
    """Memory of this process."""
    return float(psutil.Process().memory_info().rss) / 1e6


def parser(word: str, text: str | None, steps: int, rounds: int) -> argparse.ArgumentParser:
    """The command line of ``speed <word>``, with its defaults."""
    found = argparse.ArgumentParser(prog=f"python -m benchmarks speed {word}", description=text)
    found.add_argument("--results", type=Path, default=Path("results"))
    found.add_argument(
        "--steps", type=at_least(1), default=steps, help="steps per round and method"
    )
    found.add_argument("--rounds", type=at_least(1), default=rounds)
    return found


def provenance(word: str, argv: list[str], arguments: argparse.Namespace) -> dict[str, Any]:
    """The command, the machine and its load."""
    return {
        "command": " ".join([f"python -m benchmarks speed {word}", *argv]),
        "machine": describe(),
        "load": os.getloadavg()[0],
        "steps": arguments.steps,
        "rounds": arguments.rounds,
    }


def measured(what: str, measure: Callable[..., T], *arguments: Any) -> T:
    """``measure(*arguments)``, said on standard error before and after: it takes a while."""
    print(f"measuring {what} ...", end=" ", file=sys.stderr, flush=True)
    began = time.perf_counter()
    found = measure(*arguments)
    print(f"{time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return found


def table(title: str, header: str, rows: Iterable[Iterable[str]]) -> str:
    """A table of the page as Markdown, the header's columns parted by `` | ``."""
    return Table("", title, header.split(" | "), [list(row) for row in rows]).markdown().strip()


def page(title: str, found: dict[str, Any], where: str, *parts: str) -> str:
    """The measurements as Markdown: the machine, then tables and sentences."""
    machine = found["machine"]
    source = (
        f"Command: `{found['command']}`. {machine['machine']['processor']}, {where}, "
        f"load {found['load']:.1f}, commit {machine['commit'][:10]}, "
        + ", ".join(f"{package} {version}" for package, version in machine["versions"].items())
        + f". Medians over {found['rounds']} rounds of {found['steps']} steps in turns."
    )
    return "\n\n".join([f"# {title}", source, *parts]) + "\n"


def write(results: Path, name: str, found: dict[str, Any], text: str) -> None:
    """Write ``speed/<name>.json`` and ``.md`` below the results folder, and print the text."""
    folder = results / "speed"
    write_text(folder / f"{name}.json", json.dumps(found, indent=1) + "\n")
    write_text(folder / f"{name}.md", text)
    print(text)
    print(f"Written to {folder / name}.json and .md")
