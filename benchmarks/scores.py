"""Scores of stored policies on the test episodes, once more and in words."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import pandas as pd

from benchmarks.errors import BenchmarkError
from benchmarks.evaluate import evaluate_policy, model_policy
from benchmarks.metrics import EXTRA_METRICS, PAPER_METRICS
from benchmarks.model_files import load_model
from benchmarks.plan import expand
from benchmarks.presets import Preset
from benchmarks.store import Store
from benchmarks.train import env_arguments


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
        yield from in_words(rows, f"{name}, seed {seed}")


def in_words(rows: pd.DataFrame, name: str) -> Iterator[str]:
    """One line per level of noise: the paper's metrics, and holes."""
    for noise, group in rows.groupby("noise"):
        parts = [
            f"{metric.label} {metric.reduce(group):.{metric.digits}f}"
            for metric in (*PAPER_METRICS, *EXTRA_METRICS[:2])
        ]
        yield f"{name}, noise {noise:g}: {'; '.join(parts)}"
