"""Presets of the classic tasks: YAML with strict keys; ``_library.yaml`` holds them in full."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol import presets
from benchmarks.protocol.presets import preset_file, read_yaml
from benchmarks.protocol.strict import build, merge

PRESETS: Final = Path(__file__).parent / "presets"
DEFAULT_PRESET: Final = "quick"
METHODS: Final = ("rainbow", "dqn", "qrdqn")


@dataclass(frozen=True)
class Task:
    """An environment, the protocol of its runs, and each method's settings there."""

    title: str
    env: str
    timesteps: int
    eval_every: int  # environment steps between two evaluations
    eval_episodes: int
    methods: dict[str, dict[str, Any]]  # constructor arguments
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    policy: str = "MlpPolicy"
    n_envs: int = 1
    goal: float | None = None  # the mean return at which the task counts as solved
    seeds: list[int] | None = None  # instead of the preset's


@dataclass(frozen=True)
class CliffVariant:
    """One learner of the blind cliff walk, with prioritized replay and without."""

    title: str
    states: list[int]
    measure: str  # learned or solved
    limit: int  # updates after which a run is given up
    seeds: int
    rainbow: dict[str, Any]  # constructor arguments
    optimizer: str = "adam"
    check_every: int = 20  # updates


@dataclass(frozen=True)
class Preset:
    """What runs, with which settings."""

    name: str
    description: str
    seeds: list[int]
    final_episodes: int
    tasks: dict[str, Task]
    cliff: dict[str, CliffVariant] = field(default_factory=dict)
    methods: list[str] = field(default_factory=lambda: list(METHODS))
    checkpoint_seconds: float = 60.0


def preset_names() -> list[str]:
    """The presets that come with the package."""
    return presets.preset_names(PRESETS)


def load_preset(name: str) -> Preset:
    """Load a preset by name, or by the path of a ``.yaml`` file of one's own.

    Raises:
        BenchmarkError: there is no such preset, or the file has an unknown or impossible key.
    """
    path = preset_file(name, PRESETS, "known presets of classic")
    data, library = read_yaml(path), read_yaml(PRESETS / "_library.yaml")
    for section in ("tasks", "cliff"):
        chosen = data.get(section) or {}
        if not isinstance(chosen, dict):
            raise BenchmarkError(f"{path.name}: {section}: expected a mapping, found {chosen!r}")
        data[section] = {
            key: merge(library[section].get(key, {}), override or {})
            for key, override in chosen.items()
        }
    preset = build(Preset, {**data, "name": path.stem}, path.name)
    _check(preset, path.name)
    return preset


def _check(preset: Preset, where: str) -> None:
    for name in preset.methods:
        if name not in METHODS:
            raise BenchmarkError(f"{where}: unknown method '{name}'; known: {known(METHODS)}")
    if preset.final_episodes < 1:
        raise BenchmarkError(f"{where}: final_episodes = {preset.final_episodes} must be above 0")
    _check_seeds(preset.seeds, where)
    for key, task in preset.tasks.items():
        place = f"{where}: tasks: {key}"
        if task.seeds is not None:
            _check_seeds(task.seeds, place)
        for number in ("timesteps", "eval_every", "eval_episodes", "n_envs"):
            if getattr(task, number) < 1:
                raise BenchmarkError(f"{place}: {number} = {getattr(task, number)} must be above 0")
        for method in preset.methods:
            if method not in task.methods:
                raise BenchmarkError(f"{place}: methods has no settings for '{method}'")
    for key, variant in preset.cliff.items():
        place = f"{where}: cliff: {key}"
        if variant.measure not in ("learned", "solved"):
            raise BenchmarkError(f"{place}: measure = '{variant.measure}'; known: learned, solved")
        if variant.optimizer not in ("adam", "sgd"):
            raise BenchmarkError(f"{place}: optimizer = '{variant.optimizer}'; known: adam, sgd")
        if min(variant.limit, variant.seeds, variant.check_every, *variant.states) < 1:
            raise BenchmarkError(f"{place}: limit, seeds, check_every and states must be above 0")


def _check_seeds(seeds: list[int], where: str) -> None:
    if not seeds or len(set(seeds)) != len(seeds) or min(seeds) < 0:
        raise BenchmarkError(f"{where}: seeds: {seeds} must be some, differ and be 0 or above")
