"""Scores on the test episodes: of stored policies, and of any SB3 model brought along."""

from __future__ import annotations

import dataclasses
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.errors import BenchmarkError, known
from benchmarks.evaluate import evaluate_policy, model_policy
from benchmarks.metrics import EXTRA_METRICS, PAPER_METRICS
from benchmarks.plan import Cell, expand
from benchmarks.presets import Preset
from benchmarks.store import Store
from benchmarks.train import ALGORITHMS, env_arguments


def algorithms() -> dict[str, Any]:
    """Names of the algorithms whose models can be scored."""
    import sb3_contrib
    import stable_baselines3

    return {
        **ALGORITHMS,
        "ppo": stable_baselines3.PPO,
        "a2c": stable_baselines3.A2C,
        "maskable_ppo": sb3_contrib.MaskablePPO,
        "qrdqn": sb3_contrib.QRDQN,
    }


def load_model(path: Path, algorithm: str) -> Any:
    """A model saved by SB3.

    Raises:
        BenchmarkError: the algorithm is unknown, or the file is missing or not its model.
    """
    choices = algorithms()
    if algorithm not in choices:
        raise BenchmarkError(f"unknown algorithm '{algorithm}'; known: {known(choices)}")
    if not path.is_file():
        raise BenchmarkError(f"{path} is missing; give a .zip that model.save() wrote")
    try:
        return choices[algorithm].load(path, device="cpu")
    except (ValueError, KeyError, TypeError, RuntimeError, zipfile.BadZipFile) as error:
        raise BenchmarkError(f"{path} is no model of '{algorithm}': {error}") from error


def score_model(preset: Preset, path: Path, algorithm: str, episodes: int | None) -> Iterator[str]:
    """One line per seed, level of noise and geometry 'optimized' for a model of one's own."""
    model = load_model(path, algorithm)
    cell = Cell(algorithm, "full", "optimized", "", 0)
    arguments = env_arguments(preset, cell)
    if model.observation_space.shape != (12,):
        arguments["observation"] = "markov"
    yield from _score(preset, model, arguments, episodes, path.name, preset.seeds)


def score_store(preset: Preset, store: Store, episodes: int | None) -> Iterator[str]:
    """One line per stored policy and level of noise."""
    found = False
    for cell in expand(preset):
        folder = store.run(cell.id)
        if not cell.learns or not folder.is_done(cell.learns):
            continue
        found = True
        model = load_model(folder.policy, cell.method)
        arguments = env_arguments(preset, cell, preset.tracks[cell.track])
        yield from _score(preset, model, arguments, episodes, cell.id, [cell.seed])
    if not found:
        raise BenchmarkError(f"{store.folder} has no trained policy to score: run the preset first")


def _score(
    preset: Preset,
    model: Any,
    arguments: dict[str, Any],
    episodes: int | None,
    name: str,
    seeds: list[int],
) -> Iterator[str]:
    if episodes is not None:
        tests = dataclasses.replace(preset.evaluation, episodes=episodes)
        preset = dataclasses.replace(preset, evaluation=tests)
    for seed in seeds:
        rows = pd.DataFrame(evaluate_policy(model_policy(model), preset, seed, arguments))
        for noise, group in rows.groupby("noise"):
            parts = [
                f"{metric.label} {metric.reduce(group):.{metric.digits}f}"
                for metric in (*PAPER_METRICS, *EXTRA_METRICS[:2])
            ]
            yield f"{name}, seed {seed}, noise {noise:g}: {'; '.join(parts)}"
