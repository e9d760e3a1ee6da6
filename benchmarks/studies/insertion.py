"""The experiment of a preset: learners, planners and the design on the insertion task."""

import time
from collections.abc import Sequence
from typing import Any

from benchmarks.errors import BenchmarkError
from benchmarks.protocol.plan import DESIGN, Cell
from benchmarks.protocol.presets import Preset, preset_names
from benchmarks.protocol.seeding import derive
from benchmarks.reporting.results import Result, Results
from benchmarks.reporting.tables.beyond import build_tables
from benchmarks.reporting.tables.table import Table
from benchmarks.reporting.verify import check_runs
from benchmarks.runs.cell import ProgressReporter
from benchmarks.runs.experiment import Experiment, StopRequested
from benchmarks.runs.store import RunFolder, Store


class Insertion(Experiment[Preset]):
    """Learners, controls, planners and the design on the insertion task."""

    # the paper's tables; the others are written beside them
    printed: Sequence[str] = (
        "performance",
        "controls",
        "ablation",
        "geometry",
        "design",
        "team",
        "difficulty",
    )

    def __init__(self, preset: Preset | str) -> None:
        super().__init__(preset)
        if self.name not in preset_names():  # a user's own, perhaps with his own learner
            self.printed = (*self.printed, "leaderboard")

    def build(self, cell: Cell) -> Any:
        from benchmarks.methods.learners import build_small

        return build_small(self.preset, cell)

    def try_script(self, cell: Cell) -> None:
        from benchmarks.methods.episodes import env_arguments
        from benchmarks.methods.team.env import make_env

        if cell.method != DESIGN:
            track = self.preset.tracks[cell.track] if cell.track else None
            make_env(**env_arguments(self.preset, cell, track)).close()

    def kind(self, config: dict[str, Any]) -> tuple[str, ...]:
        cell, track = config["cell"], config.get("track", {})
        h = track.get("hyperparameters", {})
        work = [h.get(name) for name in ("updates_per_step", "batch_size", "net_arch")]
        last = cell["ablation" if h else "geometry"]
        return (cell["method"], *map(str, [track.get("team"), *work]), last)

    def run(
        self, cell: Cell, folder: RunFolder, stop_requested: StopRequested, device: str
    ) -> dict[str, Any] | None:
        """Train and test a learner, test a control or planner, or optimize the geometry."""
        from benchmarks.evaluation.evaluate import evaluate_cell

        training: dict[str, Any] = {}
        if cell.method == DESIGN:
            from benchmarks.methods.geometric_design import measured_runs, table_rows

            assert self.preset.design is not None
            runs = measured_runs(self.preset.design.runs, lambda _: None)
            folder.write_rows("design", table_rows(runs))
        elif cell.learns:
            from benchmarks.runs import policy_file
            from benchmarks.runs.training import train

            trained = train(self.preset, cell, folder, stop_requested, device)
            if trained is None:
                return None
            model, training = trained
            folder.write_progress(1.0, "testing")
            began = time.perf_counter()
            training["weights_sha256"] = policy_file.digest(model)
            policy_file.reduce_to_acting(model)
            folder.write_rows("episodes", evaluate_cell(self.preset, cell, model=model))
            policy_file.save(model, folder.policy)
            training["policy_sha256"] = folder.policy_digest()
            training["test_seconds"] = time.perf_counter() - began
        else:
            rows = evaluate_cell(self.preset, cell, ProgressReporter(folder, stop_requested))
            folder.write_rows("episodes", rows)
        seeds = {
            "cell": cell.seed,
            "learner": derive("learner", cell.seed),  # of its training episodes too
            "first_test_episode": derive(self.preset.evaluation.stream, cell.seed, 0),
        }
        return {"seeds": seeds, "training": training}

    def verdict(self, folder: RunFolder) -> str:
        if not folder.has_rows("episodes"):
            return ""
        clean = Result.read(folder).test()
        return f", success {100 * clean['success'].mean():.0f} % of {len(clean)} test episodes"

    def tables(self, store: Store) -> list[Table]:
        return build_tables(Results(store))

    def pictures(self, store: Store) -> Sequence[Any]:
        from benchmarks.reporting.figures.learning import pictures

        return pictures(Results(store))

    def problems(self, store: Store) -> list[str]:
        result = check_runs(store)
        for cell in self.cells:
            try:
                if (run := store.run(cell.id)).is_complete():
                    run.check_config(self.settings(cell))
            except BenchmarkError as error:
                result.append(str(error))
        return list(dict.fromkeys(result))  # a file that cannot be read is named by both
