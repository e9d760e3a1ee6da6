"""Episodes of the contact task under given errors and friction, for scripts and learners alike."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import gymnasium
import numpy as np
from stable_baselines3 import SAC

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation.model_files import set_weights
from benchmarks.protocol.presets import read_yaml
from benchmarks.protocol.seeding import derive

ERRORS: Final = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)  # mm
DRAWN: Final = None  # an error as the task draws it
CONDITIONS: Final = (*ERRORS, DRAWN)
FRICTIONS: Final = (0.1, 0.2, 0.3, 0.4)
EPISODES: Final = 50  # of each cell
TRAINED: Final = 3.0  # mm: the largest error that the task draws
LEVEL: Final = "standard"  # of what other studies let insert
LEARNED: Final = {"SAC": "contact", "SAC, trained on machines that err": "contact_errors"}
"""Presets of the policies that insert."""
Row = dict[str, Any]


def options(stream: str, episode: int, error: float | None, friction: float | None) -> Row:
    """Reset options of an episode; an ``error`` of ``DRAWN``, not mm, is uniform over the disc."""
    rng = np.random.default_rng(derive(stream, 13, episode))
    share, bearing, lean, side = rng.random(4)
    size = 1e-3 * (TRAINED * math.sqrt(share) if error is None else error)
    tilt = math.radians(lean)
    bearing, side = 2.0 * math.pi * bearing, 2.0 * math.pi * side
    result: Row = {
        "error": [size * math.cos(bearing), size * math.sin(bearing),
                  tilt * math.cos(side), tilt * math.sin(side)]
    }  # fmt: skip
    return result if friction is None else {**result, "friction": friction}


def play(
    env: Any, script: Any, stream: str, episodes: int,
    error: float | None = None, friction: float | None = None, also: Sequence[str] = (),
) -> dict[str, list[Any]]:  # fmt: skip
    """A script's episodes: success, time, s, peak force, N, and cause of failure, by name.

    ``also`` are keys of the last ``info`` to keep.
    """
    result: dict[str, list[Any]] = {"success": [], "time": [], "force": [], "failure": []}
    result |= {key: [] for key in also}
    for episode in range(episodes):
        given = options(stream, episode, error, friction)
        seed = derive(stream, 13, episode, 1)
        observation, _ = env.reset(seed=seed, options=given)
        script.reset()
        over = False
        while not over:
            observation, _, terminated, truncated, info = env.step(script(observation))
            over = terminated or truncated
        result["success"].append(bool(info["success"]))
        result["time"].append(round(float(info["time"]), 3))
        result["force"].append(round(float(info["peak_force"]), 3))
        result["failure"].append(info["failure"] or ("" if info["success"] else "time"))
        for key in also:
            result[key].append(info[key])
    return result


class Policy:
    """A trained model as a script: its greedy action."""

    def __init__(self, model: Any) -> None:
        self.model = model

    def reset(self) -> None:
        """It keeps nothing from step to step."""

    def __call__(self, observation: Any) -> Any:
        """The action after an observation (29,)."""
        return self.model.predict(observation, deterministic=True)[0]


def inserter(results: Path, name: str, seed: int) -> Any:
    """A script with the gains that were chosen for it, or a policy of :data:`LEARNED`.

    Raises:
        BenchmarkError: the gains or the policy are not among the results.
    """
    from benchmarks.methods.contact_scripts import SCRIPTS, Gains
    from coop_env.physics.task import resolve_task

    preset = LEARNED.get(name)
    run = f"classic/{preset}/runs/{LEVEL}-sac-s{seed}/policy.zip"
    path = results / (run if preset else "contact/scripts.json")
    if not path.is_file():
        command = f"run --preset {preset}" if preset else "contact"
        raise BenchmarkError(f"{path} is missing: run python -m benchmarks {command} first")
    if preset:
        return Policy(_stored_sac(path))
    gains = json.loads(path.read_text(encoding="utf-8"))["parts"][LEVEL][name]["gains"]
    task: Any = SimpleNamespace(task=resolve_task(LEVEL))
    return SCRIPTS[name](task, replace(Gains(), **gains))


def _stored_sac(path: Path) -> SAC:
    """The policy of a run of preset contact, built from its settings; of its file, arrays alone."""
    config = read_yaml(path.with_name("config.yaml"))
    env, net = config["task"], config["arguments"]["policy_kwargs"]
    made = gymnasium.make(env["env"], **env["env_kwargs"])
    model = SAC("MlpPolicy", made, buffer_size=1, policy_kwargs=net, device="cpu")
    set_weights(model, path)
    return model


def on_tests(model: Any, env: Any) -> list[Row]:
    """A model's episodes on the scripts' tests, a row each; errors in mm."""
    rows = []
    conditions: list[tuple[float | None, float | None]] = [(error, None) for error in CONDITIONS]
    for error, friction in [*conditions, *((TRAINED, f) for f in FRICTIONS)]:
        result = play(env, Policy(model), "test", EPISODES, error, friction)
        for number, values in enumerate(zip(*result.values(), strict=True)):
            row = {"error": error, "friction": friction, "episode": number}
            rows.append({**row, **dict(zip(result, values, strict=True))})
    return rows


def in_cell(result: Mapping[str, Sequence[Any]]) -> str:
    """Success, %, median time of the successes, s, and median peak force, N."""
    won = np.array(result["success"])
    time = f"{np.median(np.array(result['time'])[won]):.2f}" if won.any() else "-"
    return f"{100.0 * won.mean():.0f} / {time} / {np.median(result['force']):.1f}"


def shown(error: float | None) -> str:
    """A condition's head in a table."""
    return f"{error:g} mm" if error is not DRAWN else f"to {TRAINED:g} mm"


def causes(rows: Sequence[Mapping[str, Sequence[Any]]]) -> str:
    """How often episodes failed by each cause."""
    all_of_them = [cause for row in rows for cause in row["failure"] if cause]
    counted = {cause: all_of_them.count(cause) for cause in sorted(set(all_of_them))}
    return ", ".join(f"{cause} {n}" for cause, n in counted.items()) or "-"
