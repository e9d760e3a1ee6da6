"""Learners and their environments, built as presets set them."""

import copy
import inspect
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from typing import Any, Final

import numpy as np
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from benchmarks.errors import BenchmarkError, known, resolve
from benchmarks.methods.episodes import env_arguments
from benchmarks.methods.guided import Guided, guided
from benchmarks.methods.team.networks import DecentralizedVecEnv, IndependentPolicy, SumPolicy
from benchmarks.protocol.learners import LEARNERS, algorithm_of
from benchmarks.protocol.plan import ABLATIONS, Cell
from benchmarks.protocol.presets import Guide, Preset, Task, Track
from benchmarks.protocol.seeding import derive
from benchmarks.protocol.strict import build
from coop_env.shield import ShieldedInsertionVecEnv
from coop_env.team.vec_env import CoopInsertionJointVecEnv, CoopInsertionTeamVecEnv
from coop_env.vector.vec_env import CoopInsertionVecEnv
from sb3_rainbow import Rainbow
from sb3_rainbow.policies import RainbowPolicy

CHECKED_BUFFER = 10_000
# constructor arguments that no preset sets
OURS: Final = ("policy", "env", "seed", "device", "_init_setup_model")
LINEAR: Final = "lin_"  # rl-baselines3-zoo's word for a rate that falls to 0
#: Rainbow's defaults when the suites' settings were chosen, which leave some of them unsaid
FORMER_DEFAULTS: Final = {
    "learning_rate": 1e-4,
    "batch_size": 32,
    "gradient_steps": 1,
    "sigma0": 0.5,
    "exploration_initial_eps": 0.0,
    "exploration_final_eps": 0.0,
}

# by a track's team, or for its shield
VEC_ENVS: Final[dict[str | None, Callable[..., VecEnv]]] = {
    None: CoopInsertionVecEnv,
    "shield": ShieldedInsertionVecEnv,
    "central": CoopInsertionJointVecEnv,
    "vdn": DecentralizedVecEnv,
    **dict.fromkeys(("shared", "independent"), CoopInsertionTeamVecEnv),
}
POLICIES: Final[dict[str | None, type[RainbowPolicy]]] = {
    "vdn": SumPolicy, "independent": IndependentPolicy
}  # fmt: skip


def make_training_env(preset: Preset, cell: Cell) -> VecMonitor:
    """The batched training environment, at the curriculum's first stage."""
    track = preset.tracks[cell.track]
    if track.train_nominal:
        track = replace(track, sim_to_real=None)
    arguments = env_arguments(preset, cell, track)
    kind = "shield" if track.shield is not None else arguments.pop("team", None)
    env = VEC_ENVS[kind](
        track.hyperparameters.n_envs // track.rows,
        seed=derive("train", cell.seed),
        stage=0 if track.curriculum.enabled else 1,
        **arguments,
    )
    return VecMonitor(env)


def class_of(method: str) -> type[BaseAlgorithm]:
    """The algorithm of a method."""
    name = algorithm_of(method)
    result: type[BaseAlgorithm] = resolve(LEARNERS[name].where, f"learner '{name}':")
    return result


def class_on(task: Task, method: str) -> type[BaseAlgorithm]:
    """The algorithm of a method on a public task; a guide of the task guides off-policy ones."""
    algorithm = class_of(method)
    if task.guide is None and issubclass(algorithm, Guided):
        raise BenchmarkError(f"{task.title}: {method} learns from a script: give the task a guide")
    # others have no memory to fill
    fills = task.guide is not None and issubclass(algorithm, OffPolicyAlgorithm)
    return guided(algorithm) if fills else algorithm


def build_model(preset: Preset, cell: Cell, env: VecMonitor, device: str = "cpu") -> BaseAlgorithm:
    """The learner of a cell, untrained."""
    track, algorithm = preset.tracks[cell.track], class_of(cell.method)
    own = copy.deepcopy(track.methods.get(cell.method, {}))  # SB3 writes into policy_kwargs
    arguments = _of_track(track, algorithm) | _checked(algorithm, own, env, cell.method)
    policy: str | type[RainbowPolicy] = "MlpPolicy"
    if issubclass(algorithm, Rainbow):
        arguments |= ABLATIONS[cell.ablation]
        if arguments.get("noisy", True):  # the paper's explores by its noise alone
            names = {"exploration_initial_eps", "exploration_final_eps"} - own.keys()
            arguments |= dict.fromkeys(names, 0.0)
        policy = POLICIES.get(track.team, policy)
        if track.team == "vdn":
            arguments["policy_kwargs"]["columns"] = env.get_attr("columns")[0].tolist()
    return algorithm(policy, env, seed=derive("learner", cell.seed), device=device, **arguments)


