"""Masks wherever an action is chosen or valued; a callback stops the training, and it goes on."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from sb3_contrib.common.wrappers import ActionMasker
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback, CallbackList, StopTrainingOnMaxEpisodes
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecMonitor, VecNormalize

from sb3_rainbow import PrioritizedReplayBuffer, Rainbow, TerminalActionMask, rainbow
from sb3_rainbow.learner.learner import as_batch
from tests.sb3_rainbow.small import Toy, make

N_ACTIONS = 6


class ClockEnv(Toy):
    """Shows (episode, time), on which its mask depends; a forbidden action raises."""

    episode, stage, _level = -1, 0, 0

    def __init__(self, length: int = 5, terminated: bool = False) -> None:
        space = spaces.Box(-1.0, 1e6, (2,), np.float32)
        super().__init__(space, self.place, length=length, terminated=terminated)
        self.action_space = spaces.Discrete(N_ACTIONS)

    def place(self, time: int) -> np.ndarray:
        return np.array([self.episode, time], np.float32)

    def reset(self, **kwargs: Any) -> Any:
        self.episode += 1
        return super().reset(**kwargs)

    def step(self, action: int) -> Any:
        place = self.place(self.steps)
        assert mask_at(*place)[action], f"action {action} is forbidden at {place}"
        return super().step(action)

    def action_masks(self) -> np.ndarray:
        return mask_at(self.episode, self.steps)


class Unknown(ClockEnv):
    """Its masks allow all; what it raises at, a wrapper has to say."""

    def action_masks(self) -> np.ndarray:
        return np.ones(N_ACTIONS, bool)


def mask_at(episode: float, time: float) -> np.ndarray:
    allowed = np.array([3 * episode + time, episode + 2 * time + 1]) % N_ACTIONS
    return np.isin(np.arange(N_ACTIONS), allowed)


def small_model(env: Any, **kwargs: Any) -> Rainbow:
    return make(env=env, **{"train_freq": 1, "buffer_size": 1000, "batch_size": 16, **kwargs})


def check_stored_masks(buffer: Any, n_expected: int) -> Any:
    """Every drawable transition, with the mask of the very state that its window ended in."""
    assert isinstance(buffer, PrioritizedReplayBuffer)
    samples: Any = buffer._get_samples(np.flatnonzero(buffer.tree.leaves))
    assert len(samples.indices) == n_expected
    for obs, mask in zip(samples.next_observations, samples.next_action_masks, strict=True):
        np.testing.assert_array_equal(mask, mask_at(*obs.tolist()))
    assert (np.asarray(samples.next_observations)[:, 1] == 5).any()
    return samples


# The environment itself raises where a forbidden action is taken: in the warm-up (first 20 steps),
# by noise, by epsilon-greedy exploration and by the greedy policy.
@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_no_forbidden_action_is_ever_taken(noisy: bool, n_envs: int) -> None:
    env = DummyVecEnv([ClockEnv] * n_envs)
    model = small_model(env, noisy=noisy, exploration_final_eps=0.5).learn(150)
    check_stored_masks(model.replay_buffer, n_expected=n_drawable(150, n_envs))


def n_drawable(n_steps: int, n_envs: int) -> int:
    """Of the open episode of each env, the last n - 1 = 2 windows are not complete yet."""
    per_env = n_steps // n_envs
    return (per_env - min(per_env % 5, 2)) * n_envs


def subprocesses(wrapper: Any) -> SubprocVecEnv:
    return SubprocVecEnv([lambda: wrapper(ClockEnv())] * 2, start_method="fork")


def masks_of(env: Any) -> np.ndarray:
    return mask_at(env.unwrapped.episode, env.unwrapped.steps)


@pytest.mark.parametrize(
    "make_env",
    [
        lambda: ActionMasker(Unknown(), masks_of),
        lambda: ActionMasker(Unknown(), lambda env: masks_of(env)[None]),
        lambda: ActionMasker(TerminalActionMask(Unknown()), masks_of),
        lambda: subprocesses(TerminalActionMask),
    ],
    ids=["action masker", "a row", "outermost", "subprocesses"],
)
def test_masks_of_every_kind_of_env_are_stored(make_env: Callable[[], Any]) -> None:
    model = small_model(make_env()).learn(90)
    check_stored_masks(model.replay_buffer, n_drawable(90, model.n_envs))
    model.get_env().close()  # type: ignore[union-attr]


class OneLess(VecMonitor):
    """Forbids what is allowed first, unless nothing else is."""

    def env_method(self, method_name: str, *args: Any, **kwargs: Any) -> list[Any]:
        masks = super().env_method(method_name, *args, **kwargs)
        for mask in masks if method_name == "action_masks" else []:
            mask[int(mask.argmax())] = mask.sum() == 1
        return masks


@pytest.mark.parametrize(
    "make_env",
    [lambda: subprocesses(lambda env: env), lambda: OneLess(DummyVecEnv([ClockEnv]))],
    ids=["subprocesses", "a wrapper of the batch changes them"],
)
def test_masks_that_cannot_be_taken_from_below_are_told_once(make_env: Callable[[], Any]) -> None:
    env = make_env()
    with pytest.warns(UserWarning, match="wrap each env in sb3_rainbow.TerminalActionMask") as seen:
        small_model(env).learn(60)
    assert len(seen) == 1
    env.close()


@pytest.mark.parametrize("use_masking", ["auto", True, False])
def test_a_loaded_buffers_masks_count_without_a_rollout(
    use_masking: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small_model(ClockEnv()).learn(60).save_replay_buffer(tmp_path / "buffer")
    model = small_model(ClockEnv(), use_masking=use_masking)
    model.load_replay_buffer(tmp_path / "buffer")
    model.set_logger(configure(None, []))
    spy = Mock(wraps=as_batch)
    monkeypatch.setattr(rainbow, "as_batch", spy)
    model.train(2)
    batches = [as_batch(*call.args) for call in spy.mock_calls]
    assert [each.next_action_masks is None for each in batches] == [use_masking is False] * 2


def test_no_one_asks_for_the_mask_of_a_terminated_state() -> None:
    class NoMovesLeft(ClockEnv):
        def action_masks(self) -> np.ndarray:
            assert self.steps < self.length, "the game is over"  # type: ignore[operator]
            return super().action_masks()

    small_model(DummyVecEnv([lambda: NoMovesLeft(terminated=True)] * 2)).learn(60)


def test_a_truncated_state_that_allows_nothing_is_named() -> None:
    class Stuck(ClockEnv):
        def action_masks(self) -> np.ndarray:
            return super().action_masks() & (self.steps != self.length)

    env = DummyVecEnv([ClockEnv, lambda: Stuck(length=4)])
    with pytest.raises(ValueError, match=r"env 1 was truncated in a state .* allows no action"):
        small_model(env).learn(40)


def test_the_wrapper_around_a_monitor_is_one_and_not_seen() -> None:
    env = make_vec_env(ClockEnv, n_envs=2)
    for _ in range(2):
        small_model(env).learn(30)
    assert env.env_is_wrapped(TerminalActionMask) == [True, True]
    wrapped = env.envs  # type: ignore[attr-defined]
    assert [type(each.env) for each in wrapped] == [Monitor, Monitor]
    own, plain = vars(wrapped[0]), vars(gym.Wrapper(wrapped[0].env))
    assert own.keys() == plain.keys()
    for name in ("stage", "_level"):
        env.env_method("set_wrapper_attr", name, 3)
        assert [vars(e.unwrapped)[name] for e in wrapped] == env.get_attr(name) == [3, 3]
        env.set_attr(name, 4)
        assert [vars(e.unwrapped)[name] for e in wrapped] == env.get_attr(name) == [4, 4]
    assert env.env_method("set_wrapper_attr", "no_such_thing", 1, force=False) == [False, False]


def test_predict_obeys_masks_of_one_observation_and_of_a_batch() -> None:
    model = small_model(ClockEnv(), noisy=False)
    model.exploration_rate = 0.5
    obs = np.zeros((40, 2), np.float32)
    masks = np.random.default_rng(0).random((40, N_ACTIONS)) < 0.3
    masks[np.arange(40), np.arange(40) % N_ACTIONS] = True
    for deterministic in (True, False):
        actions, _ = model.predict(obs, deterministic=deterministic, action_masks=masks)
        assert masks[np.arange(40), actions].all()
    action, _ = model.predict(obs[0], action_masks=np.arange(N_ACTIONS) == 4)
    assert action.shape == ()
    assert action == 4


ONES = np.ones((3, N_ACTIONS), np.int8)


@pytest.mark.parametrize(
    ("n", "masks", "message"),
    [
        (1, np.ones(N_ACTIONS - 1, bool), r"shape \(1, 6\) \(envs, actions\), got \(1, 5\)"),
        (1, np.zeros(N_ACTIONS, bool), "mask of env 0 allows no action"),
        (1, np.ones((2, N_ACTIONS), bool), "shape"),
        (1, np.arange(N_ACTIONS), "True or False .* not 2: is it a list of actions"),
        (3, ONES.T, r"shape \(3, 6\) \(envs, actions\), got \(6, 3\)"),  # is not reshaped
        (3, np.ones(7, bool), r"got \(1, 7\)"),
        (3, np.ones(3, bool), r"got \(1, 3\)"),
    ],
)
def test_bad_masks_in_predict(n: int, masks: np.ndarray, message: str) -> None:
    model, obs = small_model(ClockEnv()), np.zeros((3, 2), np.float32)
    for good in (ONES, ONES.reshape(-1)):
        model.predict(obs, action_masks=good)
    with pytest.raises(ValueError, match=message):
        model.predict(obs[0] if n == 1 else obs, action_masks=masks)


def test_bad_masks_of_an_env() -> None:
    env = ActionMasker(ClockEnv(), lambda _: np.ones(4, bool))
    with pytest.raises(ValueError, match=r"must have shape \(1, 6\)"):
        small_model(env).learn(10)


def test_use_masking() -> None:
    with pytest.raises(ValueError, match="has no action_masks"):
        small_model(gym.make("CartPole-v1"), use_masking=True).learn(10)
    small_model(gym.make("CartPole-v1")).learn(30)
    for off in (False, 0, np.False_):
        model = small_model(ClockEnv(), use_masking=off)
        assert model.use_masking is False
        with pytest.raises(AssertionError, match="is forbidden"):
            model.learn(50)
    model = small_model(ClockEnv())
    with pytest.raises(AssertionError, match="is forbidden"):
        model.learn(50, use_masking=False)
    plain: Any = {"replay_buffer_class": ReplayBuffer, "prioritized": False, "n_steps": 1}
    with pytest.raises(ValueError, match=r"ReplayBuffer cannot store .* use_masking=False"):
        small_model(ClockEnv(), **plain).learn(10)
    unclear: Any = "no"
    with pytest.raises(ValueError, match="use_masking must be"):
        model.learn(50, use_masking=unclear)
    with pytest.raises(ValueError, match="use_masking must be"):
        small_model(ClockEnv(), use_masking=unclear)


class Draws(spaces.Discrete):
    def sample(self) -> np.int64:  # type: ignore[override] # a user's own, which takes no mask
        return np.int64(1)


class Simulator(DummyVecEnv):
    """Answers what SB3 asks of a ``VecEnv``, and no more."""

    def __init__(self, unknown: type[Exception] | None) -> None:
        self.unknown = unknown
        super().__init__([lambda: gym.make("CartPole-v1")] * 2)
        self.action_space = Draws(2)

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        if self.unknown and attr_name != "render_mode":
            raise self.unknown
        return [None] * self.num_envs

    def step_wait(self) -> Any:
        observations, rewards, dones, infos = super().step_wait()
        return observations, rewards, dones.tolist(), infos


@pytest.mark.parametrize("unknown", [None, NotImplementedError])
def test_a_vec_env_of_ones_own_that_serves_dqn_serves_rainbow(
    unknown: type[Exception] | None,
) -> None:
    small_model(Simulator(unknown)).learn(60)
    if unknown:
        with pytest.raises(unknown):
            small_model(Simulator(unknown), use_masking=True).learn(60)


def test_masks_left_out_of_a_prediction_are_told_once(tmp_path: Any) -> None:
    model = small_model(DummyVecEnv([ClockEnv])).learn(60)
    model.save(tmp_path / "m")
    obs: Any = model.env.reset()  # type: ignore[union-attr]
    for asked in (model, Rainbow.load(tmp_path / "m")):
        with pytest.warns(UserWarning, match="MaskableEvalCallback"):
            asked.predict(obs)
        asked.predict(obs)  # another warning would be an error
        asked.predict(obs, action_masks=np.ones(asked.action_space.n, bool))
    small_model(DummyVecEnv([ClockEnv]), use_masking=False).predict(obs)


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("stops", [(3,), (5, 6), (12, 25)])
def test_no_transition_skips_a_step(n_envs: int, stops: tuple[int, ...]) -> None:
    env = DummyVecEnv([ClockEnv] * n_envs)
    model = small_model(env, learning_starts=10_000, train_freq=7, n_steps=1)
    for end in (*stops, 60):
        model.learn(
            1000,
            lambda inner, _, end=end: inner["self"].num_timesteps < end * n_envs,
            reset_num_timesteps=False,
        )
        assert model.num_timesteps == end * n_envs
    samples = check_stored_masks(model.replay_buffer, 60 * n_envs)
    moved = samples.next_observations - samples.observations
    th.testing.assert_close(moved, th.tensor([[0.0, 1.0]]).expand_as(moved))
    assert model._episode_num == 12 * n_envs
    assert model._n_calls == 60  # the steps that move the target


def test_it_serves_sb3s_buffer_normalization_and_lists_of_callbacks() -> None:
    env = VecNormalize(make_vec_env("CartPole-v1"))
    model = make(env=env, replay_buffer_class=ReplayBuffer, prioritized=False, n_steps=1)
    buffer: Any = model.replay_buffer
    for number in (1, 2):
        stop = CallbackList([StopTrainingOnMaxEpisodes(number)])
        model.learn(100, stop, reset_num_timesteps=False)
    assert buffer.pos == model.num_timesteps < 500
    stored = slice(buffer.pos - 1)
    goes_on = buffer.dones[stored, 0] == 0
    after = buffer.observations[1 : buffer.pos]
    np.testing.assert_array_equal(buffer.next_observations[stored][goes_on], after[goes_on])


def test_masks_follow_what_a_callback_does_between_rollouts() -> None:
    class Switch(BaseCallback):
        def _on_rollout_start(self) -> None:
            (env,) = self.training_env.envs  # type: ignore[attr-defined]
            env.unwrapped.episode += 1

        def _on_step(self) -> bool:
            return True

    make(env=ClockEnv()).learn(40, Switch())
