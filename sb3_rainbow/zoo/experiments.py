"""The zoo's experiments with what Rainbow adds: masks in evaluation, and runs that go on."""

import argparse
import pathlib
from typing import Any

import optuna
from rl_zoo3.callbacks import TrialEvalCallback
from rl_zoo3.exp_manager import ExperimentManager
from sb3_contrib.common.maskable.callbacks import MaskableEvalCallback
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecEnv

from sb3_rainbow.masking.conventions import ActionMaskError
from sb3_rainbow.masking.masked_off_policy import masks_apply
from sb3_rainbow.rainbow import Rainbow
from sb3_rainbow.resume.checkpoint import is_checkpoint
from sb3_rainbow.zoo.files import ALGO, VEC_NORMALIZE, ZooError, is_model_file, loading
from sb3_rainbow.zoo.model_file import read_model, take_statistics

CHECKPOINT = "checkpoint.zip"
# A trial's attribute: the settings that the entry which it varies has
ENTRY = "entry"
HYPERPARAMS = pathlib.Path(__file__).parent / "hyperparams.yml"


class MaskedEvalCallback(MaskableEvalCallback):
    """``EvalCallback``, under the masks of the evaluation's env where the model takes them."""

    def _init_callback(self) -> None:
        self.use_masking = masks_apply(self.model, self.eval_env)
        super()._init_callback()


class MaskedTrialEvalCallback(TrialEvalCallback, MaskedEvalCallback):
    """The zoo's evaluation of a trial, under masks."""


class SaveCheckpoint(BaseCallback):
    """Write a checkpoint every ``save_freq`` calls of ``env.step()``, over the previous one."""

    model: Rainbow

    def __init__(self, save_freq: int, path: str | pathlib.Path) -> None:
        super().__init__()
        self.save_freq = save_freq
        self.path = path
        self._saved_at = 0

    def _on_rollout_start(self) -> None:
        # Not in _on_step: there the replay buffer lacks the transition that is counted already.
        if self.n_calls - self._saved_at >= self.save_freq:
            self._saved_at = self.n_calls
            self.model.save_checkpoint(self.path)

    def _on_step(self) -> bool:
        return True


class ResumedRainbow(Rainbow):
    """A run that goes on: ``learn``, which the zoo calls as for a new one, keeps the counters."""

    def learn(self, *args: Any, **kwargs: Any) -> "ResumedRainbow":
        """As ``Rainbow.learn``, with ``reset_num_timesteps=False``."""
        return super().learn(*args, **{**kwargs, "reset_num_timesteps": False})


class RainbowExperimentManager(ExperimentManager):
    """The zoo's, for Rainbow with its hyperparameters and with runs that go on where they stopped.

    With ``--save-replay-buffer`` a run writes its replay buffer at the end, or when it is
    interrupted, as ever; with ``--save-freq`` too it keeps ``checkpoint.zip`` on the way. Started
    with ``-i`` on such a checkpoint, or on a model beside its replay buffer, a run goes on with the
    settings in the file (but for ``--hyperparams``) and with its counters, schedules and random
    generators, up to ``n_timesteps`` in all; a run that has them behind it takes as many again.

    Without a ``config``, Rainbow's hyperparameters are the package's.
    """

    def __init__(self, args: argparse.Namespace, algo: str, *rest: Any, **kwargs: Any) -> None:
        if algo == ALGO and kwargs.get("config") is None:
            kwargs["config"] = str(HYPERPARAMS)
        super().__init__(args, algo, *rest, **kwargs)

    def create_callbacks(self) -> None:
        """The zoo's, and :class:`SaveCheckpoint`."""
        if self.algo == ALGO and self._eval_env_kwargs_args is None:
            # The zoo gives those of the hyperparameters to the training's env alone.
            self.eval_env_kwargs = self.env_kwargs
        super().create_callbacks()
        if self.algo == ALGO and self.save_replay_buffer and self.save_freq > 0:
            path = pathlib.Path(self.save_path) / CHECKPOINT
            self.callbacks.append(SaveCheckpoint(self.save_freq, path))

    def learn(self, model: BaseAlgorithm) -> None:
        """Train a new model, or one that goes on, to the end of the whole run."""
        if isinstance(model, ResumedRainbow) and model.num_timesteps < self.n_timesteps:
            self.n_timesteps -= model.num_timesteps
        super().learn(model)

    def objective(self, trial: optuna.Trial) -> float:
        """The score of a trial.

        Raises:
            ActionMaskError: for masks that no trial could learn under; the zoo would prune each.
        """
        trial.set_user_attr(ENTRY, sorted(self._hyperparams))
        try:
            return super().objective(trial)
        except optuna.exceptions.TrialPruned as pruned:
            if isinstance(pruned.__cause__, ActionMaskError):
                raise pruned.__cause__ from None
            raise

    def _load_pretrained_agent(self, hyperparams: dict[str, Any], env: VecEnv) -> BaseAlgorithm:
        if self.algo != ALGO:
            return super()._load_pretrained_agent(hyperparams, env)
        path = pathlib.Path(self.trained_agent)
        replay = path.with_name("replay_buffer.pkl")
        own = {name: getattr(self, name) for name in ("tensorboard_log", "verbose", "device")}
        try:
            if is_model_file(path):
                given = {k: v for k, v in hyperparams.items() if not k.startswith("policy")}
                take_statistics(path.with_name(VEC_NORMALIZE), env)
                return read_model(path, env=env, **{**given, "seed": self.seed, **own})
            with loading(path):
                if not is_checkpoint(path) and not replay.exists():
                    # Networks to begin with, and nothing to go on from
                    return super()._load_pretrained_agent(hyperparams, env)
                # All else is the run's, whatever the hyperparameters' file says by now.
                asked = hyperparams.keys() & set(self.custom_hyperparams or ()) - {"policy"}
                given = {name: hyperparams[name] for name in asked}
                return self._resume(path, replay, env, {**given, **own})
        except ZooError:
            env.close()  # and with it the file of its monitor
            raise

    def _resume(
        self, path: pathlib.Path, replay: pathlib.Path, env: VecEnv, given: dict[str, Any]
    ) -> Rainbow:
        if is_checkpoint(path):
            print("Going on from a checkpoint, with its replay buffer")
            model = ResumedRainbow.load_checkpoint(path, env, **given)
        else:
            print("Going on with the replay buffer beside the model")
            model = ResumedRainbow.load(path, env, **given)
            model.load_replay_buffer(replay, self.truncate_last_trajectory)
        # The run's own seed would play the episodes of its beginning once more.
        env.seed(self.seed + model.num_timesteps)
        return model
