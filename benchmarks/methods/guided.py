"""Learners guided by a script: they begin with its noisy steps, or learn nothing but to copy it.

A peg that explores at random seldom comes down to the hole at all. The script's steps fill the
replay buffer with ways that do. They count as training steps.
"""

from functools import cache
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3 import TD3
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv
from torch.nn import functional

from benchmarks.errors import BenchmarkError, known
from benchmarks.methods.contact_scripts import Gains, MomentSearch
from benchmarks.protocol.presets import Guide

Actions = NDArray[Any]


class Guided(OffPolicyAlgorithm):
    """An algorithm whose first steps in the contact task are the moment-guided search's.

    Of twelve moves the script takes one along an axis drawn by how far it would go along each.
    """

    _guide: Guide

    def follow(self, guide: Guide) -> None:
        """Set the guide; BenchmarkError if the script has no such gain."""
        if unknown := guide.gains.keys() - Gains.__annotations__.keys():
            raise BenchmarkError(
                f"guide: unknown gain '{min(unknown)}'; known: {known(Gains.__annotations__)}"
            )
        self._guide = guide

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[Actions, Actions]:
        if self.num_timesteps >= self._guide.steps:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        increments = self._with_noise(self._script())
        if isinstance(self.action_space, spaces.Discrete):
            actions = _moves(increments)
            return actions, actions
        return increments, increments  # of -1 to 1, as the replay buffer has them

    def _script(self) -> NDArray[np.float32]:
        """The script's increments (n_envs, 6) where the environments stand."""
        assert isinstance(self.env, DummyVecEnv)
        assert isinstance(self._last_obs, np.ndarray)
        tasks, gains = self.env.get_attr("unwrapped"), Gains(**self._guide.gains)
        seen = zip(tasks, self._last_obs, strict=True)
        return np.stack([MomentSearch(task, gains)(observed) for task, observed in seen])

    def _with_noise(self, increments: NDArray[np.float32]) -> NDArray[np.float32]:
        noise = np.random.normal(size=increments.shape)  # noqa: NPY002 - as SB3 draws
        noisy = np.clip(increments + self._guide.noise * noise, -1.0, 1.0)
        return noisy.astype(np.float32)


def _moves(increments: NDArray[np.float32]) -> NDArray[np.int64]:
    """One of the twelve moves for each row of increments (n, 6)."""
    size = np.abs(increments) + 1e-6
    ends = np.cumsum(size, axis=1) / size.sum(axis=1, keepdims=True)
    drawn = np.random.random_sample((len(size), 1))  # noqa: NPY002 - as SB3 draws
    axes = np.minimum((ends < drawn).sum(axis=1), size.shape[1] - 1)
    return 2 * axes + (increments[np.arange(len(axes)), axes] < 0.0)


@cache
def guided(algorithm: type[OffPolicyAlgorithm]) -> type[Guided]:
    """The algorithm, guided."""
    if issubclass(algorithm, Guided):
        return algorithm
    return type(f"Guided{algorithm.__name__}", (Guided, algorithm), {})


class Cloning(Guided, TD3):
    """Behaviour cloning: TD3's actor regressed on what the script does.

    The script moves, with noise, and what it would do without is what is learned (Laskey et al.
    2017), from as many steps as the others have.
    """

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[Actions, Actions]:
        wanted = self._script()
        return self._with_noise(wanted), wanted

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Make ``gradient_steps`` steps of the regression."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.actor.optimizer)
        assert self.replay_buffer is not None
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size)
            observed = torch.as_tensor(batch.observations)
            loss = functional.mse_loss(self.actor(observed), batch.actions)
            self.actor.optimizer.zero_grad()
            loss.backward()
            self.actor.optimizer.step()
        self._n_updates += gradient_steps
        self.logger.record("train/loss", loss.item())
