"""Rainbow in the tables of rl-baselines3-zoo, as its manual shows it for SBX."""

from types import ModuleType
from typing import Any

import rl_zoo3.enjoy
import rl_zoo3.exp_manager
import rl_zoo3.hyperparams_opt
import rl_zoo3.train
import rl_zoo3.utils

from sb3_rainbow.rainbow import Rainbow
from sb3_rainbow.zoo.experiments import (
    MaskedEvalCallback,
    MaskedTrialEvalCallback,
    RainbowExperimentManager,
)
from sb3_rainbow.zoo.files import ALGO
from sb3_rainbow.zoo.playing import PlayedRainbow, create_test_env
from sb3_rainbow.zoo.search import convert_rainbow_params, sample_rainbow_params


def register_for_training() -> None:
    """Make ``rainbow`` an algorithm of the zoo's ``train``: new runs, resumed ones, searches."""
    rl_zoo3.ALGOS[ALGO] = Rainbow
    rl_zoo3.hyperparams_opt.HYPERPARAMS_SAMPLER[ALGO] = sample_rainbow_params
    rl_zoo3.hyperparams_opt.HYPERPARAMS_CONVERTER[ALGO] = convert_rainbow_params
    _replace("EvalCallback", MaskedEvalCallback, rl_zoo3.exp_manager)
    _replace("TrialEvalCallback", MaskedTrialEvalCallback, rl_zoo3.exp_manager)
    _replace("ExperimentManager", RainbowExperimentManager, rl_zoo3.train)


def register_for_playing() -> None:
    """Make ``rainbow`` an algorithm of the zoo's ``enjoy`` and ``record_video``."""
    rl_zoo3.ALGOS[ALGO] = PlayedRainbow
    _replace("create_test_env", create_test_env, rl_zoo3, rl_zoo3.utils, rl_zoo3.enjoy)


def _replace(name: str, value: Any, *modules: ModuleType) -> None:
    """Put ours, which does the zoo's part too, where its modules look for theirs."""
    for module in modules:
        setattr(module, name, value)
