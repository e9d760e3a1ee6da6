"""Rainbow with SB3's replay buffers, and ours where SB3's would stand."""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.envs import BitFlippingEnv, SimpleMultiObsEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_rainbow import PrioritizedReplayBuffer, Rainbow
from tests.sb3_rainbow.small import FAST, Toy, make


@pytest.mark.parametrize(
    ("buffer_class", "policy", "env", "n_steps"),
    [
        (ReplayBuffer, "MlpPolicy", "CartPole-v1", 1),
        (NStepReplayBuffer, "MlpPolicy", "CartPole-v1", 3),
        (DictReplayBuffer, "MultiInputPolicy", SimpleMultiObsEnv(), 1),
    ],
)
def test_sb3s_buffers(
    buffer_class: type[ReplayBuffer], policy: str, env: Any, n_steps: int
) -> None:
    kept: Any = {"replay_buffer_class": buffer_class, "prioritized": False, "n_steps": n_steps}
    buffer = make(policy, env, **kept).learn(60).replay_buffer
    assert type(buffer) is buffer_class
    assert getattr(buffer, "n_steps", 1) == n_steps


def test_small_differences_of_large_numbers_are_learned_from() -> None:
    """Such as times, in seconds since 1970."""
    space = spaces.Box(-np.inf, np.inf, (1,), np.float64)
    clock = Toy(space, lambda step: np.array([1.7e9 + step]))
    env = VecNormalize(DummyVecEnv([lambda: clock]), training=False)
    statistics: Any = env.obs_rms
    statistics.mean[:], statistics.var[:] = 1.7e9, 100.0
    buffer: Any = make(env=env, n_steps=1).learn(60).replay_buffer
    samples = buffer._get_samples(np.arange(50), env)
    assert samples.observations.dtype == samples.next_observations.dtype == th.float32
    expected = np.clip(np.arange(51) / 10.0, -10.0, 10.0)
    assert samples.observations.ravel().numpy() == pytest.approx(expected[:50])
    assert samples.next_observations.ravel().numpy() == pytest.approx(expected[1:])
    assert buffer._get_samples(np.arange(50)).observations.dtype == th.float32


SEVENS = spaces.Box(0, 99, (1,), np.int64)
FLAGS = spaces.Box(0, 1, (2,), np.bool_)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("space", "shown", "norm_obs"),
    [
        (SEVENS, lambda step: np.array([7 * step]), True),
        (spaces.Dict(count=SEVENS), lambda step: np.array([7 * step]), True),
        (spaces.Discrete(99), lambda step: 7 * step, False),
        (FLAGS, lambda step: np.array([step == 1, False]), True),
    ],
)
def test_truncated_episodes_of_integers_end_where_they_ended(
    space: spaces.Space, shown: Any, norm_obs: bool
) -> None:
    """SB3's own way casts what is normalized to the integers of the environment."""
    named = isinstance(space, spaces.Dict)
    toy = Toy(space, (lambda step: {"count": shown(step)}) if named else shown, length=5)
    env = VecNormalize(DummyVecEnv([lambda: toy]), norm_obs=norm_obs)
    policy = "MultiInputPolicy" if named else "MlpPolicy"
    buffer: Any = make(policy, env, n_steps=1).learn(60).replay_buffer
    following = buffer._get_samples(np.arange(59)).next_observations
    wanted = [np.ravel(shown(i % 5 + 1)) for i in range(59)]
    np.testing.assert_array_equal(following["count"] if named else following, wanted)


BITS = BitFlippingEnv(n_bits=4, continuous=False)


def test_what_hindsight_cannot_do_is_off_with_one_warning(tmp_path: Any) -> None:
    with pytest.warns(UserWarning, match="HerRep.*: prioritized=False, n_steps=1") as report:
        model = Rainbow("MultiInputPolicy", BITS, replay_buffer_class=HerReplayBuffer, **FAST)
    assert len(report) == 1
    assert report[0].filename == __file__
    assert (model.prioritized, model.n_steps) == (False, 1)
    model.learn(60)
    assert model._n_updates > 0
    model.save(tmp_path / "m")
    assert Rainbow.load(tmp_path / "m", env=model.get_env()).learn(40).num_timesteps == 40


