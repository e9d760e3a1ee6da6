"""Prioritized n-step replay for any number of environments."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import TensorDict
from stable_baselines3.common.vec_env import VecNormalize

from sb3_rainbow.replay.kernels import importance_weights, scale_priorities
from sb3_rainbow.replay.n_step_ring import NStepRing
from sb3_rainbow.replay.parameters import check_buffer_size, check_replay_parameters
from sb3_rainbow.replay.sum_tree import SumTree
from sb3_rainbow.type_aliases import ObsArray, PrioritizedReplayBufferSamples


class PrioritizedReplayBuffer(NStepRing):
    """Proportional prioritized replay (Schaul et al. 2016) of n-step transitions.

    - One sum tree spans all (step, env) pairs; a pair can be drawn as soon as its window of
      ``n_steps`` rewards is complete, or its episode has ended, whichever comes first.
    - Returns never run across an episode's end, the windows shortened by an end are kept, and every
      sample carries its own discount ``gamma ** k``. A truncated episode bootstraps from its
      terminal observation, a terminated one does not.
    - Each observation is stored once, for every dtype and for dicts; the terminal observations,
      which autoreset would lose, are kept apart. Memory per transition of 12 floats and 12 actions
      is about 90 bytes.
    - ``alpha=0`` is uniform replay.

    It takes the place of SB3's own buffers::

        DQN("MlpPolicy", env, replay_buffer_class=PrioritizedReplayBuffer,
            replay_buffer_kwargs={"n_steps": 3, "gamma": 0.99})

    SB3's ``DQN`` reports no losses to its buffer: add
    :class:`~sb3_rainbow.replay.callbacks.PrioritizedReplayCallback` to feed the priorities.

    Args:
        buffer_size: transitions to keep, over all envs.
        observation_space: any space that SB3 supports, dicts included.
        action_space: any that SB3 supports; action masks need a discrete one.
        device: where samples go.
        n_envs: number of environments that add in step.
        optimize_memory_usage: accepted for SB3's sake; observations are always stored once.
        handle_timeout_termination: if False, truncations count as terminations.
        n_steps: rewards summed per sample.
        gamma: discount factor.
        alpha: exponent of the priorities, from 0 (uniform) to 1 (proportional).
        beta: exponent of the importance-sampling correction, from 0 (none) to 1 (full).
        epsilon: added to every loss, so that no transition is lost for good.

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
        check_replay_parameters(n_steps, gamma, alpha, beta, epsilon)
        check_buffer_size(buffer_size, n_envs, n_steps)
        self.alpha = alpha
        self.beta = beta
        self.epsilon = epsilon
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device,
            n_envs,
            handle_timeout_termination,
            n_steps,
            gamma,
        )

    def _allocate(self) -> None:
        super()._allocate()
        self.tree = SumTree(self.buffer_size * self.n_envs)
        self.max_priority = 1.0
        self.last_indices: NDArray[np.int64] | None = None

    @property
    def nbytes(self) -> int:
        """Bytes that all of it occupies once it is full, but for terminal observations."""
        return super().nbytes + self.tree.nbytes

    @property
    def can_sample(self) -> bool:
        """Whether at least one n-step window is complete."""
        return self.tree.total > 0.0

    def _enter(self, leaves: NDArray[np.int64]) -> None:
        # At the top priority, so that each is drawn before long
        self.tree.set(leaves, np.full(leaves.shape, self.max_priority**self.alpha))

    def _leave(self, leaves: NDArray[np.int64]) -> None:
        self.tree.set(leaves, np.zeros(leaves.shape))

    def sample(  # type: ignore[override]
        self, batch_size: int, env: VecNormalize | None = None
    ) -> PrioritizedReplayBufferSamples:
        """Draw transitions in proportion to their priorities, with replacement.

        Args:
            batch_size: number of transitions.
            env: normalizes observations and rewards with its current statistics.

        Raises:
            ValueError: if no window is complete yet.
        """
        if not self.can_sample:
            raise ValueError(
                "The replay buffer holds no complete n-step window yet: raise learning_starts "
                f"(n_steps={self.n_steps}, n_envs={self.n_envs})"
            )
        self.last_indices = self.tree.sample(batch_size)
        return self._get_samples(self.last_indices, env)

    def samples_at(
        self, indices: NDArray[np.int64], env: VecNormalize | None = None
    ) -> PrioritizedReplayBufferSamples:
        """The transitions of given indices, as an earlier sample named them.

        Raises:
            ValueError: one of them has been overwritten, and what is there now is not complete.
        """
        empty = indices[self.tree.leaves[indices] <= 0.0]
        if len(empty):
            raise ValueError(
                f"No complete transition at index {empty[0]}: it has been overwritten since it was "
                "sampled"
            )
        return self._get_samples(indices, env)

    def _get_samples(  # type: ignore[override]
        self, batch_inds: NDArray[np.int64], env: VecNormalize | None = None
    ) -> PrioritizedReplayBufferSamples:
        """Transitions at the given leaves of the tree."""
        parts = self._windows(batch_inds, env)
        parts["weights"] = np.empty(batch_inds.shape[0], dtype=np.float32)
        importance_weights(batch_inds, self.tree.leaves, self.beta, parts["weights"])
        tensors: dict[str, Any] = {name: self._to_device(part) for name, part in parts.items()}
        return PrioritizedReplayBufferSamples(indices=batch_inds, **tensors)

    def _to_device(self, values: ObsArray) -> th.Tensor | TensorDict:
        if isinstance(values, dict):
            return {key: th.as_tensor(part, device=self.device) for key, part in values.items()}
        return th.as_tensor(values, device=self.device)

    def update_priorities(self, indices: NDArray[np.int64], losses: NDArray) -> None:
        """Set the priorities of drawn transitions to ``(loss + epsilon) ** alpha``.

        Args:
            indices: as the sample gave them, ``(n,)``.
            losses: per-sample losses or absolute errors before importance weights, ``(n,)``.

        Raises:
            ValueError: if a loss is negative or not finite.
        """
        n = indices.shape[0]
        leaves, masses = np.empty(n, dtype=np.int64), np.empty(n)
        count, largest = scale_priorities(
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
                "diverged; lower the learning rate or max_grad_norm"
            )
        self.tree.set(leaves[:count], masses[:count])
        self.max_priority = max(self.max_priority, largest)