def _of_track(track: Track, algorithm: type[BaseAlgorithm]) -> dict[str, Any]:
    """The constructor arguments of an algorithm that a track's hyperparameters give."""
    h, accepted = track.hyperparameters, _accepted(algorithm)
    rates = (h.learning_rate, h.learning_rate_end)
    network: dict[str, Any] = {"net_arch": list(h.net_arch)}
    if issubclass(algorithm, OffPolicyAlgorithm):
        network["optimizer_kwargs"] = {"weight_decay": h.weight_decay}
        given = {name: getattr(h, name) for name in accepted if hasattr(h, name)} | {
            "train_freq": 1,
            "exploration_initial_eps": h.epsilon_start,
            "exploration_final_eps": h.epsilon_end,
            "exploration_fraction": min(1.0, h.epsilon_steps / track.timesteps),
        }
        if not issubclass(algorithm, Rainbow):
            given.pop("n_steps", None)  # the returns of the others are of one step
            # SB3 moves the target once per round of collection, not once per update
            given["tau"] = 1.0 - (1.0 - h.tau) ** h.gradient_steps
            given["target_update_interval"] = h.n_envs
    else:
        given = {"gamma": h.gamma, **asdict(track.ppo)}
        rates = (given["learning_rate"], given["learning_rate_end"])
    given |= {"learning_rate": LinearSchedule(*rates, 1.0), "policy_kwargs": network}
    return {name: value for name, value in given.items() if name in accepted}


def _accepted(algorithm: type[BaseAlgorithm]) -> list[str]:
    """The constructor's arguments, with those that ``**kwargs`` hands on to the class above."""
    names: list[str] = []
    for each in algorithm.__mro__:
        if "__init__" in vars(each):
            parameters = inspect.signature(each).parameters.values()
            names += [p.name for p in parameters if p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)]
            if not any(p.kind == p.VAR_KEYWORD for p in parameters):
                break
    return names


def build_on(
    task: Task, method: str, seed: int, env: VecEnv, network: Mapping[str, Any]
) -> BaseAlgorithm:
    """The learner of a public task, untrained, in its environments.

    ``network`` holds the ``policy_kwargs`` where the task's settings have none.

    Raises:
        BenchmarkError: a setting is unknown to the method's constructor.
    """
    given = copy.deepcopy(task.arguments_of(method))  # SB3 writes into policy_kwargs
    where, guide = f"{task.title}: {method}", task.guide
    if guide is not None and (own := given.pop("guide", {})):
        guide = build(Guide, {**asdict(guide), **own}, f"{where}: guide")
    algorithm = class_on(task, method)
    if issubclass(algorithm, Rainbow) and not task.bare:
        given = _spelled_out(given)
    arguments = _checked(algorithm, given, env, where)
    if network:
        arguments["policy_kwargs"] = {**network, **given.get("policy_kwargs", {})}
    model = algorithm(task.policy, env, seed=derive("learner", seed), device="cpu", **arguments)
    if guide is not None and hasattr(model, "follow"):
        model.follow(guide)
    return model


def _checked(
    algorithm: type[BaseAlgorithm], given: Mapping[str, Any], env: VecEnv, where: str
) -> dict[str, Any]:
    """Constructor arguments of a preset as the algorithm takes them."""
    accepted, arguments = [n for n in _accepted(algorithm) if n not in OURS], dict(given)
    for name in arguments:
        if name not in accepted:
            raise BenchmarkError(f"{where} has no argument '{name}'; known: {known(accepted)}")
    rate = arguments.get("learning_rate")
    if isinstance(rate, str):
        if not rate.startswith(LINEAR):
            raise BenchmarkError(
                f"{where}: learning_rate: expected a number or {LINEAR}<number>, "
                f"found '{rate}' (YAML wants a point in it: 1.0e-3)"
            )
        arguments["learning_rate"] = LinearSchedule(float(rate.removeprefix(LINEAR)), 0.0, 1.0)
    if arguments.get("replay_buffer_class") == "HerReplayBuffer":
        arguments["replay_buffer_class"] = HerReplayBuffer
    if (noise := arguments.get("action_noise")) is not None:
        mean = np.zeros(env.action_space.shape or ())
        arguments["action_noise"] = NormalActionNoise(mean, np.full_like(mean, noise))
    return arguments


def _spelled_out(arguments: dict[str, Any]) -> dict[str, Any]:
    """Rainbow's arguments, completed by its :data:`FORMER_DEFAULTS`."""
    former = dict(FORMER_DEFAULTS)
    # then there was no epsilon beside the noise unless one of its three arguments was given
    if not arguments.get("noisy", True) or any("exploration" in name for name in arguments):
        del former["exploration_initial_eps"], former["exploration_final_eps"]
    if not {"tau", "target_update_interval"} & arguments.keys():
        former["tau"] = 1e-3
    return {**former, **arguments}


def build_small(preset: Preset, cell: Cell) -> BaseAlgorithm:
    """The learner of a cell, untrained and without room for its whole replay buffer."""
    track = preset.tracks[cell.track]
    small = min(track.hyperparameters.buffer_size, CHECKED_BUFFER)
    h = replace(track.hyperparameters, buffer_size=small)
    mine = replace(preset, tracks={cell.track: replace(track, hyperparameters=h)})
    return build_model(mine, cell, make_training_env(mine, cell))
