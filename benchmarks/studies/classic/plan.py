"""Which cells a preset of the classic tasks holds, and what decides and costs each."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

from benchmarks.protocol.presets import as_dict
from benchmarks.studies.classic.environments.atari import PREFIX
from benchmarks.studies.classic.environments.controls import SCRIPTS
from benchmarks.studies.classic.presets import Preset, algorithm_of

LEARN: Final = "learn"
CONTROL: Final = "control"
CLIFF: Final = "cliff"
REPLAYS: Final = ("prioritized", "uniform")
# roughly the seconds of an environment step with its share of updates, for progress bars alone
STEP_COST: Final = {"qrdqn": 2.0, "sac": 4.0, "crossq": 4.0, "td3": 3.0}
ATARI_COST: Final = 10.0  # times as much
CONTROL_COST: Final = 20.0  # of an episode that is tested


@dataclass(frozen=True, order=True)
class Cell:
    """One run: a method or a control on a task with a seed, or one replay on a walk of one length.

    For the cliff walk ``task`` is the variant, ``method`` the replay and ``number`` the states,
    otherwise ``number`` is the seed.
    """

    kind: str  # learn, control or cliff
    task: str
    method: str
    number: int

    @property
    def id(self) -> str:
        """The run's folder name, unique within a preset."""
        if self.kind == CLIFF:
            return f"{CLIFF}-{self.task}-{self.method}-n{self.number}"
        return f"{self.task}-{self.method}-s{self.number}"


def expand(preset: Preset) -> list[Cell]:
    """All cells, the first seeds of all tasks first, so that an early stop leaves whole rows."""
    cells = []
    for key, task in preset.tasks.items():
        for seed in preset.seeds if task.seeds is None else task.seeds:
            cells += [Cell(LEARN, key, method, seed) for method in preset.methods]
            for control in preset.controls:
                if control != "script" or task.env in SCRIPTS:
                    cells.append(Cell(CONTROL, key, control, seed))
    cells.sort(key=lambda cell: (cell.number, -units_of(settings(preset, cell))))
    for key, variant in preset.cliff.items():
        for states in variant.states:
            cells += [Cell(CLIFF, key, replay, states) for replay in REPLAYS]
    return cells


def units_of(config: dict[str, Any]) -> int:
    """A rough cost of a run by its settings, for progress bars and the order of runs."""
    cell = config["cell"]
    if cell["kind"] == CLIFF:
        variant = config["variant"]
        return max(1, round(variant["seeds"] * min(variant["limit"], 2.0 ** cell["number"]) / 10))
    task = config["task"]
    cost = ATARI_COST if task["env"].startswith(PREFIX) else 1.0
    if cell["kind"] == CONTROL:
        return round(cost * CONTROL_COST * config["final_episodes"])
    cost *= STEP_COST.get(algorithm_of(cell["method"]), 1.0)
    return max(1, round(task["timesteps"] * cost))


def settings(preset: Preset, cell: Cell) -> dict[str, Any]:
    """Everything that decides the cell's result, as plain YAML types: the run's config.yaml."""
    if cell.kind == CLIFF:
        variant = as_dict(preset.cliff[cell.task])
        for words in ("states", "title", "measure"):
            del variant[words]
        return {"cell": asdict(cell), "variant": variant}
    task = as_dict(preset.tasks[cell.task])
    if cell.kind == CONTROL:
        played = {key: task[key] for key in ("env", "env_kwargs", "eval_episodes")}
        return {"cell": asdict(cell), "task": played, "final_episodes": preset.final_episodes}
    arguments = task.pop("methods")[cell.method]
    for words in ("seeds", "title", "goal", "published", "random", "human"):
        del task[words]
    for word in ("guide", "bare"):
        if not task[word]:
            del task[word]
    return {
        "cell": asdict(cell),
        "task": task,
        "arguments": arguments,
        "final_episodes": preset.final_episodes,
    }
