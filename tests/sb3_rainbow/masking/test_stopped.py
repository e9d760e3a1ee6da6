"""A callback stops the training, and it goes on: no step is lost."""

from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import CallbackList, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_rainbow import Rainbow
from tests.sb3_rainbow.masking.test_masks import make_clock, mask_at


def trained(n_envs: int, stops: tuple[int, ...], **settings: Any) -> Rainbow:
    """A model that is stopped after some steps of each environment, and at last after 60."""
    env = DummyVecEnv([make_clock] * n_envs)
    given: dict[str, Any] = {"learning_starts": 10_000, "buffer_size": 500, "seed": 0, **settings}
    model = Rainbow("MlpPolicy", env, device="cpu", train_freq=7, **given)
    for end in (*stops, 60):
        model.learn(
            1000,
            lambda inner, _, end=end: inner["self"].num_timesteps < end * n_envs,
            reset_num_timesteps=False,
        )
        assert model.num_timesteps == end * n_envs
    return model


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("stops", [(3,), (5, 6), (12, 25)])
def test_no_transition_skips_a_step(n_envs: int, stops: tuple[int, ...]) -> None:
    model = trained(n_envs, stops, n_steps=1)
    buffer: Any = model.replay_buffer
    samples = buffer.samples_at(np.flatnonzero(buffer.tree.leaves))
    assert len(samples.indices) == 60 * n_envs
    moved = samples.next_observations - samples.observations
    th.testing.assert_close(moved, th.tensor([[0.0, 1.0]]).expand_as(moved))
    for obs, mask in zip(samples.next_observations, samples.next_action_masks, strict=True):
        np.testing.assert_array_equal(mask, mask_at(*obs.tolist()))
    assert model._episode_num == 12 * n_envs


def test_what_is_stored_is_that_of_a_run_that_was_never_stopped() -> None:
    whole, stopped = trained(2, ()), trained(2, (4, 17))
    buffers: list[Any] = [whole.replay_buffer, stopped.replay_buffer]
    leaves, others = (np.flatnonzero(buffer.tree.leaves) for buffer in buffers)
    np.testing.assert_array_equal(leaves, others)
    first, second = (buffer.samples_at(leaves) for buffer in buffers)
    for name in ("observations", "next_observations", "actions", "rewards", "dones"):
        th.testing.assert_close(getattr(first, name), getattr(second, name))


def test_it_serves_sb3s_buffer_normalization_and_lists_of_callbacks() -> None:
    model = Rainbow(
        "MlpPolicy", VecNormalize(make_vec_env("CartPole-v1")), replay_buffer_class=ReplayBuffer,
        prioritized=False, n_steps=1, buffer_size=200, seed=0, device="cpu",
    )  # fmt: skip
    buffer: Any = model.replay_buffer
    for number in (1, 2):
        stop = CallbackList([StopTrainingOnMaxEpisodes(number)])
        model.learn(100, stop, reset_num_timesteps=False)
    assert buffer.pos == model.num_timesteps < 200
    stored = slice(buffer.pos - 1)
    goes_on = buffer.dones[stored, 0] == 0
    after = buffer.observations[1 : buffer.pos]
    np.testing.assert_array_equal(buffer.next_observations[stored][goes_on], after[goes_on])
