"""Off-policy collection with action masks: in the warm-up, in acting, and in what is stored."""

import warnings
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import RolloutReturn
from stable_baselines3.common.vec_env import VecEnv

from sb3_rainbow.masking import conventions
from sb3_rainbow.replay.buffers import PrioritizedReplayBuffer
from sb3_rainbow.type_aliases import ObsArray, UseMasking


class MaskedOffPolicyAlgorithm(OffPolicyAlgorithm):
    """SB3's off-policy loop for discrete actions, some of which an env may forbid.

    Masks are asked for once a step, after it, and serve the target of that step and the choice of
    the next action; before the first action of a rollout once more, as a callback may have changed
    the env. A subclass sets ``use_masking`` and defines ``predict(action_masks=)``.
    """

    action_space: spaces.Discrete
    use_masking: UseMasking = "auto"
    _masking: bool = False
    _warned_of_lost_mask: bool = False
    _last_action_masks: NDArray[np.bool_] | None = None
    _may_have_changed: bool = False  # whether callbacks may have changed the masks

    def _setup_learn(self, *args: Any, **kwargs: Any) -> tuple[int, BaseCallback]:
        before = self._last_obs
        prepared = super()._setup_learn(*args, **kwargs)
        assert self.env is not None
        if isinstance(self.replay_buffer, PrioritizedReplayBuffer) and before is not self._last_obs:
            self.replay_buffer.truncate()
        supported = masks_apply(self, self.env)
        if self.use_masking is True and not supported:
            raise ValueError(
                "use_masking=True, but the env has no action_masks(): wrap it in sb3-contrib's "
                "ActionMasker, or pass use_masking='auto'"
            )
        if supported and not isinstance(self.replay_buffer, PrioritizedReplayBuffer):
            raise ValueError(
                f"{type(self.replay_buffer).__name__} cannot store the env's action masks, which "
                "the target needs: pass use_masking=False"
            )
        self._masking = supported
        if supported:
            # Only now: who learns without masks may have an env that cannot give them.
            conventions.capture_terminal_masks(self.env)
        self._last_action_masks = self._current_masks() if supported else None
        return prepared

    def collect_rollouts(
        self, env: VecEnv, callback: BaseCallback, *args: Any, **kwargs: Any
    ) -> RolloutReturn:
        """As SB3's, but also stores the step at which a callback stops the training.

        SB3 drops it, although the env has moved: a training that goes on
        (``reset_num_timesteps=False``) would store a transition that skips a step.
        """
        self._may_have_changed = self._masking
        rollout = super().collect_rollouts(env, callback, *args, **kwargs)
        if not rollout.continue_training:
            buffer, step = self.replay_buffer, callback.locals
            assert buffer is not None
            names = ("buffer_actions", "new_obs", "rewards", "dones", "infos")
            self._update_info_buffer(step["infos"], step["dones"])
            self._store_transition(buffer, *(step[name] for name in names))
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._on_step()
            self._episode_num += int(np.sum(step["dones"]))
        return rollout

    def _current_masks(self) -> NDArray[np.bool_]:
        assert self.env is not None
        n_actions = int(self.action_space.n)
        return conventions.as_action_masks(get_action_masks(self.env), self.n_envs, n_actions)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[NDArray, NDArray]:
        if self._may_have_changed:
            self._may_have_changed, self._last_action_masks = False, self._current_masks()
        if self.num_timesteps < learning_starts:
            actions = self._random_actions(n_envs, self._last_action_masks)
        else:
            assert self._last_obs is not None, "self._last_obs was not set"
            actions = self._explore(self._last_obs, self._last_action_masks)
        return actions, actions

    def _random_actions(self, n: int, masks: NDArray[np.bool_] | None) -> NDArray[np.int64]:
        if masks is None:  # as SB3: a user's own space may take no mask
            return np.array([self.action_space.sample() for _ in range(n)])
        return np.array([self.action_space.sample(mask) for mask in masks.astype(np.int8)])

    def _epsilon_greedy(
        self, actions: NDArray, epsilon: float, action_masks: NDArray | None
    ) -> NDArray:
        """Each env's action, or with probability ``epsilon`` a random allowed one."""
        n = actions.size
        explores = np.random.random_sample(n) < epsilon  # noqa: NPY002
        if not explores.any():
            return actions
        masks = None if action_masks is None else np.asarray(action_masks, bool).reshape(n, -1)
        chosen = np.where(explores, self._random_actions(n, masks), actions.reshape(n))
        return chosen.reshape(actions.shape)

    def _explore(self, obs: ObsArray, action_masks: NDArray[np.bool_] | None) -> NDArray:
        """Exploring actions of a subclass's policy, ``(n_envs,)``."""
        # A subclass for envs without masks may have the signature of SB3's.
        masks: dict[str, Any] = {} if action_masks is None else {"action_masks": action_masks}
        actions, _ = self.predict(obs, deterministic=False, **masks)
        return actions

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: NDArray,
        new_obs: ObsArray,
        reward: NDArray,
        dones: NDArray,
        infos: list[dict[str, Any]],
    ) -> None:
        if not isinstance(replay_buffer, PrioritizedReplayBuffer):
            super()._store_transition(replay_buffer, buffer_action, new_obs, reward, dones, infos)
            return
        stored_obs, original_obs, stored_reward = self._last_obs, new_obs, reward
        normalizer = self._vec_normalize_env
        if normalizer is not None:
            stored_obs = self._last_original_obs
            original_obs = normalizer.get_original_obs()
            stored_reward = normalizer.get_original_reward()
        next_obs = original_obs
        if np.any(dones):
            next_obs = conventions.with_terminal_observations(
                original_obs, dones, infos, normalizer
            )
        masks: tuple[NDArray[np.bool_], ...] = ()
        if self._masking:
            now = self._last_action_masks = self._current_masks()
            next_masks, lost = conventions.with_terminal_masks(now, dones, infos)
            masks = (next_masks,)
            if lost and not self._warned_of_lost_mask:
                self._warned_of_lost_mask = True
                warnings.warn(conventions.LOST_MASK_WARNING, stacklevel=2)
        assert stored_obs is not None
        replay_buffer.add(stored_obs, next_obs, buffer_action, stored_reward, dones, infos, *masks)
        self._last_obs = new_obs
        self._last_original_obs = original_obs


def masks_apply(model: object, env: VecEnv) -> bool:
    """Whether a model is to act under the masks of an environment."""
    if not isinstance(model, MaskedOffPolicyAlgorithm) or not model.use_masking:
        return False
    return is_masking_supported(env) if model.use_masking is True else conventions.has_masks(env)
