"""The scheduler of the classic tasks: the same harness, other cells."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from typing import Any, Final

from benchmarks.errors import BenchmarkError
from benchmarks.runs.harness import Harness
from benchmarks.runs.store import RunFolder
from benchmarks.studies.classic.plan import CLIFF, Cell, expand, settings, work_units

RUN_BYTES: Final = 20_000_000  # a run's small files and its model twice
TRANSITION_BYTES: Final = 1_600  # of a checkpointed replay buffer: two images of 10 x 10 x 7


class ClassicHarness(Harness):
    """Runs what a preset of the classic tasks lacks."""

    train_words = ("classic", "train")

    def missing(self) -> tuple[list[Any], list[Any]]:
        """The cells still to run and those complete; all are checked against their settings."""
        todo: list[Cell] = []
        done: list[Cell] = []
        for cell in expand(self.preset):
            folder = self.store.run(cell.id)
            folder.check_config(settings(self.preset, cell))
            (done if folder.is_complete() else todo).append(cell)
        return todo, done

    def check_disk(self, todo: Sequence[Any]) -> None:
        """Refuse to start what would fill the disk: the checkpoints of what runs side by side."""
        largest = 0
        for cell in todo:
            if cell.kind != CLIFF:
                task = self.preset.tasks[cell.task]
                size = int(task.methods[cell.method].get("buffer_size", 1_000_000))
                largest = max(largest, 2 * TRANSITION_BYTES * size)
        needed = RUN_BYTES * len(todo) + self.backend.slots * largest
        free = shutil.disk_usage(self.store.folder).free
        if free < needed:
            raise BenchmarkError(
                f"{self.store.folder}: {needed / 1e9:.1f} GB may be needed for {len(todo)} runs, "
                f"{free / 1e9:.1f} GB are free; make room or use another --results folder"
            )

    def work_units(self, cell: Any) -> int:
        """A rough cost of a cell, for the progress bar."""
        return work_units(self.preset, cell)

    def verdict(self, folder: RunFolder) -> str:
        """What is said of a cell at its end."""
        if folder.has_rows("episodes"):
            rows = folder.rows("episodes")
            return f", return {rows['return'].mean():.1f} over {len(rows)} test episodes"
        rows = folder.rows("updates")
        return f", {len(rows)} seeds"
