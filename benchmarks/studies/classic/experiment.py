"""The classic tasks as an experiment of the harness."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.presets import absolute
from benchmarks.runs.experiment import Experiment, StopRequested
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.classic import presets
from benchmarks.studies.classic.atari import PREFIX
from benchmarks.studies.classic.presets import (
    CONTROL,
    LEARN,
    SuiteCell,
    SuitePreset,
    algorithm_of,
    load_preset,
)

if TYPE_CHECKING:
    from benchmarks.reporting.figures.style import Picture
    from benchmarks.reporting.tables.table import Table

# of a transition in a checkpointed replay buffer: two images of 10 x 10 x 7; a stack of frames
TRANSITION_BYTES: Final = 1_600
ATARI_BYTES: Final = 60_000


class Classic(Experiment[SuiteCell]):
    """Cells of a preset of the classic tasks, loaded if its name or its file's path is given."""

    place = "classic"
    printed = ("scores", "controls", "normalized", "together", "contact", "friction")

    def __init__(self, preset: SuitePreset | str) -> None:
        self.preset = load_preset(preset) if isinstance(preset, str) else preset
        name = preset if isinstance(preset, str) else preset.name
        super().__init__(self.preset.name, preset=absolute(name))

    def cells(self) -> Sequence[SuiteCell]:
        return presets.expand(self.preset)

    def settings(self, cell: SuiteCell) -> dict[str, Any]:
        return presets.settings(self.preset, cell)

    def check(self, todo: Sequence[SuiteCell]) -> None:
        from benchmarks.studies.classic.train import build_model

        for key, method in {(cell.task, cell.method) for cell in todo if cell.kind == LEARN}:
            task = self.preset.tasks[key]
            try:
                env = build_model(task, method, 0).get_env()
            except BenchmarkError:
                raise
            except Exception as error:  # whatever a constructor makes of what it was given
                raise BenchmarkError(
                    f"{task.title}: {method} cannot be built: {type(error).__name__}: {error}"
                ) from error
            assert env is not None
            env.close()

    def units(self, config: dict[str, Any]) -> int:
        return presets.units_of(config)

    def kinds(self, config: dict[str, Any]) -> Iterator[tuple[str, ...]]:
        cell = config["cell"]
        yield (cell["task"], cell["method"])
        if cell["kind"] == CONTROL:
            yield (CONTROL, config["task"]["env"])
        elif cell["kind"] == LEARN:
            algorithm, env = algorithm_of(cell["method"]), config["task"]["env"]
            namespace = env.rpartition("/")[0]
            yield ("env", env, algorithm)
            yield ("namespace", namespace, algorithm)
            yield ("namespace", namespace)

    def checkpoint_bytes(self, cell: SuiteCell) -> int:
        if cell.kind != LEARN:
            return 0
        task = self.preset.tasks[cell.task]
        size = int(task.arguments_of(cell.method).get("buffer_size", 1_000_000))
        return (ATARI_BYTES if task.env.startswith(PREFIX) else TRANSITION_BYTES) * size

    def run(
        self, cell: SuiteCell, folder: RunFolder, stop_requested: StopRequested, device: str
    ) -> dict[str, Any] | None:
        """Train and test a learner, or test a control; on the CPU."""
        from benchmarks.studies.classic.playing import run_control
        from benchmarks.studies.classic.train import run_learner

        run = run_learner if cell.kind == LEARN else run_control
        training = run(self.preset, cell, folder, stop_requested)
        return None if training is None else {"training": training}

    def verdict(self, folder: RunFolder) -> str:
        rows = folder.rows("episodes")
        return f", return {rows['return'].mean():.1f} over {len(rows)} test episodes"

    def tables(self, store: Store) -> list[Table]:
        from benchmarks.studies.classic.results import SuiteResults
        from benchmarks.studies.classic.tables import build_tables

        return build_tables(SuiteResults(self.preset, store))

    def pictures(self, store: Store) -> list[Picture]:
        from benchmarks.studies.classic.figures import pictures
        from benchmarks.studies.classic.results import SuiteResults

        return pictures(SuiteResults(self.preset, store))

    def problems(self, store: Store) -> list[str]:
        from benchmarks.studies.classic.results import SuiteResults

        return SuiteResults(self.preset, store).problems()
