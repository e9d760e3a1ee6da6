"""Rainbow with SB3's replay buffers, and ours where SB3's would stand."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, PPO, SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv, SimpleMultiObsEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_rainbow import PrioritizedReplayBuffer, PrioritizedReplayCallback, Rainbow
from tests.sb3_rainbow.small import FAST


@pytest.mark.parametrize("buffer_class", [ReplayBuffer, NStepReplayBuffer, DictReplayBuffer])
def test_sb3s_buffers(buffer_class: type[ReplayBuffer]) -> None:
    is_dict = buffer_class is DictReplayBuffer
    model = Rainbow(
        "MultiInputPolicy" if is_dict else "MlpPolicy",
        SimpleMultiObsEnv() if is_dict else "CartPole-v1",
        replay_buffer_class=buffer_class,
        prioritized=False,
        n_steps=3 if buffer_class is NStepReplayBuffer else 1,
        **FAST,
    )
    model.learn(60)
    assert type(model.replay_buffer) is buffer_class
    if buffer_class is NStepReplayBuffer:
        assert model.replay_buffer.n_steps == 3  # type: ignore[attr-defined]


class Clock(gym.Env):
    """The time, in seconds since 1970."""

    observation_space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = spaces.Discrete(2)

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        self.time = 1.7e9
        return np.array([self.time]), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.time += 1.0
        return np.array([self.time]), 0.0, False, False, {}


def test_small_differences_of_large_numbers_are_learned_from() -> None:
    env = VecNormalize(DummyVecEnv([Clock]), training=False)
    statistics: Any = env.obs_rms
    statistics.mean[:], statistics.var[:] = 1.7e9, 100.0
    model = Rainbow("MlpPolicy", env, n_steps=1, **FAST).learn(60)
    buffer: Any = model.replay_buffer
    samples = buffer.samples_at(np.arange(50), env)
    assert samples.observations.dtype == samples.next_observations.dtype == th.float32
    expected = np.clip(np.arange(51) / 10.0, -10.0, 10.0)
    assert samples.observations.ravel().numpy() == pytest.approx(expected[:50])
    assert samples.next_observations.ravel().numpy() == pytest.approx(expected[1:])
    assert buffer.samples_at(np.arange(50)).observations.dtype == th.float32


class Sevens(gym.Env):
    """Counts in sevens, in integers, until it is truncated."""

    action_space = spaces.Discrete(2)

    def __init__(self, space: spaces.Space) -> None:
        self.observation_space: spaces.Space = space

    def reset(self, **_: Any) -> tuple[Any, dict[str, Any]]:
        self.count = 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.count += 7
        return self._seen(), 0.0, False, self.count == 35, {}

    def _seen(self) -> Any:
        if isinstance(self.observation_space, spaces.Dict):
            return {"count": np.array([self.count])}
        if self.observation_space.dtype == bool:
            return np.array([self.count == 7, False])
        return np.full(self.observation_space.shape, self.count, np.int64)


@pytest.mark.parametrize(
    ("space", "norm_obs"),
    [
        (spaces.Box(0, 99, (1,), np.int64), True),
        (spaces.Dict(count=spaces.Box(0, 99, (1,), np.int64)), True),
        (spaces.Discrete(99), False),
    ],
)
def test_truncated_episodes_of_integers_end_where_they_ended(
    space: spaces.Space, norm_obs: bool
) -> None:
    """SB3's own way casts what is normalized to the integers of the environment."""
    env = VecNormalize(DummyVecEnv([lambda: Sevens(space)]), norm_obs=norm_obs)
    policy = "MultiInputPolicy" if isinstance(space, spaces.Dict) else "MlpPolicy"
    buffer: Any = Rainbow(policy, env, n_steps=1, **FAST).learn(60).replay_buffer
    samples = buffer.samples_at(np.arange(59))
    before, after = samples.observations, samples.next_observations
    if isinstance(space, spaces.Dict):
        before, after = before["count"], after["count"]
    steps = after.double() - before.double()
    assert set(steps.ravel().tolist()) == {7.0}