@pytest.mark.parametrize(
    ("prioritized", "n_steps", "message"),
    [
        (True, 1, "HerReplayBuffer keeps no priorities: pass prioritized=F"),
        (False, 3, "no n-step returns: pass n_steps=1 instead of 3"),
        (True, 3, "no priorities and no n-step returns: pass prioritized=False, n_steps=1 instead"),
    ],
)
def test_hindsight_that_is_asked_for_more_is_an_error(
    prioritized: bool, n_steps: int, message: str
) -> None:
    asked: Any = {"replay_buffer_class": HerReplayBuffer, "prioritized": prioritized}
    with pytest.raises(ValueError, match=message):
        make("MultiInputPolicy", BITS, n_steps=n_steps, **asked)


def test_sb3s_n_step_buffer_lacks_only_the_priorities() -> None:
    with pytest.warns(UserWarning, match="NStepReplayBuffer .*: prioritized=False instead"):
        model = make(replay_buffer_class=NStepReplayBuffer)
    assert (model.prioritized, model.n_steps) == (False, 3)


def test_what_outlives_its_row_needs_no_more_room_than_rows() -> None:
    space = spaces.Box(0, 99, (64,), np.float32)
    buffer = PrioritizedReplayBuffer(1100, space, spaces.Discrete(2), device="cpu", n_steps=1)
    one, zero = np.ones((1, 64), np.float32), np.zeros(1)
    for step in range(2500):  # episodes of one step: each row leads to an observation of its own
        buffer.add(step * one, -step * one, zero, zero, np.ones(1, bool), [{}])
    (boundary,) = buffer._store._boundary.values()
    assert len(boundary) <= 1101


def test_optimize_memory_usage_is_accepted() -> None:
    model = make(optimize_memory_usage=True)
    model.learn(40).learn(40, reset_num_timesteps=False)
    model.learn(40)  # SB3 would warn, which is an error here, of what its own buffer does


@pytest.mark.parametrize(("kind", "env"), [(DQN, "CartPole-v1"), (SAC, "Pendulum-v1")])
def test_sb3s_algorithms_draw_n_step_returns_uniformly_and_whole_actions(
    kind: Any, env: str
) -> None:
    kept: Any = {"n_steps": 3, "gamma": 0.9}
    given: Any = {"replay_buffer_class": PrioritizedReplayBuffer, "replay_buffer_kwargs": kept}
    model = kind("MlpPolicy", env, learning_starts=20, buffer_size=100, seed=0, **given)
    buffer = model.learn(80).replay_buffer
    samples = buffer.sample(100)
    assert 0.9**3 in np.unique(samples.discounts.round(decimals=6))
    assert np.unique(buffer.tree.leaves).tolist() == [0.0, 1.0]  # 0 of what cannot be drawn yet
    assert samples.actions.dtype == (th.int64 if kind is DQN else th.float32)
    assert kind is DQN or (samples.actions != samples.actions.round()).all()


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


@pytest.mark.parametrize("space", [BOTH, *BOTH.values(), spaces.Box(-1, 1, (4,))], ids=str)
def test_one_env_may_leave_out_the_axis_of_envs_as_with_sb3(space: spaces.Space) -> None:
    space.seed(0)
    bare, whole = (PrioritizedReplayBuffer(9, space, spaces.Discrete(3)) for _ in range(2))
    now, after = space.sample(), space.sample()
    batched: Any
    rest: Any = (np.array(1), 0.5, False, [{}])
    for given in ((now, after), (after, now)):
        bare.add(*given, *rest)
        batched = [{k: v[None] for k, v in o.items()} if space is BOTH else o[None] for o in given]
        whole.add(*batched, *rest)
    np.testing.assert_equal(bare.observations, whole.observations)
    assert bare.size() == 2


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
