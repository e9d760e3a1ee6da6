"""Episodes of the contact task under given errors and friction, for scripts and learners alike."""

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import numpy as np
from stable_baselines3 import SAC

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation.model_files import set_weights
from benchmarks.methods.contact_scripts import SCRIPTS, Gains
from benchmarks.protocol.presets import read_yaml
from benchmarks.protocol.seeding import derive
from benchmarks.studies.base import episode, read_stored
from benchmarks.studies.classic.envs import make

ERRORS: Final = (0.0, 1.0, 2.0, 3.0, 4.0, 5.0)  # mm
DRAWN: Final = None  # an error as the task draws it
CONDITIONS: Final = (*ERRORS, DRAWN)
EPISODES: Final = 50  # of each cell
TRAINED: Final = 3.0  # mm: the largest error that the task draws
LEVEL: Final = "standard"  # at which other studies insert
LEARNED: Final = {"SAC": "contact", "SAC, trained on machines that err": "contact_errors"}
"""The policies that insert, and their presets."""
#: what a cell of the tables shows
WHAT: Final = "success (%) / median time of successes (s) / median peak force (N)"
Row = dict[str, Any]


def options(stream: str, number: int, error: float | None, friction: float | None = None) -> Row:
    """Reset options of an episode; an ``error`` of ``DRAWN``, not mm, is uniform over the disc."""
    rng = np.random.default_rng(derive(stream, 13, number))
    share, bearing, lean, side = rng.random(4)
    size = 1e-3 * (TRAINED * math.sqrt(share) if error is None else error)
    tilt = math.radians(lean)
    offsets = [
        length * turn(2.0 * math.pi * angle)
        for length, angle in ((size, bearing), (tilt, side))
        for turn in (math.cos, math.sin)
    ]
    return {"error": offsets} if friction is None else {"error": offsets, "friction": friction}


def play(
    env: Any, script: Any, stream: str, episodes: int, error: float | None = None
) -> dict[str, list[Any]]:
    """A script's episodes: success, time, s, peak force, N, and cause of failure, by name."""
    rows = []
    for number in range(episodes):
        given = options(stream, number, error)
        steps = episode(env, begun(script), seed=derive(stream, 13, number, 1), options=given)
        (info,) = deque(steps, maxlen=1)
        rows.append({
            "success": bool(info["success"]),
            "time": round(float(info["time"]), 3),
            "force": round(float(info["peak_force"]), 3),
            "failure": info["failure"] or ("" if info["success"] else "time"),
        })  # fmt: skip
    return {name: [row[name] for row in rows] for name in rows[0]}


def begun(script: Any) -> Any:
    """The script or policy, reset for an episode."""
    getattr(script, "reset", lambda: None)()
    return script


def policy_of(model: Any) -> Callable[[Any], Any]:
    """A trained model's greedy action after an observation (29,)."""
    return lambda observation: model.predict(observation, deterministic=True)[0]


def script_of(name: str, env: Any, gains: Mapping[str, float]) -> Any:
    """A script by its name in an environment, with these gains in place of the defaults."""
    return SCRIPTS[name](env, Gains(**gains))


def policy_of_run(results: Path, name: str, seed: int) -> Path:
    """The file of a policy of :data:`LEARNED`."""
    return results / f"classic/{LEARNED[name]}/runs/{LEVEL}-sac-s{seed}/policy.zip"


def inserter(results: Path, name: str, seed: int) -> Any:
    """A script with the gains chosen for it, or a policy of :data:`LEARNED`, from the results."""
    preset = LEARNED.get(name)
    path = policy_of_run(results, name, seed) if preset else results / "contact/scripts.json"
    if not path.is_file():
        # a complete run is not run again, and not every policy is in git
        command = f"run --preset {preset}" if preset else "study contact"
        fix = f"delete {path.parent} and " * path.with_name("meta.json").is_file()
        raise BenchmarkError(f"{path} is missing: {fix}run python -m benchmarks {command} first")
    if not preset:
        from coop_env.physics.task import resolve_task

        gains = read_stored(path)["parts"][LEVEL][name]["gains"]
        return script_of(name, SimpleNamespace(task=resolve_task(LEVEL)), gains)
    config = read_yaml(path.with_name("config.yaml"))  # of the policy's file, arrays alone are read
    env, net = config["task"], config["arguments"]["policy_kwargs"]
    made = make(env["env"], **env["env_kwargs"])
    model = SAC("MlpPolicy", made, buffer_size=1, policy_kwargs=net, device="cpu")
    set_weights(model, path)
    return policy_of(model)


def on_tests(model: Any, env: Any) -> list[Row]:
    """A model's episodes on the scripts' tests, a row each; errors in mm."""
    rows = []
    for error in CONDITIONS:
        result = play(env, policy_of(model), "test", EPISODES, error)
        for number, values in enumerate(zip(*result.values(), strict=True)):
            row = {"error": error, "episode": number}
            rows.append(row | dict(zip(result, values, strict=True)))
    return rows


def medians(result: Mapping[str, Sequence[Any]]) -> tuple[float, float, float]:
    """Success, %, median time of the successes, s, or NaN, and median peak force, N."""
    won = np.array(result["success"], bool)
    time = float(np.median(np.array(result["time"])[won])) if won.any() else math.nan
    return 100.0 * float(won.mean()), time, float(np.median(result["force"]))


def in_cell(result: Mapping[str, Sequence[Any]]) -> str:
    """The medians as a table shows them."""
    success, time, force = medians(result)
    return f"{success:.0f} / {'-' if math.isnan(time) else f'{time:.2f}'} / {force:.1f}"


def shown(error: float | None) -> str:
    """A condition's column heading."""
    return f"{error:g} mm" if error is not DRAWN else f"to {TRAINED:g} mm"
