"""Ring of n-step transitions of any number of environments."""

from abc import abstractmethod
from typing import Any, cast

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_rainbow.replay.kernels import (
    RUNNING,
    TERMINATED,
    TRUNCATED,
    assemble_windows,
    complete_windows,
)
from sb3_rainbow.replay.observation_store import ObservationStore, Rows, stored_dtype
from sb3_rainbow.replay.parameters import warn_of_memory
from sb3_rainbow.type_aliases import ObsArray

_TRIMMED = ("actions", "rewards", "ends", "action_masks", "next_action_masks")


class NStepRing(ReplayBuffer):
    """What a replay buffer of n-step transitions stores; which of them it draws, a subclass says.

    A transition, named by its leaf ``row * n_envs + env``, enters when its window of ``n_steps``
    rewards is complete or its episode has ended, whichever comes first, and leaves when its row is
    overwritten.

    Args:
        buffer_size: transitions to keep, over all envs.
        observation_space: any space that SB3 supports, dicts included.
        action_space: any that SB3 supports; action masks need a discrete one.
        device: where samples go.
        n_envs: number of environments that add in step.
        handle_timeout_termination: if False, truncations count as terminations.
        n_steps: rewards summed per sample.
        gamma: discount factor.
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str,
        n_envs: int,
        handle_timeout_termination: bool,
        n_steps: int,
        gamma: float,
    ) -> None:
        # ReplayBuffer's own constructor would allocate a second copy of every observation.
        super(ReplayBuffer, self).__init__(
            buffer_size, observation_space, action_space, device, n_envs=n_envs
        )
        self.buffer_size = buffer_size // n_envs
        self.optimize_memory_usage = False
        self.handle_timeout_termination = handle_timeout_termination
        self.n_steps = n_steps
        self.gamma = gamma
        self._allocate()
        warn_of_memory(self.nbytes)

    def _allocate(self) -> None:
        shape = (self.buffer_size, self.n_envs)
        self._store = ObservationStore(*shape, self.observation_space, self.obs_shape)
        # Discrete for Rainbow; other algorithms bring what they choose
        self.actions = np.zeros((*shape, self.action_dim), dtype=stored_dtype(self.action_space))
        self.rewards = np.zeros(shape, dtype=np.float32)
        self.ends = np.zeros(shape, dtype=np.uint8)
        self.action_masks: NDArray[np.bool_] | None = None
        self.next_action_masks: NDArray[np.bool_] | None = None
        # Stored transitions per env whose window is not complete yet
        self._pending = np.zeros(self.n_envs, dtype=np.int64)

    @abstractmethod
    def _enter(self, leaves: NDArray[np.int64]) -> None:
        """Transitions that can be drawn from now on."""

    @abstractmethod
    def _leave(self, leaves: NDArray[np.int64]) -> None:
        """Transitions that are about to be overwritten."""

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
        masks = (self.action_masks, self.next_action_masks)
        arrays = [self.actions, self.rewards, self.ends, *(m for m in masks if m is not None)]
        return self._store.nbytes + sum(array.nbytes for array in arrays)

    def add(
        self,
        obs: ObsArray,
        next_obs: ObsArray,
        action: NDArray,
        reward: NDArray,
        done: NDArray,
        infos: list[dict[str, Any]],
        next_action_masks: NDArray[np.bool_] | None = None,
        action_masks: NDArray[np.bool_] | None = None,
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
            next_action_masks: actions allowed at ``next_obs``, ``(n_envs, n_actions)``; None allows
                all.
            action_masks: the same at ``obs``, for who needs them.

        Raises:
            ValueError: for a reward that is not finite in float32; nothing is stored then.
        """
        rewards = np.asarray(reward, dtype=np.float32)
        finite = np.isfinite(rewards)
        if not finite.all():
            env = int(np.argmin(finite))
            raise ValueError(
                f"The reward of env {env} is {np.ravel(reward)[env]}, but must be finite (in "
                "float32): one such reward spoils every network; bound it, or mend its formula"
            )
        current, following = self._store.cast(obs), self._store.cast(next_obs)
        self._close_interrupted_episodes(current)
        pos = self.pos
        if self.full:
            self._leave(pos * self.n_envs + np.arange(self.n_envs, dtype=np.int64))
            self._store.release(pos)
        self._store.write(pos, current, following)
        self.actions[pos] = action.reshape(self.n_envs, self.action_dim)
        self.rewards[pos] = rewards
        self._store_masks("next_action_masks", pos, next_action_masks)
        self._store_masks("action_masks", pos, action_masks)

        ended = np.asarray(done, dtype=bool)
        self.ends[pos] = RUNNING
        if ended.any():
            self.ends[pos, ended] = TERMINATED
            for env in np.flatnonzero(ended).tolist():
                if self.handle_timeout_termination and infos[env].get("TimeLimit.truncated", False):
                    self.ends[pos, env] = TRUNCATED
                self._store.keep_newest(pos, env)
        self._pending += 1
        self._complete(ended, pos)

        self.pos += 1
        if self.pos == self.buffer_size:
            self.full = True
            self.pos = 0

    def _close_interrupted_episodes(self, current: Rows) -> None:
        """End the episodes that were left in the middle, as when ``learn`` resets the env: the
        stored step is then followed by an observation that it did not lead to.
        """
        if not (self.full or self.pos > 0):
            return
        newest = (self.pos - 1) % self.buffer_size
        interrupted = self._store.interrupted(current)
        if interrupted.any():
            interrupted &= self.ends[newest] == RUNNING
            for env in np.flatnonzero(interrupted).tolist():
                self.ends[newest, env] = TRUNCATED
                self._store.keep_newest(newest, env)
            self._complete(interrupted, newest)

    def _store_masks(self, name: str, pos: int, masks: NDArray[np.bool_] | None) -> None:
        stored = getattr(self, name)
        if masks is None:
            if stored is not None:
                stored[pos] = True
            return
        if stored is None:
            n_actions = int(cast(spaces.Discrete, self.action_space).n)
            # zeros take no memory before they are written to, and every row that is drawn was
            stored = np.zeros((self.buffer_size, self.n_envs, n_actions), dtype=np.bool_)
            stored[: self.size()] = True
            setattr(self, name, stored)
            warn_of_memory(self.nbytes)
        stored[pos] = masks

    def _complete(self, ended: NDArray[np.bool_], newest: int) -> None:
        leaves = np.empty(int(self._pending.sum()), dtype=np.int64)
        count = complete_windows(
            self._pending, ended, newest, self.buffer_size, self.n_steps, leaves
        )
        if count:
            self._enter(leaves[:count])

    def _windows(self, leaves: NDArray[np.int64], env: VecNormalize | None) -> dict[str, ObsArray]:
        """The transitions at the given leaves, as :class:`PrioritizedReplayBufferSamples` names
        their parts.
        """
        n = leaves.shape[0]
        returns, discounts, dones = (np.empty((n, 1), dtype=np.float32) for _ in range(3))
        last_leaves, next_rows, next_slots = (np.empty(n, dtype=np.int64) for _ in range(3))
        assemble_windows(
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
        parts = {
            "observations": observations,
            "actions": self.actions.reshape(-1, self.action_dim)[leaves],
            "next_observations": next_observations,
            "dones": dones,
            "rewards": returns,
            "discounts": discounts,
        }
        for name, where in (("action_masks", leaves), ("next_action_masks", last_leaves)):
            masks = getattr(self, name)
            if masks is not None:
                parts[name] = masks.reshape(-1, masks.shape[-1])[where]
        return parts

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
            used = state[name]
            if used is not None:
                whole = np.zeros((self.buffer_size, *used.shape[1:]), dtype=used.dtype)
                whole[: len(used)] = used
                setattr(self, name, whole)
