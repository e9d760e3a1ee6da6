"""The learners and their environments, as a preset's track sets them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any, Final

from sb3_contrib import MaskablePPO
from stable_baselines3 import DQN
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

from benchmarks.errors import BenchmarkError
from benchmarks.methods.episodes import env_arguments
from benchmarks.methods.team.networks import DecentralizedVecEnv, IndependentPolicy, SumPolicy
from benchmarks.protocol.plan import ABLATIONS, Cell
from benchmarks.protocol.presets import Preset, Track
from benchmarks.protocol.seeding import derive
from coop_env.shield import ShieldedInsertionVecEnv
from coop_env.team.vec_env import CoopInsertionJointVecEnv, CoopInsertionTeamVecEnv
from coop_env.vector.vec_env import CoopInsertionVecEnv
from sb3_rainbow import Rainbow
from sb3_rainbow.policies import RainbowPolicy

CHECKED_BUFFER = 10_000
ALGORITHMS: dict[str, type[BaseAlgorithm]] = {
    "rainbow": Rainbow,
    "dqn": DQN,
    "maskable_ppo": MaskablePPO,
}
# hyperparameters that the algorithms know by the same names: SB3's DQN, and what Rainbow adds
DQN_NAMES: Final = (
    *("buffer_size", "learning_starts", "batch_size", "tau", "gamma"),
    *("gradient_steps", "max_grad_norm"),
)
RAINBOW_NAMES: Final = (
    *("n_steps", "n_atoms", "v_min", "v_max", "sigma0", "alpha", "beta_start", "beta_end"),
    "advantage_learning",
)

# by a track's team, or for its shield
VEC_ENVS: Final[dict[str | None, Callable[..., VecEnv]]] = {
    None: CoopInsertionVecEnv,
    "shield": ShieldedInsertionVecEnv,
    "central": CoopInsertionJointVecEnv,
    "vdn": DecentralizedVecEnv,
    "shared": CoopInsertionTeamVecEnv,
    "independent": CoopInsertionTeamVecEnv,
}
POLICIES: Final[dict[str | None, type[RainbowPolicy]]] = {
    "vdn": SumPolicy,
    "independent": IndependentPolicy,
}


def make_training_env(preset: Preset, cell: Cell) -> VecMonitor:
    """The batched training environment, at the curriculum's first stage.

    Its machines are drawn anew each episode within the track's ``sim_to_real``.
    """
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


def build_model(preset: Preset, cell: Cell, env: VecMonitor, device: str = "cpu") -> BaseAlgorithm:
    """The learner of a cell, untrained."""
    track = preset.tracks[cell.track]
    h = track.hyperparameters
    if cell.method == "maskable_ppo":
        return _build_ppo(track, cell, env, device)
    common: dict[str, Any] = {
        **{name: getattr(h, name) for name in DQN_NAMES},
        "learning_rate": LinearSchedule(h.learning_rate, h.learning_rate_end, 1.0),
        "train_freq": 1,
        "policy_kwargs": {
            "net_arch": list(h.net_arch),
            "optimizer_kwargs": {"weight_decay": h.weight_decay},
        },
        "seed": derive("learner", cell.seed),
        "device": device,
    }
    epsilon: dict[str, Any] = {
        "exploration_initial_eps": h.epsilon_start,
        "exploration_final_eps": h.epsilon_end,
        "exploration_fraction": min(1.0, h.epsilon_steps / track.timesteps),
    }
    if cell.method == "dqn":
        # SB3 moves the target once per round of collection, not once per update: tau is compounded
        common["tau"] = 1.0 - (1.0 - h.tau) ** h.gradient_steps
        return DQN("MlpPolicy", env, target_update_interval=h.n_envs, **common, **epsilon)
    rainbow = {name: getattr(h, name) for name in RAINBOW_NAMES} | ABLATIONS[cell.ablation]
    if rainbow.get("noisy", True):  # the paper's explores by its noise alone
        epsilon |= {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}
    rainbow |= epsilon
    if track.team == "vdn":
        common["policy_kwargs"]["columns"] = env.get_attr("columns")[0].tolist()
    return Rainbow(POLICIES.get(track.team, "MlpPolicy"), env, **common, **rainbow)


def _build_ppo(track: Track, cell: Cell, env: VecMonitor, device: str) -> BaseAlgorithm:
    given = asdict(track.ppo)
    start, end = given.pop("learning_rate"), given.pop("learning_rate_end")
    return MaskablePPO(
        "MlpPolicy",
        env,
        learning_rate=LinearSchedule(start, end, 1.0),
        gamma=track.hyperparameters.gamma,
        policy_kwargs={"net_arch": list(track.hyperparameters.net_arch)},
        seed=derive("learner", cell.seed),
        device=device,
        **given,
    )


def build_small(preset: Preset, cell: Cell) -> BaseAlgorithm:
    """The learner of a cell, untrained and without room for its whole replay buffer."""
    track = preset.tracks[cell.track]
    small = min(track.hyperparameters.buffer_size, CHECKED_BUFFER)
    h = replace(track.hyperparameters, buffer_size=small)
    tracks = {**preset.tracks, cell.track: replace(track, hyperparameters=h)}
    mine = replace(preset, tracks=tracks)
    return build_model(mine, cell, make_training_env(mine, cell))


def check_cells(preset: Preset, cells: Sequence[Cell]) -> None:
    """Build each kind of these learning cells once, so that what is impossible fails at once.

    Raises:
        BenchmarkError: an environment or an algorithm refuses its settings.
    """
    kinds = {(cell.method, cell.ablation, cell.geometry, cell.track): cell for cell in cells}
    for cell in kinds.values():
        try:
            build_small(preset, cell)
        except (ValueError, TypeError, AssertionError, ZeroDivisionError) as error:
            raise BenchmarkError(
                f"preset '{preset.name}': cell {cell.id} is impossible: {error}"
            ) from error
