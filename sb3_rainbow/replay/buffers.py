"""Prioritized n-step replay for any number of environments."""

from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_rainbow.replay import kernels
from sb3_rainbow.replay.kernels import RUNNING, TERMINATED, TRUNCATED
from sb3_rainbow.replay.observation_store import ObservationStore, in_single, whole
from sb3_rainbow.replay.parameters import (
    check_buffer_size,
    check_counts,
    check_shares,
    warn_of_memory,
)
from sb3_rainbow.replay.sum_tree import SumTree
from sb3_rainbow.type_aliases import ObsArray, PrioritizedReplayBufferSamples

_TRIMMED = ("actions", "rewards", "ends", "next_action_masks")


class PrioritizedReplayBuffer(ReplayBuffer):
    """Proportional prioritized replay (Schaul et al. 2016) of n-step transitions.

    - One sum tree spans all (step, env) pairs; a transition, named by its leaf ``row * n_envs +
      env``, can be drawn as soon as its window of ``n_steps`` rewards is complete, or its episode
      has ended, whichever comes first.
    - Returns never run across an episode's end, the windows shortened by an end are kept, and every
      sample carries its own discount ``gamma ** k``. A truncated episode bootstraps from its
      terminal observation, a terminated one does not.
    - Each observation is stored once, for every dtype and for dicts; the terminal observations,
      which autoreset would lose, are kept apart.

    It gives SB3's off-policy algorithms n-step returns; their draws are uniform, because they
    report no errors to their buffer::

        DQN("MlpPolicy", env, replay_buffer_class=PrioritizedReplayBuffer,
            replay_buffer_kwargs={"n_steps": 3, "gamma": 0.99})

    Args:
        buffer_size: transitions to keep, over all envs.
        observation_space: any space that SB3 supports, dicts included.
        action_space: any that SB3 supports; action masks need a discrete one.
        device: where samples go.
        optimize_memory_usage: accepted for SB3's sake; observations are always stored once.
        handle_timeout_termination: if False, truncations count as terminations.
        n_steps: rewards summed per sample.
        alpha: exponent of the priorities, from 0 (uniform) to 1 (proportional).
        beta: exponent of the importance-sampling correction, from 0 (none) to 1 (full).
        epsilon: added to every error, so that no transition is lost for good.

    Raises:
        ValueError: for parameters out of range, or a buffer that cannot hold one window per env.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        optimize_memory_usage: bool = False,
        handle_timeout_termination: bool = True,
        n_steps: int = 1,
        gamma: float = 0.99,
        alpha: float = 0.6,
        beta: float = 0.4,
        epsilon: float = 1e-6,
    ) -> None:
        check_counts(n_steps=n_steps)
        check_shares(gamma=gamma, alpha=alpha, beta=beta)
        if not 0.0 < epsilon < np.inf:
            # Without it a transition whose loss is zero once would never be drawn again.
            raise ValueError(f"epsilon must be above 0 and finite, got {epsilon}")
        check_buffer_size(buffer_size, n_envs, n_steps)
        # ReplayBuffer's own constructor would allocate a second copy of every observation.
        super(ReplayBuffer, self).__init__(
            buffer_size, observation_space, action_space, device, n_envs=n_envs
        )
        self.buffer_size = buffer_size // n_envs
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.n_steps = n_steps
        self.gamma = gamma
        self.alpha = alpha
        self.beta = beta
        self.epsilon = epsilon
        self._allocate()
        warn_of_memory(self.nbytes)

    def _allocate(self) -> None:
        shape = (self.buffer_size, self.n_envs)
        self._store = ObservationStore(*shape, self.observation_space, self.obs_shape)
        # Discrete for Rainbow; other algorithms bring what they choose
        self.actions = np.zeros(
            (*shape, self.action_dim), dtype=self._maybe_cast_dtype(self.action_space.dtype)
        )
        self.rewards = np.zeros(shape, dtype=np.float32)
        self.ends = np.zeros(shape, dtype=np.uint8)
        self.next_action_masks: NDArray[np.bool_] | None = None
        # Stored transitions per env whose window is not complete yet
        self._pending = np.zeros(self.n_envs, dtype=np.int64)
        self.tree = SumTree(self.buffer_size * self.n_envs)
        self.max_priority = 1.0

    def reset(self) -> None:
        """Forget everything."""
        super().reset()
        self._allocate()

    # SB3's names for what is stored
    @property
    def observations(self) -> ObsArray:  # type: ignore[override]
        """Stored observations, shape ``(buffer_size, n_envs, ...)``, or a dict of such."""
        return self._store.rows

    @property
    def dones(self) -> NDArray[np.bool_]:  # type: ignore[override]
        """Where an episode ended, terminated or truncated, ``(buffer_size, n_envs)``; a copy."""
        return self.ends != RUNNING

    @property
    def timeouts(self) -> NDArray[np.bool_]:  # type: ignore[override]
        """Where an episode was truncated, ``(buffer_size, n_envs)``; a copy."""
        return self.ends == TRUNCATED

    @property
    def nbytes(self) -> int:
        """Bytes that all of it occupies once it is full, but for terminal observations."""
        arrays = [getattr(self, name) for name in _TRIMMED]
        own = sum(array.nbytes for array in arrays if array is not None)
        return self._store.nbytes + self.tree.nbytes + own

    def add(
        self,
        obs: ObsArray,
        next_obs: ObsArray,
        action: NDArray,
        reward: NDArray,
        done: NDArray,
        infos: list[dict[str, Any]],
        next_action_masks: NDArray[np.bool_] | None = None,
    ) -> None:
        """Store one step of every env.

        Args:
            obs: observations the actions were chosen on, ``(n_envs, ...)``.
            next_obs: observations after the step; where an episode ended, its terminal observation,
                not the first one of the next episode.
            action: shape ``(n_envs,)`` or ``(n_envs, action_dim)``.
            reward: shape ``(n_envs,)``.
            done: terminated or truncated, ``(n_envs,)``.
            infos: ``"TimeLimit.truncated"`` tells truncations from terminations.
            next_action_masks: allowed at ``next_obs``, ``(n_envs, n_actions)``; None allows all.

        Raises:
            ValueError: for a reward that is not finite in float32; nothing is stored then.
        """
        rewards = np.asarray(reward, dtype=np.float32)
        finite = np.isfinite(rewards)
        if not finite.all():
            env = int(np.argmin(finite))
            raise ValueError(
                f"The reward of env {env} is {np.ravel(reward)[env]}, but must be finite (in "
                "float32): one such reward spoils every network; bound it, or correct its formula"
            )
        current, following = self._store.cast(obs), self._store.cast(next_obs)
        # Left in the middle, as when someone resets the env
        self._truncate(self._store.interrupted(current))
        pos = self.pos
        if self.full:
            overwritten = pos * self.n_envs + np.arange(self.n_envs, dtype=np.int64)
            self.tree.set(overwritten, np.zeros(self.n_envs))
            self._store.release(pos)
        self._store.write(pos, current, following)
        self.actions[pos] = action.reshape(self.n_envs, self.action_dim)
        self.rewards[pos] = rewards
        self._store_masks(pos, next_action_masks)

        self.ends[pos] = np.where(done, TERMINATED, RUNNING)
        if self.handle_timeout_termination:
            for env in np.flatnonzero(done).tolist():
                if infos[env].get("TimeLimit.truncated", False):
                    self.ends[pos, env] = TRUNCATED
        self._pending += 1
        self._complete(self.ends[pos] != RUNNING, pos)

        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def truncate(self) -> None:
        """Truncate the episodes that run, as the envs are reset in the middle of them."""
        self._truncate(np.ones(self.n_envs, bool))

    def _truncate(self, which: NDArray[np.bool_]) -> None:
        if not self.size() or not which.any():
            return
        newest = (self.pos - 1) % self.buffer_size
        which = which & (self.ends[newest] == RUNNING)
        self.ends[newest, which] = TRUNCATED
        self._complete(which, newest)

    def _store_masks(self, pos: int, masks: NDArray[np.bool_] | None) -> None:
        if masks is not None and self.next_action_masks is None:
            n_actions = int(cast(spaces.Discrete, self.action_space).n)
            # zeros take no memory before they are written to, and every row that is drawn was
            stored = np.zeros((self.buffer_size, self.n_envs, n_actions), dtype=np.bool_)
            stored[: self.size()] = True
            self.next_action_masks = stored
            warn_of_memory(self.nbytes)
        if self.next_action_masks is not None:
            self.next_action_masks[pos] = True if masks is None else masks

    def _complete(self, ended: NDArray[np.bool_], newest: int) -> None:
        for env in np.flatnonzero(ended).tolist():
            self._store.keep_newest(newest, env)
        leaves = np.empty(int(self._pending.sum()), dtype=np.int64)
        count = kernels.complete_windows(
            self._pending, ended, newest, self.buffer_size, self.n_steps, leaves
        )
        if count:  # at the top priority, so that each is drawn before long
            self.tree.set(leaves[:count], np.full(count, self.max_priority**self.alpha))

    @property
    def can_sample(self) -> bool:
        """Whether at least one n-step window is complete."""
        return self.tree.total > 0.0

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> PrioritizedReplayBufferSamples:
        """Draw transitions in proportion to their priorities, with replacement.

        ``env`` normalizes observations and rewards with its current statistics.

        Raises:
            ValueError: if no window is complete yet.
        """
        if not self.can_sample:
            raise ValueError(
                "The replay buffer holds no complete n-step window yet: raise learning_starts "
                f"(n_steps={self.n_steps}, n_envs={self.n_envs})"
            )
        return self._get_samples(self.tree.sample(batch_size), env)

    def update_priorities(self, indices: NDArray[np.int64], losses: NDArray) -> None:
        """Set the priorities of drawn transitions to ``(loss + epsilon) ** alpha``.

        Args:
            indices: as the sample gave them, ``(n,)``.
            losses: losses or absolute errors before importance weights, ``(n,)``.

        Raises:
            ValueError: for a loss that is negative or not finite.
        """
        n = indices.shape[0]
        leaves, masses = np.empty(n, dtype=np.int64), np.empty(n)
        count, largest = kernels.scale_priorities(
            indices,
            np.asarray(losses, dtype=np.float64),
            self.tree.leaves,
            self.alpha,
            self.epsilon,
            leaves,
            masses,
        )
        if count < 0:
            raise ValueError(
                f"A priority must come from a finite loss >= 0, got {largest}: training has "
                "diverged; lower the learning rate or max_grad_norm. Or an observation is not "
                "finite: look with stable_baselines3.common.vec_env.VecCheckNan"
            )
        self.tree.set(leaves[:count], masses[:count])
        self.max_priority = max(self.max_priority, largest)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: NDArray[np.int64], env: VecNormalize | None = None
    ) -> PrioritizedReplayBufferSamples:
        leaves, n = batch_inds, batch_inds.shape[0]
        weights = np.empty(n, dtype=np.float32)
        kernels.importance_weights(leaves, self.tree.leaves, self.beta, weights)
        returns, discounts, dones = (np.empty((n, 1), dtype=np.float32) for _ in range(3))
        last_leaves, next_rows, next_slots = (np.empty(n, dtype=np.int64) for _ in range(3))
        kernels.assemble_windows(
            leaves,
            self.rewards,
            self.ends,
            self._store.slots,
            (self.pos - 1) % self.buffer_size,
            self.n_steps,
            self.gamma,
            returns[:, 0],
            discounts[:, 0],
            dones[:, 0],
            last_leaves,
            next_rows,
            next_slots,
        )
        observations, next_observations = self._store.gather(leaves, next_rows, next_slots)
        if env is not None:
            observations = env.normalize_obs(observations)
            next_observations = env.normalize_obs(next_observations)
            returns = self._normalized_returns(leaves, env)
        # only now: what is normalized may be a small difference of large numbers
        parts: dict[str, ObsArray] = {
            "observations": in_single(observations),
            "actions": self.actions.reshape(-1, self.action_dim).take(leaves, axis=0),
            "next_observations": in_single(next_observations),
            "dones": dones,
            "rewards": returns,
            "discounts": discounts,
            "weights": weights,
        }
        masks = self.next_action_masks
        if masks is not None:
            masks = masks.reshape(-1, masks.shape[-1])
            parts["next_action_masks"] = masks.take(last_leaves, axis=0)
        tensors: dict[str, Any] = {name: self._to_device(part) for name, part in parts.items()}
        return PrioritizedReplayBufferSamples(indices=leaves, **tensors)

    def _to_device(self, values: ObsArray) -> th.Tensor | TensorDict:
        if isinstance(values, dict):
            return {key: th.from_numpy(part).to(self.device) for key, part in values.items()}
        return th.from_numpy(values).to(self.device)

    def _normalized_returns(
        self, leaves: NDArray[np.int64], env: VecNormalize
    ) -> NDArray[np.float32]:
        """As the kernel's returns, from rewards normalized one by one; ``(n, 1)``."""
        envs = leaves % self.n_envs
        rows = leaves // self.n_envs
        returns = np.zeros(leaves.shape[0])
        running = np.ones(leaves.shape[0], dtype=bool)
        for k in range(self.n_steps):
            row = (rows + k) % self.buffer_size
            rewards = env.normalize_reward(self.rewards[row, envs])
            returns += np.where(running, self.gamma**k * rewards, 0.0)
            running &= self.ends[row, envs] == RUNNING
        return returns.astype(np.float32)[:, None]

    def __getstate__(self) -> dict[str, Any]:
        n_used = self.size()
        state = self.__dict__.copy()
        state["_store"] = self._store.trimmed_state(n_used)
        for name in _TRIMMED:
            if state[name] is not None:
                state[name] = state[name][:n_used]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._store = ObservationStore.__new__(ObservationStore)
        self._store.restore_state(state["_store"])
        for name in _TRIMMED:
            if state[name] is not None:
                setattr(self, name, whole(state[name], self.buffer_size))
