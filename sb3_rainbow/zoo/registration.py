"""Rainbow in the tables of rl-baselines3-zoo, as its manual shows it for SBX."""

import functools
import pathlib
from types import ModuleType
from typing import Any, ClassVar, Self

import optuna
import rl_zoo3.enjoy
import rl_zoo3.exp_manager
import rl_zoo3.hyperparams_opt
import rl_zoo3.train
import rl_zoo3.utils
from numpy.typing import NDArray
from rl_zoo3.hyperparams_opt import convert_offpolicy_params
from sb3_contrib.common.maskable.utils import get_action_masks
from stable_baselines3.common.vec_env import VecEnv

from sb3_rainbow.masking.masked_off_policy import masks_apply
from sb3_rainbow.rainbow import Rainbow
from sb3_rainbow.type_aliases import ObsArray, SaveFile
from sb3_rainbow.zoo.experiments import (
    ENTRY,
    MaskedEvalCallback,
    MaskedTrialEvalCallback,
    RainbowExperimentManager,
)
from sb3_rainbow.zoo.files import ALGO, is_model_file, loading
from sb3_rainbow.zoo.model_file import read_model


class PlayedRainbow(Rainbow):
    """A trained model under the masks of the environment that ``create_test_env`` made last.

    The zoo's ``enjoy`` loads a model without its environment and asks it for actions by the
    observations alone: masks have no other way to it.
    """

    played: ClassVar[VecEnv | None] = None

    @classmethod
    def load(cls, path: SaveFile, *args: Any, **kwargs: Any) -> Self:
        """As ``Rainbow.load``, with the smallest replay buffer unless one is asked for.

        A packaged file is read without running anything of it.

        Raises:
            ZooError: if it cannot be loaded.
        """
        if isinstance(path, str | pathlib.Path) and is_model_file(path):
            kwargs.pop("custom_objects", None)  # for what a pickle names
            return read_model(path, cls, *args, **kwargs)
        with loading(str(path)):
            return super().load(path, *args, **{"buffer_size": 1, **kwargs})

    def predict(
        self, observation: ObsArray, *args: Any, **kwargs: Any
    ) -> tuple[NDArray, tuple[NDArray, ...] | None]:
        """As ``Rainbow.predict``; without masks, under those of the environment that is played."""
        env = self.played
        if env is not None and masks_apply(self, env):
            kwargs.setdefault("action_masks", get_action_masks(env))
        return super().predict(observation, *args, **kwargs)


_create_test_env = rl_zoo3.utils.create_test_env


@functools.wraps(_create_test_env)
def create_test_env(*args: Any, **kwargs: Any) -> VecEnv:
    """The zoo's, remembered for :class:`PlayedRainbow`."""
    PlayedRainbow.played = _create_test_env(*args, **kwargs)
    return PlayedRainbow.played


def register_for_training() -> None:
    """Make ``rainbow`` an algorithm of the zoo's ``train``: new runs, resumed ones, searches."""
    rl_zoo3.ALGOS[ALGO] = Rainbow
    rl_zoo3.hyperparams_opt.HYPERPARAMS_SAMPLER[ALGO] = sample_rainbow_params
    rl_zoo3.hyperparams_opt.HYPERPARAMS_CONVERTER[ALGO] = convert_rainbow_params
    _replace("EvalCallback", MaskedEvalCallback, rl_zoo3.exp_manager)
    _replace("TrialEvalCallback", MaskedTrialEvalCallback, rl_zoo3.exp_manager)
    _replace("ExperimentManager", RainbowExperimentManager, rl_zoo3.train)


def register_for_playing() -> None:
    """Make ``rainbow`` an algorithm of the zoo's ``enjoy``."""
    rl_zoo3.ALGOS[ALGO] = PlayedRainbow
    _replace("create_test_env", create_test_env, rl_zoo3, rl_zoo3.utils, rl_zoo3.enjoy)


def _replace(name: str, value: Any, *modules: ModuleType) -> None:
    """Put ours, which does the zoo's part too, where its modules look for theirs."""
    for module in modules:
        setattr(module, name, value)


def convert_rainbow_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """Arguments of Rainbow from what a trial drew, also of one that the zoo has stored."""
    neutral = {"one_minus_gamma": 0.0, "net_arch": "small"}  # which the zoo's own always draw
    result = convert_offpolicy_params({**neutral, **sampled_params})
    for drawn, name in (("one_minus_gamma", "gamma"), ("net_arch", "policy_kwargs")):
        if drawn not in sampled_params:
            del result[name]
    if not result["noisy"]:  # whatever the entry has beside its noise
        result["exploration_initial_eps"] = 1.0
    if "alpha" in result:
        result["prioritized"] = True  # an alpha of 0 is not
    return {**result, "target_update_interval": None}  # tau is for after each update


def sample_rainbow_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """Draw hyperparameters for a trial of the zoo's search.

    What is not drawn stays as in the environment's entry of the file: above all the head and its
    support, which no search should choose by the return alone. Nor is drawn the discount, where
    the entry has a support for it, the network where it has ``policy_kwargs``, or what a buffer
    stores where it has a class of buffers. ``n_actions``, ``n_envs`` and ``additional_args`` are
    for the zoo's other samplers.
    """
    entry = trial.user_attrs.get(ENTRY, ())
    if "v_max" not in entry:
        trial.suggest_float("one_minus_gamma", 1e-4, 0.03, log=True)
    train_freq = trial.suggest_int("train_freq", 1, 10)
    if trial.suggest_categorical("noisy", [True, False]):
        trial.suggest_float("sigma0", 0.02, 1.0, log=True)
    else:
        trial.suggest_float("exploration_fraction", 0.02, 0.5)
        trial.suggest_float("exploration_final_eps", 0.01, 0.2)
    trial.suggest_int("batch_size_pow", 4, 9)
    trial.suggest_float("learning_rate", 1e-5, 2e-3, log=True)
    trial.suggest_int("subsample_steps", 1, min(train_freq, 8))
    trial.suggest_float("tau", 5e-4, 0.05, log=True)
    if "replay_buffer_class" not in entry:
        trial.suggest_int("n_steps", 1, 10)
        trial.suggest_float("alpha", 0.0, 0.8)
    if "policy_kwargs" not in entry:
        trial.suggest_categorical("net_arch", ["small", "medium", "big"])
    return convert_rainbow_params(trial.params)
