"""Presets of the public tasks, and which cells each holds.

YAML with strict keys, as the insertion task's; ``_library.yaml`` holds the tasks in full.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol import presets
from benchmarks.protocol.presets import as_dict, mapping, preset_file, read_yaml
from benchmarks.protocol.strict import (
    STRICT,
    Count,
    Names,
    Number,
    Seeds,
    build,
    merge,
    with_config,
)
from benchmarks.studies.classic.atari import PREFIX
from benchmarks.studies.classic.controls import SCRIPTS

PRESETS: Final = Path(__file__).parent / "presets"
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
    arguments: dict[str, Any] = field(default_factory=dict)  # of every method
    skip: Names = field(default_factory=list)  # the preset's methods that mean nothing here
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

    def arguments_of(self, method: str) -> dict[str, Any]:
        """A method's constructor arguments."""
        return {**self.arguments, **self.methods[method]}


@with_config(STRICT)
@dataclass(frozen=True)
class SuitePreset:
    """What runs, with which settings."""

    name: str
    description: str
    seeds: Seeds
    final_episodes: Count
    tasks: dict[str, Task]
    methods: Names = field(default_factory=lambda: list(DISCRETE))
    controls: Names = field(default_factory=list)  # a script only where a task has one
    checkpoint_seconds: Number = 60.0
    search: bool = False  # compares settings of an algorithm rather than algorithms


def preset_names() -> list[str]:
    """The presets that come with the package."""
    return presets.preset_names(PRESETS)


def load_preset(name: str) -> SuitePreset:
    """Load a preset by name, or by the path of a ``.yaml`` file of one's own.

    Raises:
        BenchmarkError: there is no such preset, or the file has an unknown or impossible key.
    """
    path = preset_file(name, PRESETS, "known presets of classic")
    library = read_yaml(PRESETS / "_library.yaml")["tasks"]
    # keys that begin with x- hold what others refer to
    data = {key: value for key, value in read_yaml(path).items() if not str(key).startswith("x-")}
    data["tasks"] = mapping(data.get("tasks"), f"{path.name}: tasks")
    for key, override in data["tasks"].items():
        given = mapping(override, f"{path.name}: tasks: {key}")
        if not given and key not in library:
            raise BenchmarkError(f"{path.name}: tasks: unknown '{key}'; known: {known(library)}")
        data["tasks"][key] = merge(library.get(key, {}), given)
    preset = build(SuitePreset, {**data, "name": path.stem}, path.name)
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
            if method not in {*task.methods, *task.skip}:
                raise BenchmarkError(
                    f"{path.name}: tasks: {key}: methods has no settings for '{method}'"
                )
    return preset


LEARN: Final = "learn"
CONTROL: Final = "control"
# roughly the seconds of an environment step with its share of updates, for progress bars alone
STEP_COST: Final = {"qrdqn": 2.0, "sac": 4.0, "crossq": 4.0, "td3": 3.0}
ATARI_COST: Final = 10.0  # times as much
CONTROL_COST: Final = 20.0  # of an episode that is tested


@dataclass(frozen=True, order=True)
class SuiteCell:
    """One run: a method or a control on a task with a seed, its ``number``."""

    kind: str  # learn or control
    task: str
    method: str
    number: int

    @property
    def id(self) -> str:
        """The run's folder name, unique within a preset."""
        return f"{self.task}-{self.method}-s{self.number}"


def expand(preset: SuitePreset) -> list[SuiteCell]:
    """All cells, the first seeds of all tasks first, so that an early stop leaves whole rows."""
    cells = []
    for key, task in preset.tasks.items():
        for seed in preset.seeds if task.seeds is None else task.seeds:
            methods = [method for method in preset.methods if method not in task.skip]
            cells += [SuiteCell(LEARN, key, method, seed) for method in methods]
            for control in preset.controls:
                if control != "script" or task.env in SCRIPTS:
                    cells.append(SuiteCell(CONTROL, key, control, seed))
    return sorted(cells, key=lambda cell: (cell.number, -units_of(settings(preset, cell))))


def units_of(config: dict[str, Any]) -> int:
    """A rough cost of a run by its settings, for progress bars and the order of runs."""
    cell, task = config["cell"], config["task"]
    cost = ATARI_COST if task["env"].startswith(PREFIX) else 1.0
    if cell["kind"] == CONTROL:
        return round(cost * CONTROL_COST * config["final_episodes"])
    cost *= STEP_COST.get(algorithm_of(cell["method"]), 1.0)
    return max(1, round(task["timesteps"] * cost))


def settings(preset: SuitePreset, cell: SuiteCell) -> dict[str, Any]:
    """Everything that decides the cell's result, as plain YAML types: the run's config.yaml."""
    task = as_dict(preset.tasks[cell.task])
    if cell.kind == CONTROL:
        tested = {key: task[key] for key in ("env", "env_kwargs", "eval_episodes")}
        return {"cell": asdict(cell), "task": tested, "final_episodes": preset.final_episodes}
    played = ("env", "timesteps", "eval_every", "eval_episodes", "env_kwargs", "policy", "n_envs")
    rare = [word for word in ("guide", "bare") if task[word]]
    return {
        "cell": asdict(cell),
        "task": {key: task[key] for key in (*played, *rare)},
        "arguments": preset.tasks[cell.task].arguments_of(cell.method),
        "final_episodes": preset.final_episodes,
    }
