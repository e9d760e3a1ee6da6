"""An experiment: what the harness must know of cells to run them, whatever they compute.

One cell is one independent run with a folder of its own. The harness starts each in a process
(``benchmarks.runs.harness``), which opens the experiment again by its recipe.
"""

import difflib
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from rich.console import Console
from rich.progress import track

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol import plan
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset, SuitePreset, load, own_file
from benchmarks.runs.store import RunFolder, Store

StopRequested = Callable[[], bool]
P = TypeVar("P", Preset, SuitePreset)


class Experiment(ABC, Generic[P]):
    """Cells of a preset: their costs, how one is run, and the tables and figures of all.

    Its store lies in the folder ``place`` below the results folder.

    Args:
        preset: the preset, or its name or its file's path, by which another process loads it.
    """

    place: ClassVar[str] = ""
    printed: Sequence[str] = ()  # names of the tables that a run prints
    #: a run's small files, its TensorBoard events, its model twice
    run_bytes: ClassVar[int] = 20_000_000

    def __init__(self, preset: P | str) -> None:
        self.preset: P = load(preset) if isinstance(preset, str) else preset  # type: ignore[assignment]
        name = self.name = self.preset.name
        if isinstance(preset, str):
            file = own_file(preset)
            name = str(file.resolve()) if file else preset
        self.recipe: dict[str, Any] = {"preset": name}
        self.cells = plan.expand(self.preset)  # in the order in which they are to begin

    def find(self, cell_id: str) -> Cell:
        """The cell of that id; BenchmarkError if there is none."""
        by_id = {cell.id: cell for cell in self.cells}
        if cell_id not in by_id:
            raise BenchmarkError(
                f"preset '{self.name}' has no cell '{cell_id}'; the nearest: "
                f"{known(difflib.get_close_matches(cell_id, by_id, 3, 0))}; `plan` lists all"
            )
        return by_id[cell_id]

    def settings(self, cell: Cell) -> dict[str, Any]:
        """Everything that decides the cell's result, as plain YAML types: its config.yaml."""
        return plan.settings(self.preset, cell)

    @abstractmethod
    def build(self, cell: Cell) -> Any:
        """The untrained learner of a cell, in its environments."""

    def try_script(self, cell: Cell) -> None:
        """Build the environment in which a script or planner plays."""

    def check(self, todo: Sequence[Cell]) -> None:
        """Build each kind of cell once, so that what is impossible fails at once."""
        for cell in {replace(cell, seed=0): cell for cell in todo}.values():
            try:
                if cell.learns:
                    self.build(cell).get_env().close()
                else:
                    self.try_script(cell)
            except BenchmarkError:
                raise
            except Exception as error:  # a constructor may raise anything for wrong arguments
                how = f"{type(error).__name__}: {error}"
                raise BenchmarkError(
                    f"preset '{self.name}': cell {cell.id} cannot be built: {how}"
                ) from error

    def units(self, config: dict[str, Any]) -> int:
        """A rough cost of a run by its settings, in environment steps."""
        return plan.units_of(config)

    @abstractmethod
    def kind(self, config: dict[str, Any]) -> tuple[str, ...]:
        """What decides a run's cost per unit, the most important first."""

    def checkpoint_bytes(self, cell: Cell) -> int:
        """Upper estimate of a checkpoint's size, bytes."""
        return plan.checkpoint_bytes(self.preset, cell)

    @abstractmethod
    def run(
        self, cell: Cell, folder: RunFolder, stop_requested: StopRequested, device: str
    ) -> dict[str, Any] | None:
        """Do the cell's work and write its rows into its folder, which was begun.

        ``stop_requested`` is called now and then; if True, what can be saved is saved and the call
        ends.
        Networks live on ``device``, cpu or cuda.

        Returns:
            What meta.json says of the run, ``training`` at least; None if it was stopped.
        """

    def verdict(self, folder: RunFolder) -> str:
        """The result of a complete run, for its line on the console."""
        return ""

    def tables(self, store: Store) -> Sequence[Any]:
        """The tables of the complete runs."""
        return ()

    def pictures(self, store: Store) -> Sequence[Any]:
        """The figures of the complete runs."""
        return ()

    def problems(self, store: Store) -> list[str]:
        """A sentence for each stored run that is not what its settings say."""
        return []

    def write_tables(self, store: Store, console: Console) -> None:
        """Write the tables of the complete runs, and print the main ones."""
        if not (tables := self.tables(store)):
            console.print("Tables: none yet, no run is complete")
            return
        for table in tables:
            table.write(store.tables)
            if table.name in self.printed and table.rows:
                console.print(table.markdown(), highlight=False)
        console.print(f"Tables (CSV, Markdown, LaTeX): {store.tables}")

    def write_figures(self, store: Store, console: Console) -> None:
        """Draw the figures of the complete runs."""
        options: Any = {"console": console, "disable": not console.is_terminal, "transient": True}
        shown = track(self.pictures(store), "Figures", **options)
        if drawn := [picture.write(store.figures) for picture in shown]:
            console.print(f"Figures: {len(drawn)} in {store.figures}")
        else:
            console.print("Figures: none")

    def report(self, store: Store, console: Console) -> None:
        """Write the tables and figures of the complete runs."""
        self.write_tables(store, console)
        self.write_figures(store, console)

    def open_store(self, results: Path, create: bool = False) -> Store:
        """The experiment's store, as :meth:`~benchmarks.runs.store.Store.open` opens it."""
        return Store.open(results / self.place, self.name, create, self.recipe["preset"])
