"""The public tasks as an experiment of the harness."""

from collections.abc import Sequence
from typing import Any

from gymnasium.spaces import Discrete

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.learners import learner_of
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import SuitePreset
from benchmarks.reporting.tables.table import Table
from benchmarks.runs.experiment import Experiment, StopRequested
from benchmarks.runs.store import RunFolder, Store
from benchmarks.studies.classic.results import SuiteResults


class Classic(Experiment[SuitePreset]):
    """Learners and controls on public tasks."""

    place = "classic"
    printed = ("scores", "controls", "together", "contact")

    def build(self, cell: Cell) -> Any:
        from benchmarks.studies.classic.train import build_model

        return build_model(self.preset.tasks[cell.track], cell.method, cell.seed)

    def try_script(self, cell: Cell) -> None:
        from benchmarks.studies.classic.train import make_env

        env = make_env(task := self.preset.tasks[cell.track])
        env.close()
        actions = env.action_space
        if not (isinstance(actions, Discrete) and actions.start == 0):
            raise BenchmarkError(
                f"{task.env} has actions {actions}: controls play numbers from 0 on"
            )

    def kind(self, config: dict[str, Any]) -> tuple[str, ...]:
        task, method, env = config["cell"]["task"], config["cell"]["method"], config["task"]["env"]
        # games of one kind cost alike, and so do all controls of one
        return (env.rpartition("/")[0], learner_of(method) or "control", env, task, method)

    def run(
        self, cell: Cell, folder: RunFolder, stop_requested: StopRequested, device: str
    ) -> dict[str, Any] | None:
        """Train and test a learner, or test a control; on the CPU."""
        from benchmarks.studies.classic.train import run_control, run_learner

        run = run_learner if cell.learns else run_control
        training = run(self.preset, cell, folder, stop_requested)
        return None if training is None else {"training": training}

    def verdict(self, folder: RunFolder) -> str:
        rows = folder.rows("episodes")
        return f", return {rows['return'].mean():.1f} over {len(rows)} test episodes"

    def tables(self, store: Store) -> list[Table]:
        from benchmarks.studies.classic.report import build_tables

        return build_tables(SuiteResults(self.preset, store))

    def pictures(self, store: Store) -> Sequence[Any]:
        from benchmarks.studies.classic.report import pictures

        return pictures(SuiteResults(self.preset, store))

    def problems(self, store: Store) -> list[str]:
        return SuiteResults(self.preset, store).problems()
