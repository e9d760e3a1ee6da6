"""Callbacks of a training run: the curriculum and the recorder of the paper's curves."""

import math
from abc import abstractmethod
from collections import deque
from typing import Any, Final

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback

from benchmarks.protocol.presets import Curriculum, Track
from benchmarks.runs.checkpoint import Stateful

ROWS: Final = 400  # rows of curve.csv at most, so that it can be committed
REFERENCE_THRESHOLD: Final = 0.75  # the paper's "environment steps to 75 % success" ...
REFERENCE_WINDOW: Final = 20  # ... over 20 training episodes


def ended(step: dict[str, Any], rows: int) -> list[dict[str, Any]]:
    """Infos of the episodes that end in a step, one of each environment's ``rows``."""
    pairs = zip(step["dones"][::rows], step["infos"][::rows], strict=True)
    return [info for done, info in pairs if done]


class CurriculumCallback(BaseCallback):
    """Switches from four holes to six when the mean success of recent episodes is high enough.

    Each environment takes the new stage at its next reset. ``rows``: the batch's rows per
    environment, one or one for each agent.
    """

    def __init__(self, settings: Curriculum, rows: int = 1) -> None:
        super().__init__()
        self.settings, self.rows = settings, rows
        self.recent: deque[bool] = deque(maxlen=settings.window)
        self.stage = 0 if settings.enabled else 1
        self.switched_at: int | None = None

    def _on_step(self) -> bool:
        if self.stage == 1:
            return True
        for info in ended(self.locals, self.rows):
            self.recent.append(bool(info["success"]))
        full = len(self.recent) == self.settings.window
        if full and np.mean(self.recent) > self.settings.threshold:
            self.stage = 1
            self.switched_at = self.num_timesteps
            self.training_env.env_method("set_stage", 1)
        return True

    def get_state(self) -> dict[str, Any]:
        return {"recent": list(self.recent), "stage": self.stage, "switched_at": self.switched_at}

    def set_state(self, state: dict[str, Any]) -> None:
        self.recent.extend(state["recent"])
        self.stage, self.switched_at = state["stage"], state["switched_at"]


class Recorder(BaseCallback, Stateful):
    """Keeps the rows of a run's curve, and goes on from a checkpoint.

    ``note`` returns a short text on the training's progress, ``finish`` adds the last row, of the
    trained model, and ``summary`` returns what meta.json says of the training.
    """

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[dict[str, Any]] = []

    @abstractmethod
    def note(self) -> str: ...

    @abstractmethod
    def finish(self) -> None: ...

    @abstractmethod
    def summary(self) -> dict[str, Any]: ...


class CurveRecorder(Recorder):
    """Keeps the paper's seven training curves as rows and writes them to TensorBoard.

    A row is the mean over an interval of environment steps: of the episodes that ended in it, of
    the loss of its updates. Learning rate, noise (mean absolute sigma of the noisy layers, or
    epsilon) and mean max Q (of an actor-critic its critic's value) are those at its end.
    """

    def __init__(self, track: Track, curriculum: CurriculumCallback) -> None:
        super().__init__()
        self.curriculum = curriculum
        self.interval = max(track.hyperparameters.n_envs, math.ceil(track.timesteps / ROWS))
        self.counts = {"episodes": 0, "successes": 0, "singular": 0, "holes": 0}
        self.steps_to_75: int | None = None
        self.recent: deque[bool] = deque(maxlen=REFERENCE_WINDOW)
        self._ended: list[tuple[float, ...]] = []
        self._losses: list[float] = []
        self._next = self.interval

    def _on_rollout_start(self) -> None:
        # the loss of the updates since the last round of collection
        loss = self.logger.name_to_value.get("train/loss")
        if loss is not None and self.num_timesteps > 0:
            self._losses.append(float(loss))
        if self.num_timesteps >= self._next:
            self.finish()

    def _on_step(self) -> bool:
        for info in ended(self.locals, self.curriculum.rows):
            success, holes = bool(info["success"]), int(info["n_filled"])
            self.recent.append(success)
            self.counts["episodes"] += 1
            self.counts["successes"] += success
            self.counts["singular"] += bool(info["singular"])
            self.counts["holes"] += holes
            reward = float(info["episode"]["r"])
            self._ended.append((reward, float(holes), float(success), float(info["time"])))
        full = len(self.recent) == REFERENCE_WINDOW
        if self.steps_to_75 is None and full and np.mean(self.recent) > REFERENCE_THRESHOLD:
            self.steps_to_75 = self.num_timesteps
        return True

    def note(self) -> str:
        how = f"success {np.mean(self.recent):.0%}" if self.recent else "warming up"
        return f"{how}, stage {self.curriculum.stage}"

    def finish(self) -> None:
        """End the interval: one row, one point of each TensorBoard curve."""
        ended = np.array(self._ended or np.full((1, 4), math.nan), dtype=np.float64)
        reward, holes, success, duration = ended.mean(axis=0).tolist()
        row: dict[str, float] = {
            "timesteps": self.num_timesteps,
            "episodes": self.counts["episodes"],
            "stage": self.curriculum.stage,
            "episode_reward": reward,
            "holes": holes,
            "success": success,
            "success_20": float(np.mean(self.recent)) if self.recent else math.nan,
            "duration": duration,
            "loss": float(np.mean(self._losses)) if self._losses else math.nan,
            "mean_max_q": self._mean_max_q(),
            "learning_rate": float(self.model.policy.optimizer.param_groups[0]["lr"]),
            "noise": self._noise(),
        }
        self.rows.append(row)
        for column, value in row.items():
            if not math.isnan(value):
                self.logger.record(f"paper/{column}", value)
        self.logger.dump(self.num_timesteps)
        self._ended.clear()
        self._losses.clear()
        self._next = self.num_timesteps + self.interval

    def _mean_max_q(self) -> float:
        observation = self.model._last_obs
        assert isinstance(observation, np.ndarray)
        policy: Any = self.model.policy
        with torch.no_grad():
            tensor, _ = policy.obs_to_tensor(observation)
            if hasattr(policy, "q_net"):
                return float(policy.q_net(tensor).max(dim=1).values.mean())
            if hasattr(policy, "quantile_net"):
                return float(policy.quantile_net(tensor).mean(dim=1).max(dim=1).values.mean())
            values = getattr(policy, "predict_values", None)
            return float(values(tensor).mean()) if values else math.nan

    def _noise(self) -> float:
        q_net: Any = getattr(self.model.policy, "q_net", None)
        magnitudes = q_net.noise_magnitudes() if hasattr(q_net, "noise_magnitudes") else {}
        if magnitudes:
            return float(np.mean(list(magnitudes.values())))
        return float(getattr(self.model, "exploration_rate", 0.0))

    def summary(self) -> dict[str, Any]:
        episodes = self.counts["episodes"]
        return {
            "steps_to_75": self.steps_to_75,
            "curriculum_switch": self.curriculum.switched_at,
            "final_success_20": float(np.mean(self.recent)) if self.recent else None,
            "singular_per_1000": 1000.0 * self.counts["singular"] / episodes if episodes else None,
            **self.counts,
        }

    _KEPT: Final = ("rows", "counts", "steps_to_75", "_ended", "_losses", "_next")

    def get_state(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in self._KEPT} | {"recent": list(self.recent)}

    def set_state(self, state: dict[str, Any]) -> None:
        for name in self._KEPT:
            setattr(self, name, state[name])
        self.recent.extend(state["recent"])