def hindsight(**kwargs: Any) -> Rainbow:
    env = BitFlippingEnv(n_bits=4, continuous=False)
    return Rainbow("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, **FAST, **kwargs)


def test_what_hindsight_cannot_do_is_off_with_one_warning(tmp_path: Any) -> None:
    with pytest.warns(
        UserWarning, match="HerReplayBuffer .*: prioritized=False, n_steps=1"
    ) as report:
        model = hindsight()
    assert len(report) == 1
    assert report[0].filename == __file__
    assert (model.prioritized, model.n_steps) == (False, 1)
    model.learn(60)
    assert model._n_updates > 0
    model.save(tmp_path / "m")
    assert Rainbow.load(tmp_path / "m", env=model.get_env()).learn(40).num_timesteps == 40


def test_hindsight_that_is_asked_for_more_is_an_error() -> None:
    hindsight(prioritized=False, n_steps=1).learn(60)
    with pytest.raises(ValueError, match="HerReplayBuffer keeps no priorities: pass prioritized=F"):
        hindsight(prioritized=True, n_steps=1)
    with pytest.raises(ValueError, match="no n-step returns: pass n_steps=1 instead of 3"):
        hindsight(prioritized=False, n_steps=3)
    both = "no priorities and no n-step returns: pass prioritized=False, n_steps=1 instead of 3"
    with pytest.raises(ValueError, match=both):
        hindsight(prioritized=True, n_steps=3)


def test_sb3s_n_step_buffer_lacks_only_the_priorities() -> None:
    with pytest.warns(UserWarning, match="NStepReplayBuffer .*: prioritized=False instead"):
        model = Rainbow("MlpPolicy", "CartPole-v1", replay_buffer_class=NStepReplayBuffer, **FAST)
    assert (model.prioritized, model.n_steps) == (False, 3)


def test_a_state_of_flags_ends_as_it_ended() -> None:
    space = spaces.Box(0, 1, (2,), np.bool_)  # type: ignore[arg-type]
    env = VecNormalize(DummyVecEnv([lambda: Sevens(space)]))
    buffer: Any = Rainbow("MlpPolicy", env, n_steps=1, **FAST).learn(60).replay_buffer
    samples = buffer.samples_at(np.arange(59))
    ends = samples.next_observations[4::5]  # truncated at 35
    assert not ends.any()


def test_what_outlives_its_row_needs_no_more_room_than_rows() -> None:
    space = spaces.Box(0, 99, (64,), np.float32)
    buffer = PrioritizedReplayBuffer(1100, space, spaces.Discrete(2), device="cpu", n_steps=1)
    one = np.ones((1, 64), np.float32)
    for step in range(2500):  # episodes of one step: each row leads to an observation of its own
        done = np.array([True])
        buffer.add(step * one, -step * one, np.zeros((1, 1)), np.zeros(1), done, [{}])
    (boundary,) = buffer._store._boundary.values()
    assert len(boundary) <= 1101


def test_optimize_memory_usage_is_accepted() -> None:
    model = Rainbow("MlpPolicy", "CartPole-v1", optimize_memory_usage=True, **FAST)
    model.learn(40).learn(40, reset_num_timesteps=False)
    with warnings.catch_warnings():  # SB3 would warn of what its own buffer does at a reset
        warnings.simplefilter("error")
        model.learn(40)
    buffer = model.replay_buffer
    assert isinstance(buffer, PrioritizedReplayBuffer)
    # Cut there, not ended: the return goes on from where the episode stood.
    assert buffer.timeouts[79]


def test_the_callback_serves_dqn_with_the_buffer() -> None:
    ours: dict[str, Any] = {"replay_buffer_class": PrioritizedReplayBuffer, "buffer_size": 100}
    for model, name in (
        (DQN("MlpPolicy", "CartPole-v1", buffer_size=100), "DQN with ReplayBuffer"),
        (PPO("MlpPolicy", "CartPole-v1", device="cpu"), "PPO with NoneType"),
        (SAC("MlpPolicy", "Pendulum-v1", **ours), "SAC with PrioritizedReplayBuffer"),
    ):
        with pytest.raises(ValueError, match=f"needs SB3's DQN with .*, got {name}"):
            model.learn(10, callback=PrioritizedReplayCallback())


IMAGE = spaces.Box(0, 255, (3, 4, 5), np.uint8)
BOTH = spaces.Dict({"image": IMAGE, "place": spaces.Discrete(7)})


@pytest.mark.parametrize(
    ("space", "shape", "message"),
    [
        (spaces.Box(-1, 1, (4,)), (4, 2), r"shape \(2, 4\) .envs first., got \(4, 2\)"),
        (spaces.Box(-1, 1, (4,)), (8,), r"shape \(2, 4\) .envs first., got \(8,\)"),
        (spaces.Box(-1, 1, (4,)), (1, 4), r"shape \(2, 4\) .envs first., got \(1, 4\)"),
        (spaces.Box(-1, 1, (1,)), (2,), r"shape \(2, 1\) .envs first., got \(2,\)"),
        (IMAGE, (2, 4, 5, 3), r"shape \(2, 3, 4, 5\) .* got \(2, 4, 5, 3\)\. A VecNormalize must"),
        (BOTH, (2, 4, 5, 3), r"'image' must have shape \(2, 3, 4, 5\) .*got \(2, 4, 5, 3\)"),
    ],
)
@pytest.mark.parametrize("where", ["obs", "next_obs"])
def test_an_observation_of_another_shape_is_an_error(
    space: spaces.Space, shape: tuple[int, ...], message: str, where: str
) -> None:
    def given(shape: tuple[int, ...]) -> Any:
        obs = np.zeros(shape, np.float32)
        return {"image": obs, "place": np.array([3, 6])} if space is BOTH else obs

    buffer = PrioritizedReplayBuffer(20, space, spaces.Discrete(3), device="cpu", n_envs=2)
    box = IMAGE if space is BOTH else space
    right = given((2, *(box.shape or ())))
    rest: Any = (np.zeros(2), np.zeros(2), np.zeros(2), [{}, {}])
    buffer.add(right, right, *rest)
    before, after = (given(shape), right) if where == "obs" else (right, given(shape))
    with pytest.raises(ValueError, match=message):
        buffer.add(before, after, *rest)
    assert buffer.size() == 1


def test_a_buffer_beyond_the_memory_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    psutil = pytest.importorskip("psutil")

    class Memory:
        available = 10_000

    monkeypatch.setattr(psutil, "virtual_memory", Memory)

    def make(n: int, space: spaces.Space) -> PrioritizedReplayBuffer:
        return PrioritizedReplayBuffer(n, space, spaces.Discrete(100), device="cpu")

    box, image = spaces.Box(0, 1, (4,)), spaces.Box(0, 255, (400,), np.uint8)
    # 16 bytes of an observation, 8 of an action, 4 of a reward, 1 of an end, 4 of a place in the
    # boundary store and 8 * 8/7 of a leaf of the tree: 42 bytes a transition
    buffer = make(200, box)
    assert buffer.nbytes == pytest.approx(200 * 42, rel=0.02)
    images = spaces.Dict({"a": image, "b": image, "c": image})
    for n, space in ((300, box), (30, image), (10, images)):
        with pytest.warns(UserWarning, match=r"enough memory .* 0.00GB > 0.00GB"):
            make(n, space)
    # Masks come with the first step, and are 100 bytes each here.
    obs, masks = np.zeros((1, 4)), np.ones((1, 100), bool)
    with pytest.warns(UserWarning, match="enough memory"):
        buffer.add(obs, obs, np.zeros(1), np.zeros(1), np.zeros(1), [{}], masks)
    Memory.available = 10**9
    make(300, box)
