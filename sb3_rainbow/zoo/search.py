"""What the zoo's hyperparameter search draws for Rainbow."""

from typing import Any

import optuna
from rl_zoo3.hyperparams_opt import convert_offpolicy_params


def sample_rainbow_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """Draw hyperparameters; those not drawn stay as the environment's entry of the file has them,
    the head and its support among them, which no search should choose by the return alone.

    Args:
        trial: Optuna's.
        n_actions: of the zoo's samplers for continuous actions.
        n_envs: number of environments.
        additional_args: of the zoo's samplers for hindsight replay.

    Returns:
        arguments of Rainbow.
    """
    train_freq = trial.suggest_int("train_freq", 1, 10)
    noisy = trial.suggest_categorical("noisy", [True, False])
    return convert_rainbow_params(
        {
            "one_minus_gamma": trial.suggest_float("one_minus_gamma", 1e-4, 0.03, log=True),
            "batch_size_pow": trial.suggest_int("batch_size_pow", 4, 9),
            "learning_rate": trial.suggest_float("learning_rate", 1e-5, 2e-3, log=True),
            "train_freq": train_freq,
            "subsample_steps": trial.suggest_int("subsample_steps", 1, min(train_freq, 8)),
            "tau": trial.suggest_float("tau", 5e-4, 0.05, log=True),
            "n_steps": trial.suggest_int("n_steps", 1, 10),
            "noisy": noisy,
            **({"sigma0": trial.suggest_float("sigma0", 0.02, 1.0, log=True)} if noisy else {}),
            "prioritized": True,  # an alpha of 0 is not
            "alpha": trial.suggest_float("alpha", 0.0, 0.8),
            "net_arch": trial.suggest_categorical("net_arch", ["small", "medium", "big"]),
        }
    )


# The zoo's for off-policy algorithms turns what it knows into arguments, and leaves the others.
convert_rainbow_params = convert_offpolicy_params
