"""A fabricated store whose numbers are known, for tests of tables, figures and the report."""

import dataclasses
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

from benchmarks.evaluation.evaluate import levels
from benchmarks.protocol.plan import Cell, expand, settings
from benchmarks.protocol.presets import Preset, load_preset
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.results import Results
from benchmarks.reporting.tables.beyond import build_tables
from benchmarks.runs.store import Store

EPISODES = 10
MOVES = {"optimum": 20, "optimum_at_once": 16}  # of others 25
SOLVED = {
    **dict.fromkeys(("optimum", "optimum_at_once"), 10),
    **dict.fromkeys(("rainbow", "maskable_ppo"), 9),
    **dict.fromkeys(("lookahead", "lookahead_observed", "rrt_lattice", "plan_search"), 8),
    **dict.fromkeys(("greedy", "greedy_observed"), 7),
    **{"dqn": 6, "rrt_connect": 5, "nominal_plan": 5, "random": 1},
}


def episode(number: int, noise: float, success: bool, moves: int) -> dict[str, object]:
    nothing = float("nan")
    return {
        "episode": number,
        "reset_seed": number,
        "start": f"start{number}",
        "noise": noise,
        "success": success,
        "holes": 2 * success,
        "all_holes": False,
        "moves_first": moves if success else nothing,
        "time_first": 0.2 * moves if success else nothing,
        "alignment_error": 0.5 if success else nothing,
        "trajectory_error": 3.0 if success else nothing,
        "collisions": number % 2,
        "energy": 10.0,
        "failure": "" if success else "precision",
        "plan_seconds": 0.003,
    }


def curve(cell: Cell) -> list[dict[str, object]]:
    """Rows of a training of 500 steps that enters the second stage at 300."""
    return [
        {"timesteps": t, "episodes": t // 50, "stage": int(t >= 300), "success_20": 0.5,
         "episode_reward": t / 10 + cell.seed, "learning_rate": 1e-3, "noise": 0.1,
         "holes": 1.0 + 0.1 * cell.seed, "success": 0.5, "mean_max_q": 2.0, "loss": 1.0,
         "duration": 40.0}
        for t in range(100, 600, 100)
    ]  # fmt: skip


def fill(
    store: Store, preset: Preset, cell: Cell, solved: int, more: int = 1, **training: Any
) -> None:
    """A complete run that solves the first ``solved`` episodes.

    One fewer with noise, one more without an error of the base, ``more`` exploring. A learner's
    meta.json says ``training`` of it beside what is the same for all.
    """
    run, acting = store.run(cell.id), {"acting": "greedy"} if preset.evaluation.exploring else {}
    seeds = episode_seeds(cell.seed, preset.evaluation.episodes, preset.evaluation.stream)
    rows = []
    for at in levels(preset, cell):
        right = solved - (at.noise > 0) + (at.columns.get("error") == 0.0) + more * at.exploring
        rows += [
            {**episode(i, at.noise, i < right, MOVES.get(cell.method, 25)), **acting, **at.columns,
             "reset_seed": seed}
            for i, seed in enumerate(seeds)
        ]  # fmt: skip
    learned = {
        **{"timesteps": 500, "singular": 2, "episodes": 500},
        **{"final_success_20": 0.9, "curriculum_switch": 300},
    }
    with mock.patch("os.fsync"):  # half of the time, and no test needs it
        run.begin(settings(preset, cell))
        run.write_rows("episodes", rows)
        if cell.learns:
            run.write_rows("curve", curve(cell))
        run.write_meta({
            "cell": cell.id, "training": learned | training if cell.learns else {},
            "wall_seconds": 60.0, "cpu_seconds": 60.0, "commit": "abc", "dirty": False,
            "machine": {"processor": "test"},
        })  # fmt: skip


def write_tables(store: Store) -> list[Path]:
    return [path for table in build_tables(Results(store)) for path in table.write(store.tables)]


def make_store(
    root: Path,
    seeds: Sequence[int],
    preset_name: str = "quick",
    keep: Callable[[Cell], bool] = lambda cell: True,
    episodes: int = EPISODES,
) -> Store:
    """A store of a preset with other seeds: each method solves what ``SOLVED`` says.

    A seed takes its number off what is solved, an ablation one more; ``keep`` leaves cells out.
    """
    shipped = load_preset(preset_name)
    tests = dataclasses.replace(shipped.evaluation, episodes=episodes)
    preset = dataclasses.replace(shipped, seeds=list(seeds), evaluation=tests)
    store = Store.open(root, preset_name, create=True)
    for cell in expand(preset):
        if cell.method != "design" and keep(cell):
            solved = SOLVED[cell.method] - (cell.ablation != "full") - cell.seed
            fill(store, preset, cell, solved, steps_to_75=30_000 if solved > 7 else None)
    return store
