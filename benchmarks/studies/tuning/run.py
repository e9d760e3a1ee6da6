"""One training of the search: a configuration and a seed, scored on validation episodes.

Test episodes are never seen: the streams of :mod:`benchmarks.protocol.seeding` are apart, and the
seeds are not those of any preset either.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict
from typing import Any, Final

from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Evaluation, Preset, Track, as_dict
from benchmarks.protocol.strict import build
from benchmarks.runs import machine
from benchmarks.runs.backends import GRACE_SECONDS
from benchmarks.runs.store import RunFolder

FIRST_SEED: Final = 1_000
"""Seeds of the search; those of presets are small numbers."""
STREAM: Final = "validate"


def settings(track: Track, seed: int, episodes: int) -> dict[str, Any]:
    """What decides a training's result: its config.yaml."""
    return {
        "cell": asdict(Cell("rainbow", "full", "optimized", "search", seed)),
        "track": as_dict(track),
        "validation": {"episodes": episodes},
    }


def run(folder: RunFolder, stop_requested: Callable[[], bool] = lambda: False) -> bool:
    """Train and score what a folder's config.yaml says, from its newest checkpoint if it has one.

    Returns:
        Whether it is complete; False if it was stopped, with a checkpoint to go on from.

    Raises:
        BenchmarkError: the folder cannot be read, or another process works on it.
    """
    from benchmarks.evaluation.evaluate import begin_episodes, model_policy, run_policy
    from benchmarks.methods.learners import env_arguments
    from benchmarks.runs.training import train

    if folder.is_complete():
        return True
    config = folder.config()
    cell = Cell(**config["cell"])
    track = build(Track, config["track"], str(folder.path / "config.yaml"))
    preset = Preset("search", "", [cell.seed], Evaluation(1), [], tracks={cell.track: track})
    with folder.lock(GRACE_SECONDS):  # an orphan of a killed search may still be saving
        trained = train(preset, cell, folder, stop_requested)
        if trained is None:
            return False
        model, summary = trained
        folder.write_progress(1.0, "validating")
        episodes = begin_episodes(
            env_arguments(preset, cell, track), cell.seed, config["validation"]["episodes"], STREAM
        )
        folder.write_rows("validation", run_policy(model_policy(model), episodes, 0.0, 0))
        folder.write_meta({"cell": cell.id, "training": summary, **machine.describe()})
        folder.drop_checkpoint()
    return True
