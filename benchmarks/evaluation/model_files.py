"""Models that SB3 saved: which algorithm wrote a file, and whether it fits the task."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import spaces

from benchmarks.errors import BenchmarkError, known
from benchmarks.methods.learners import ALGORITHMS
from coop_env.env import CoopInsertionEnv

# the module of a saved policy class, from its start -> the algorithm that saves it
_POLICIES: Final = {
    "sb3_rainbow.": "rainbow",
    "sb3_contrib.common.maskable.": "maskable_ppo",
    "sb3_contrib.qrdqn.": "qrdqn",
    "sb3_contrib.ars.": "ars",
    "stable_baselines3.dqn.": "dqn",
}
_RECURRENT: Final = "sb3_contrib.common.recurrent."
_ACTOR_CRITIC: Final = "stable_baselines3.common.policies"
OBSERVATIONS: Final = ("paper", "markov")


def algorithms() -> dict[str, Any]:
    """Names of the algorithms whose models can be scored: what acts on one observation."""
    import sb3_contrib
    import stable_baselines3

    return {
        **ALGORITHMS,
        "a2c": stable_baselines3.A2C,
        "ars": sb3_contrib.ARS,
        "maskable_ppo": sb3_contrib.MaskablePPO,
        "ppo": stable_baselines3.PPO,
        "qrdqn": sb3_contrib.QRDQN,
        "trpo": sb3_contrib.TRPO,
    }


def detect_algorithm(path: Path) -> str:
    """The algorithm whose ``save`` wrote the file.

    Raises:
        BenchmarkError: the file is missing, is no model of SB3, or of an algorithm that is not
            known here or cannot be told.
    """
    if not path.is_file():
        raise BenchmarkError(f"{path} is missing; give a .zip that model.save() wrote")
    try:
        with zipfile.ZipFile(path) as archive:
            data = json.loads(archive.read("data"))
        module = str(data["policy_class"]["__module__"])
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError) as error:
        raise BenchmarkError(
            f"{path} is no model of Stable-Baselines3 ({type(error).__name__}: {error}); give a "
            ".zip that model.save() wrote"
        ) from error
    if module.startswith(_RECURRENT):
        raise BenchmarkError(
            f"{path} holds a recurrent policy, which the test protocol cannot run; known: "
            f"{known(algorithms())}"
        )
    if module.startswith(_ACTOR_CRITIC):
        # three algorithms share the policy; their settings tell them apart
        return "trpo" if "cg_max_steps" in data else "ppo" if "clip_range" in data else "a2c"
    for prefix, algorithm in _POLICIES.items():
        if module.startswith(prefix):
            return algorithm
    raise BenchmarkError(
        f"{path}: its policy is of {module}, from which the algorithm cannot be told; say it with "
        f"--algorithm: {known(algorithms())}"
    )


def load_model(path: Path, algorithm: str | None = None) -> Any:
    """A model saved by SB3, on the CPU.

    Args:
        path: the file.
        algorithm: which class loads it; None finds out.

    Raises:
        BenchmarkError: the algorithm is unknown, or the file is missing or not its model.
    """
    choices = algorithms()
    if algorithm is not None and algorithm not in choices:
        raise BenchmarkError(f"unknown algorithm '{algorithm}'; known: {known(choices)}")
    name = detect_algorithm(path) if algorithm is None else algorithm
    if not path.is_file():
        raise BenchmarkError(f"{path} is missing; give a .zip that model.save() wrote")
    try:
        return choices[name].load(path, device="cpu")
    except (
        AttributeError, ImportError, KeyError, RuntimeError, TypeError, ValueError,
        zipfile.BadZipFile,
    ) as error:  # fmt: skip
        raise BenchmarkError(f"{path} is no model of '{name}': {error}") from error


def fitting_observation(model: Any, path: Path) -> str:
    """Which of the environment's observations a model was trained on.

    Raises:
        BenchmarkError: its observations or its actions are not those of the task.
    """
    envs = {name: CoopInsertionEnv(observation=name) for name in OBSERVATIONS}
    actions = envs["paper"].action_space
    if model.action_space != actions:
        raise BenchmarkError(
            f"{path} acts in {model.action_space}, the task's actions are {actions}: train on "
            "CoopInsertion-v0"
        )
    space = model.observation_space
    for name, env in envs.items():
        if isinstance(space, spaces.Box) and space.shape == env.observation_space.shape:
            if np.all(space.low >= 0.0) and np.all(space.high <= 1.0):
                return name
            raise BenchmarkError(
                f"{path} was trained on observations outside [0, 1] ({space}): the test protocol "
                "has normalized ones, train with normalize=True"
            )
    sizes = ", ".join(f"{env.observation_space.shape} ({name})" for name, env in envs.items())
    raise BenchmarkError(f"{path} expects observations {space}, the task has {sizes}")
