"""Presets of the classic tasks: YAML with strict keys; ``_library.yaml`` holds them in full."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol import presets
from benchmarks.protocol.presets import preset_file, read_yaml
from benchmarks.protocol.strict import (
    STRICT,
    Count,
    Counts,
    Names,
    Number,
    Seeds,
    build,
    merge,
    with_config,
)

PRESETS: Final = Path(__file__).parent / "presets"
DEFAULT_PRESET: Final = "quick"
CONTACT: Final = "coop_env:CoopInsertionContact-v0"
#: learning algorithms; a method is one of them, or with settings of its own ``<one>_<variant>``
DISCRETE: Final = {"rainbow": "Rainbow", "dqn": "DQN", "qrdqn": "QR-DQN"}
ALGORITHMS: Final = {
    **DISCRETE, "sac": "SAC", "crossq": "CrossQ", "td3": "TD3", "ppo": "PPO",
    "bc": "Behaviour cloning",
}  # fmt: skip
#: Rainbow's defaults when the suites' settings were chosen, which leave some of them unsaid
FORMER_DEFAULTS: Final = {
    "learning_rate": 1e-4,
    "batch_size": 32,
    "gradient_steps": 1,
    "sigma0": 0.5,
    "exploration_initial_eps": 0.0,
    "exploration_final_eps": 0.0,
}
#: what plays without learning
CONTROLS: Final = {"random": "Random", "held": "One action", "script": "Script"}


def algorithm_of(method: str) -> str:
    """The algorithm of a method.

    Raises:
        BenchmarkError: there is none of this name.
    """
    algorithm = method.partition("_")[0]
    if algorithm not in ALGORITHMS:
        raise BenchmarkError(
            f"methods: unknown method '{method}'; known: {known(ALGORITHMS)}, and <one>_<variant>"
        )
    return algorithm


def spelled_out(arguments: dict[str, Any]) -> dict[str, Any]:
    """Rainbow's arguments with its :data:`FORMER_DEFAULTS` where they say nothing.

    Then there was no epsilon beside the noise unless one of its three arguments was given.
    """
    former = dict(FORMER_DEFAULTS)
    if not arguments.get("noisy", True) or any("exploration" in name for name in arguments):
        del former["exploration_initial_eps"], former["exploration_final_eps"]
    if not {"tau", "target_update_interval"} & arguments.keys():
        former["tau"] = 1e-3
    return {**former, **arguments}


def label(method: str) -> str:
    """How tables and figures call a method or a control."""
    if method in CONTROLS:
        return CONTROLS[method]
    variant = method.partition("_")[2].replace("_", " ")
    name = ALGORITHMS[algorithm_of(method)]
    return f"{name}, {variant}" if variant else name


@with_config(STRICT)
@dataclass(frozen=True)
class Guide:
    """Of the contact task: the first steps of off-policy learners are a script's, with noise."""

    steps: Count
    noise: Number  # standard deviation, of a whole increment
    gains: dict[str, Number] = field(default_factory=dict)  # of the moment-guided search


@with_config(STRICT)
@dataclass(frozen=True)
class Task:
    """An environment, the protocol of its runs, and each method's settings there."""

    title: str
    env: str
    timesteps: Count
    eval_every: Count  # environment steps between two evaluations
    eval_episodes: Count
    methods: dict[str, dict[str, Any]]  # constructor arguments, and what changes of the guide
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    policy: str = "MlpPolicy"
    n_envs: Count = 1
    goal: Number | None = None  # the mean return at which the task counts as solved
    seeds: Seeds | None = None  # instead of the preset's
    published: dict[str, Number] = field(default_factory=dict)  # others' means, by whose they are
    guide: Guide | None = None
    bare: bool = False  # Rainbow has its present defaults where the settings say nothing
    random: Number | None = None  # mean returns of a random player and of a human one
    human: Number | None = None


@with_config(STRICT)
@dataclass(frozen=True)
class CliffVariant:
    """One learner of the blind cliff walk, with prioritized replay and without."""

    title: str
    states: Counts
    measure: Literal["learned", "solved"]
    limit: Count  # updates after which a run is given up
    seeds: Count
    rainbow: dict[str, Any]  # constructor arguments
    optimizer: Literal["adam", "sgd"] = "adam"
    check_every: Count = 20  # updates


@with_config(STRICT)
@dataclass(frozen=True)
class Preset:
    """What runs, with which settings."""

    name: str
    description: str
    seeds: Seeds
    final_episodes: Count
    tasks: dict[str, Task]
    cliff: dict[str, CliffVariant] = field(default_factory=dict)
    methods: Names = field(default_factory=lambda: list(DISCRETE))
    controls: Names = field(default_factory=list)  # a script only where a task has one
    checkpoint_seconds: Number = 60.0
    search: bool = False  # compares settings of an algorithm rather than algorithms


def preset_names() -> list[str]:
    """The presets that come with the package."""
    return presets.preset_names(PRESETS)


def load_preset(name: str) -> Preset:
    """Load a preset by name, or by the path of a ``.yaml`` file of one's own.

    Raises:
        BenchmarkError: there is no such preset, or the file has an unknown or impossible key.
    """
    path = preset_file(name, PRESETS, "known presets of classic")
    library = read_yaml(PRESETS / "_library.yaml")
    # keys that begin with x- hold what others refer to
    data = {key: value for key, value in read_yaml(path).items() if not str(key).startswith("x-")}
    for section in ("tasks", "cliff"):
        chosen = data.get(section) or {}
        if not isinstance(chosen, dict):
            raise BenchmarkError(f"{path.name}: {section}: expected a mapping, found {chosen!r}")
        data[section] = {}
        for key, override in chosen.items():
            given = {} if override is None else override
            if not isinstance(given, dict):
                raise BenchmarkError(
                    f"{path.name}: {section}: {key}: expected a mapping, found {given!r}"
                )
            if not given and key not in library[section]:
                raise BenchmarkError(
                    f"{path.name}: {section}: unknown '{key}'; known: {known(library[section])}"
                )
            data[section][key] = merge(library[section].get(key, {}), given)
    preset = build(Preset, {**data, "name": path.stem}, path.name)
    if preset.search and preset.controls:
        raise BenchmarkError(f"{path.name}: controls: a search compares settings, it has none")
    for control in preset.controls:
        if control not in CONTROLS:
            raise BenchmarkError(
                f"{path.name}: controls: unknown '{control}'; known: {known(CONTROLS)}"
            )
    for method in preset.methods:
        algorithm_of(method)
    for key, task in preset.tasks.items():
        for method in preset.methods:
            if method not in task.methods:
                raise BenchmarkError(
                    f"{path.name}: tasks: {key}: methods has no settings for '{method}'"
                )
    return preset
