"""Models from files: which algorithm wrote one, whether it fits the task, and what loading runs.

A run's policy is built anew from the settings beside it, a packaged model is numbers and words:
loading these runs nothing. Any other file of SB3's holds pickles, and is loaded only where its
author is trusted.
"""

import json
import pickle
import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file

from benchmarks.errors import BenchmarkError, known, resolve
from benchmarks.methods.learners import build_small
from benchmarks.protocol.learners import LEARNERS, algorithm_of
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset, read_yaml
from benchmarks.protocol.strict import build
from coop_env.env import CoopInsertionEnv
from sb3_rainbow.zoo.files import is_model_file

# the module of a saved policy class, from its start -> the algorithm that saves it
_POLICIES: Final = {
    "sb3_rainbow.": "rainbow",
    "sb3_contrib.common.maskable.": "maskable_ppo",
    "sb3_contrib.qrdqn.": "qrdqn",
    "sb3_contrib.ars.": "ars",
    "stable_baselines3.dqn.": "dqn",
}


def algorithms() -> dict[str, str]:
    """``module:Class`` by name, for each algorithm whose models can be scored."""
    return {
        **{name: learner.where for name, learner in LEARNERS.items() if learner.discrete},
        "a2c": "stable_baselines3:A2C",
        "ars": "sb3_contrib:ARS",
        "ppo": "stable_baselines3:PPO",
        "trpo": "sb3_contrib:TRPO",
    }


def detect_algorithm(path: Path) -> str:
    """The algorithm whose ``save`` wrote the file; BenchmarkError if that cannot be found out."""
    if is_model_file(path):
        return "rainbow"
    if _is_of_run(path):
        return algorithm_of(str(read_yaml(path.with_name("config.yaml"))["cell"]["method"]))
    try:
        data = _plain_settings(path)
        module = str(data["policy_class"]["__module__"])
    except (zipfile.BadZipFile, KeyError, TypeError, ValueError) as error:
        raise BenchmarkError(
            f"{path} is no model of Stable-Baselines3 ({type(error).__name__}: {error}); give a "
            ".zip that model.save() wrote"
        ) from error
    if module.startswith("sb3_contrib.common.recurrent."):
        raise BenchmarkError(
            f"{path} holds a recurrent policy, which the test protocol cannot run; known: "
            f"{known(algorithms())}"
        )
    if module.startswith("stable_baselines3.common.policies"):
        # three algorithms share the policy; their settings tell them apart
        return "trpo" if "cg_max_steps" in data else "ppo" if "clip_range" in data else "a2c"
    policies = [name for prefix, name in _POLICIES.items() if module.startswith(prefix)]
    if not policies:
        raise BenchmarkError(
            f"{path}: its policy is of {module}, from which the algorithm cannot be told; say it "
            f"with --algorithm: {known(algorithms())}"
        )
    return policies[0]


def _is_of_run(path: Path) -> bool:
    """Whether a file is a run's policy, described by the config.yaml beside it."""
    return path.name == "policy.zip" and path.with_name("config.yaml").is_file()


def _plain_settings(path: Path) -> dict[str, Any]:
    """Settings of a model that SB3 saved; what is not JSON is left as the text of its pickle."""
    with zipfile.ZipFile(path) as archive:
        return dict(json.loads(archive.read("data")))


def load_stored(path: Path) -> Any:
    """The policy of a run's policy.zip, on the CPU, built anew from the config.yaml beside it.

    Only the policy's arrays are read, by torch's ``weights_only=True``, and how much it explores.

    Raises:
        BenchmarkError: the settings are not a learner's, or the policy does not fit them.
    """
    config = read_yaml(path.with_name("config.yaml"))
    try:
        if "task" in config["cell"]:  # a run of the public suites, or of one contact
            raise BenchmarkError(f"{path} was not trained on the insertion of the two robots")
        cell = Cell(**config["cell"])
        data = {
            **{"name": "stored", "description": "", "seeds": [cell.seed], "runs": []},
            "evaluation": config["evaluation"],
            "tracks": {cell.track: config["track"]},
            "geometries": {cell.geometry: config["dimensions"]} if "dimensions" in config else {},
        }
        model = build_small(build(Preset, data, f"{path.parent}: config.yaml"), cell)
        set_weights(model, path)
        exploring = float(_plain_settings(path).get("exploration_rate", 0.0))
    except BenchmarkError:
        raise
    except (
        *(AttributeError, KeyError, TypeError, ValueError),
        *(RuntimeError, EOFError, zipfile.BadZipFile),
    ) as error:
        raise BenchmarkError(
            f"{path} is not what the config.yaml beside it says: {error}"
        ) from error
    model.exploration_rate = exploring  # type: ignore[attr-defined]
    return model


def set_weights(model: BaseAlgorithm, path: Path) -> None:
    """Load a policy's arrays from a file that SB3 saved into a model; no pickle is opened.

    SB3 below 2.8, which setup.cfg excludes, would open them.
    """
    try:
        _, parameters, _ = load_from_zip_file(path, load_data=False, device="cpu")
    except pickle.UnpicklingError as error:  # torch's own message says how to run it
        raise BenchmarkError(
            f"{path} holds something else than arrays, or is damaged: nothing of it was run"
        ) from error
    arrays: Any = parameters["policy"]
    if odd := arrays.keys() ^ model.policy.state_dict().keys():
        raise BenchmarkError(f"{path} is of another network: they differ in {min(odd)}")
    model.set_parameters({"policy": arrays}, exact_match=False)  # without an optimizer


def load_model(path: Path, algorithm: str | None = None, trust: bool = False) -> Any:
    """A model from a file, on the CPU: a run's policy, a packaged Rainbow, or what SB3 saved.

    Args:
        path: the file.
        algorithm: which class loads it; None finds out.
        trust: whether to load what SB3 saved, which **runs its author's code**.

    Raises:
        BenchmarkError: there is no such algorithm or file, it does not fit, or it needs trust.
    """
    choices = algorithms()
    if algorithm is not None and algorithm not in choices:
        raise BenchmarkError(f"unknown algorithm '{algorithm}'; known: {known(choices)}")
    if not path.is_file():
        raise BenchmarkError(f"{path} is missing; give a .zip that model.save() wrote")
    if _is_of_run(path):
        model = load_stored(path)
        if (own := detect_algorithm(path)) != (algorithm or own):
            raise BenchmarkError(f"{path} is of a run of '{own}', not '{algorithm}'")
        return model
    name = algorithm or detect_algorithm(path)
    if is_model_file(path):
        try:
            from sb3_rainbow.zoo.model_file import read_model

            return read_model(path, device="cpu")
        except ImportError as error:
            raise BenchmarkError(f"{path} needs pip install '.[zoo]': {error}") from error
        except ValueError as error:
            raise BenchmarkError(str(error)) from error
    if not trust:
        raise BenchmarkError(
            f"{path}: a model that SB3 saved runs its author's code when it is loaded; add --trust "
            "if you made it, or trust who did"
        )
    kind = resolve(choices[name], f"algorithm '{name}':")
    try:
        return kind.load(path, device="cpu")
    except Exception as error:  # anything may be raised by a class that reads another's file
        raise BenchmarkError(f"{path} is no model of '{name}': {error}") from error


def fitting_observation(model: Any, path: Path) -> str:
    """Which of the task's observations a model was trained on; BenchmarkError if none of them."""
    envs = {name: CoopInsertionEnv(observation=name) for name in ("paper", "markov")}
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
