"""Two runs with one seed agree, and a run cut in two goes on as if it had not been."""

import io
import pickle
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN, HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    VecCheckNan,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_rainbow import PrioritizedReplayBuffer, Rainbow
from sb3_rainbow.policies import MlpPolicy

FAST: dict[str, Any] = {
    "learning_rate": 1e-3,
    "learning_starts": 40,
    "train_freq": 2,
    "buffer_size": 300,
    "batch_size": 8,
    "policy_kwargs": {"net_arch": [16, 16]},
    "seed": 7,
}


class StatefulVecEnv(DummyVecEnv):
    """CartPoles that can tell and take their exact state, as a batched simulator can."""

    def get_state(self) -> bytes:
        return pickle.dumps((self.envs, self.buf_obs))

    def set_state(self, state: bytes) -> None:
        self.envs, self.buf_obs = pickle.loads(state)


def make_stateful(n_envs: int = 3) -> StatefulVecEnv:
    return StatefulVecEnv([lambda: gym.make("CartPole-v1") for _ in range(n_envs)])


def assert_same(a: BaseAlgorithm, b: BaseAlgorithm) -> None:
    """Networks, optimizer, counters and replay are identical to the last bit."""
    assert isinstance(a, Rainbow)
    assert isinstance(b, Rainbow)
    assert a.num_timesteps == b.num_timesteps
    assert a._n_updates == b._n_updates
    for name, value in a.policy.state_dict().items():
        assert th.equal(value, b.policy.state_dict()[name]), name
    states = (a.policy.optimizer.state_dict()["state"], b.policy.optimizer.state_dict()["state"])
    for x, y in zip(*(state.values() for state in states), strict=True):
        assert all(th.equal(x[key], y[key]) for key in x)
    x, y = a.replay_buffer, b.replay_buffer
    assert isinstance(x, PrioritizedReplayBuffer)
    assert isinstance(y, PrioritizedReplayBuffer)
    np.testing.assert_array_equal(x.observations, y.observations)
    np.testing.assert_array_equal(x.tree.leaves, y.tree.leaves)
    np.testing.assert_array_equal(x.rewards, y.rewards)


@pytest.mark.parametrize("noisy", [True, False])
@pytest.mark.parametrize("n_envs", [1, 3])
def test_two_runs_with_one_seed_are_identical(n_envs: int, noisy: bool) -> None:
    def run(seed: int) -> Rainbow:
        env = make_vec_env("CartPole-v1", n_envs=n_envs)
        model = Rainbow("MlpPolicy", env, noisy=noisy, **{**FAST, "seed": seed})
        return model.learn(360)

    assert_same(run(7), run(7))
    with pytest.raises(AssertionError):
        assert_same(run(7), run(8))


@pytest.mark.parametrize("noisy", [True, False])
def test_a_cut_run_equals_a_whole_one(tmp_path: Any, noisy: bool) -> None:
    # Annealing depends on a run's length: constant schedules make both runs comparable.
    settings = {**FAST, "noisy": noisy, "beta_end": 0.4, "exploration_final_eps": 1.0}
    whole = Rainbow("MlpPolicy", "CartPole-v1", **settings).learn(500)

    first = Rainbow("MlpPolicy", "CartPole-v1", **settings).learn(350)
    first.save(tmp_path / "model")
    first.save_replay_buffer(tmp_path / "buffer")
    env = first.get_env()
    del first
    set_random_seed(1)
    second = Rainbow.load(tmp_path / "model", env=env, force_reset=False)
    second.load_replay_buffer(tmp_path / "buffer")
    second.learn(150, reset_num_timesteps=False)
    assert_same(whole, second)


@pytest.mark.parametrize("way", ["load", "load_checkpoint", "set_random_seed"])
def test_a_new_seed_wins_over_the_saved_generators(tmp_path: Any, way: str) -> None:
    Rainbow("MlpPolicy", "CartPole-v1", **FAST).learn(60).save(tmp_path / "m")
    Rainbow("MlpPolicy", make_stateful(1), **FAST).learn(60).save_checkpoint(tmp_path / "c")

    def draw(seed: int | None) -> tuple[float, float, int]:
        """What the generators give once learning goes on."""
        set_random_seed(99)
        given: dict[str, Any] = {}
        if seed is not None and way != "set_random_seed":
            given["seed"] = seed
        if way == "load_checkpoint":
            model = Rainbow.load_checkpoint(tmp_path / "c", make_stateful(1), **given)
        else:
            model = Rainbow.load(tmp_path / "m", env=gym.make("CartPole-v1"), **given)
        if way == "set_random_seed":
            model.set_random_seed(seed)
        model.learn(1, reset_num_timesteps=False)
        return np.random.random(), float(th.rand(1)), int(model.action_space.sample())  # noqa: NPY002

    stored = draw(None)
    assert draw(None) == stored
    assert draw(1) == draw(1)
    # The seed of the first run is a new one too where it is given again.
    assert len({draw(seed)[:2] for seed in (None, 1, 2, 7)}) == 4


def test_a_loaded_model_that_is_saved_again_still_resumes(tmp_path: Any) -> None:
    settings = {**FAST, "beta_end": 0.4}
    whole = Rainbow("MlpPolicy", "CartPole-v1", **settings).learn(120)
    first = Rainbow("MlpPolicy", "CartPole-v1", **settings).learn(80)
    first.save(tmp_path / "m")
    first.save_replay_buffer(tmp_path / "b")
    env = first.get_env()
    set_random_seed(1)
    again = Rainbow.load(tmp_path / "m", env=env, force_reset=False)
    again.save(tmp_path / "m2")
    set_random_seed(2)
    second = Rainbow.load(tmp_path / "m2", env=env, force_reset=False)
    second.load_replay_buffer(tmp_path / "b")
    second.learn(40, reset_num_timesteps=False)
    assert_same(whole, second)


def test_a_checkpoint_in_the_middle_of_a_run_with_several_envs(tmp_path: Any) -> None:
    class Checkpoint(BaseCallback):
        """Writes one when a round of training is over, and goes on."""

        def _on_rollout_start(self) -> None:
            if self.num_timesteps == 360:
                assert isinstance(self.model, Rainbow)
                self.model.save_checkpoint(tmp_path / "run.ckpt")

        def _on_step(self) -> bool:
            return True

    def make_env() -> VecNormalize:
        return VecNormalize(VecMonitor(make_stateful()))

    settings = {**FAST, "learning_rate": lambda progress: 1e-3 * progress}
    whole = Rainbow("MlpPolicy", make_env(), **settings).learn(600, callback=Checkpoint())
    env = make_env()
    env.seed(99)
    env.reset()
    model = Rainbow.load_checkpoint(tmp_path / "run.ckpt", env)
    assert model.num_timesteps == 360
    assert [path.name for path in tmp_path.iterdir()] == ["run.ckpt"]
    model.learn(600 - model.num_timesteps, reset_num_timesteps=False)
    assert_same(whole, model)


class OwnNormalize(VecNormalize):
    """A subclass, as users write them."""


class Counting(VecEnvWrapper):
    """Keeps a state of which nobody knows."""

    steps = 0

    def reset(self) -> Any:
        return self.venv.reset()

    def step_wait(self) -> Any:
        self.steps += 1
        return self.venv.step_wait()


@pytest.mark.parametrize("wrap", [OwnNormalize, lambda env: VecFrameStack(env, 3)])
def test_a_checkpoint_holds_the_state_of_sb3s_wrappers(tmp_path: Any, wrap: Any) -> None:
    model = Rainbow("MlpPolicy", wrap(make_stateful()), **{**FAST, "beta_end": 0.4}).learn(240)
    model.save_checkpoint(tmp_path / "c")
    model.learn(120, reset_num_timesteps=False)
    resumed = Rainbow.load_checkpoint(tmp_path / "c", wrap(make_stateful()))
    assert_same(model, resumed.learn(120, reset_num_timesteps=False))


def test_a_checkpoint_holds_statistics_even_where_the_env_is_reset(tmp_path: Any) -> None:
    env = VecNormalize(make_vec_env("CartPole-v1"))
    model = Rainbow("MlpPolicy", env, **FAST)
    model.save_checkpoint(tmp_path / "before_the_first_step")
    model.learn(100).save_checkpoint(tmp_path / "c")
    fresh = VecNormalize(make_vec_env("CartPole-v1"))
    Rainbow.load_checkpoint(tmp_path / "c", fresh)
    obs = np.ones((1, 4))
    normalized = np.asarray(env.normalize_obs(obs))
    np.testing.assert_array_equal(fresh.normalize_obs(obs), normalized)
    assert not np.array_equal(normalized, obs)
    with pytest.raises(ValueError, match="wrap the env as at saving time"):
        Rainbow.load_checkpoint(tmp_path / "c", make_vec_env("CartPole-v1"))
    other = VecCheckNan(make_vec_env("CartPole-v1"))
    with pytest.raises(ValueError, match=r"obs_rms.* but VecCheckNan stands in its place"):
        Rainbow.load_checkpoint(tmp_path / "c", other)


def test_a_checkpoint_names_the_wrapper_whose_state_it_does_not_hold(tmp_path: Any) -> None:
    model = Rainbow("MlpPolicy", VecMonitor(Counting(make_stateful())), **FAST)
    with pytest.warns(UserWarning, match="Counting"):
        model.save_checkpoint(tmp_path / "c")


class GoalEnv(gym.Env):
    """The goal achieved is the number of the episode, so that a mixture of two would show."""

    def __init__(self, first_episode: int) -> None:
        box = spaces.Box(0, 1000, (1,), np.float32)
        parts = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = spaces.Dict(dict.fromkeys(parts, box))
        self.action_space = spaces.Discrete(2)
        self.episode = first_episode - 1

    def observation(self) -> dict[str, np.ndarray]:
        here = np.array([self.episode], np.float32)
        return {"observation": here, "achieved_goal": here, "desired_goal": here * 0}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.episode, self.time = self.episode + 1, 0
        return self.observation(), {}

    def step(self, action: int) -> Any:
        self.time += 1
        return self.observation(), 0.0, False, self.time == 10, {}

    def compute_reward(self, achieved: Any, desired: Any, info: Any) -> np.ndarray:
        return np.zeros(len(achieved), np.float32)


def test_hindsight_never_joins_the_episodes_before_and_after_a_checkpoint(tmp_path: Any) -> None:
    settings = {**FAST, "prioritized": False, "n_steps": 1, "replay_buffer_class": HerReplayBuffer}
    model = Rainbow("MultiInputPolicy", GoalEnv(first_episode=1), **settings)
    model.learn(45).save_checkpoint(tmp_path / "c")  # in the middle of an episode
    model = Rainbow.load_checkpoint(tmp_path / "c", GoalEnv(first_episode=100))
    model.learn(55, reset_num_timesteps=False)
    assert model.replay_buffer is not None
    drawn: Any = model.replay_buffer.sample(1000).observations
    episodes, goals = (drawn[key].numpy() for key in ("observation", "desired_goal"))
    assert {5.0, 100.0} <= set(goals.ravel().tolist())
    np.testing.assert_array_equal(goals[goals > 0], episodes[goals > 0])


def test_a_checkpoint_of_an_env_that_cannot_tell_its_state_resets_it(tmp_path: Any) -> None:
    Rainbow("MlpPolicy", "CartPole-v1", **FAST).learn(100).save_checkpoint(tmp_path / "c")
    model = Rainbow.load_checkpoint(tmp_path / "c", gym.make("CartPole-v1"))
    assert model.replay_buffer is not None
    assert model.replay_buffer.size() == 100
    model.learn(100, reset_num_timesteps=False)
    assert model.num_timesteps == 200


def test_files_that_are_no_checkpoint(tmp_path: Any) -> None:
    (tmp_path / "text").write_text("hello")
    env = gym.make("CartPole-v1")
    with pytest.raises(ValueError, match="is no checkpoint of Rainbow"):
        Rainbow.load_checkpoint(tmp_path / "text", env)
    Rainbow("MlpPolicy", env, **FAST).save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"written by save\(\)\? Then use load\(\)"):
        Rainbow.load_checkpoint(tmp_path / "model.zip", env)
    model = Rainbow("MlpPolicy", make_stateful(1), **FAST)
    model.save_checkpoint(tmp_path / "c")
    with pytest.raises(ValueError, match="no set_state"):
        Rainbow.load_checkpoint(tmp_path / "c", make_vec_env("CartPole-v1"))


def test_predictions_parameters_and_settings_survive(tmp_path: Any) -> None:
    model = Rainbow("MlpPolicy", "CartPole-v1", v_min=-3.0, n_steps=5, dueling=False, **FAST)
    model.learn(100)
    obs = np.random.default_rng(0).normal(size=(20, 4)).astype(np.float32)
    expected, _ = model.predict(obs, deterministic=True)
    model.save(tmp_path / "m")
    loaded = Rainbow.load(tmp_path / "m")
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], expected)
    assert (loaded.v_min, loaded.n_steps, loaded.dueling) == (-3.0, 5, False)
    assert loaded.q_net is loaded.policy.q_net
    assert set(loaded.get_parameters()) == {"policy", "policy.optimizer"}
    loaded.set_parameters(model.get_parameters())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="do not match"):
        loaded.set_parameters({}, exact_match=True)


def test_a_policy_alone_survives(tmp_path: Any) -> None:
    model = Rainbow("MlpPolicy", "CartPole-v1", distributional=False, **FAST)
    model.policy.save(str(tmp_path / "p"))
    policy = MlpPolicy.load(str(tmp_path / "p"))
    obs = np.zeros((3, 4), np.float32)
    expected = model.policy.predict(obs, deterministic=True)[0]
    np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], expected)


def test_loading_for_prediction_leaves_the_random_generators_alone() -> None:
    file = io.BytesIO()
    Rainbow("MlpPolicy", "CartPole-v1", **{**FAST, "seed": None}).save(file)
    file.seek(0)
    set_random_seed(5)
    expected = np.random.randint(1 << 30)  # noqa: NPY002
    set_random_seed(5)
    Rainbow.load(file).predict(np.zeros((1, 4), np.float32), deterministic=True)
    assert np.random.randint(1 << 30) == expected  # noqa: NPY002


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"n_atoms": 21}, "saved with other settings.*size mismatch"),
        ({"dueling": False}, "saved with other settings"),
        ({"noisy": False}, "saved with other settings"),
        ({"v_max": 50.0}, r"support is \[-100.0, 100.0\], the model's \[-100.0, 50.0\]"),
    ],
)
def test_a_model_of_other_settings(tmp_path: Any, other: dict[str, Any], message: str) -> None:
    Rainbow("MlpPolicy", "CartPole-v1", **FAST).save(tmp_path / "m")
    with pytest.raises(ValueError, match=f"(?s){message}"):
        Rainbow.load(tmp_path / "m", **other)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"n_steps": 2}, "filled with n_steps=3, the model has n_steps=2"),
        ({"gamma": 0.9}, "gamma=0.99"),
        ({"alpha": 0.5}, "alpha=0.6"),
        ({"prioritized": False}, "alpha"),
    ],
)
def test_a_replay_buffer_of_other_settings(
    tmp_path: Any, other: dict[str, Any], message: str
) -> None:
    Rainbow("MlpPolicy", "CartPole-v1", **FAST).learn(50).save_replay_buffer(tmp_path / "b")
    model = Rainbow("MlpPolicy", "CartPole-v1", **{**FAST, **other})
    present = model.replay_buffer
    with pytest.raises(ValueError, match=message):
        model.load_replay_buffer(tmp_path / "b.pkl")
    assert model.replay_buffer is present


def test_parameters_of_other_settings(tmp_path: Any) -> None:
    model = Rainbow("MlpPolicy", "CartPole-v1", **FAST)
    Rainbow("MlpPolicy", "CartPole-v1", v_max=50.0, **FAST).save(tmp_path / "m")
    with pytest.raises(ValueError, match=r"support is \[-100.0, 50.0\]"):
        model.set_parameters(str(tmp_path / "m"))
    # SB3 raises RuntimeError for tensors that do not fit, and its users catch that.
    parameters: Any = model.get_parameters()
    last = list(parameters["policy"])[-1]
    del parameters["policy"][last]
    with pytest.raises(RuntimeError, match=last):
        model.set_parameters(parameters)


def test_scalar_values_have_no_support_to_agree_on(tmp_path: Any) -> None:
    Rainbow("MlpPolicy", "CartPole-v1", distributional=False, **FAST).save(tmp_path / "m")
    Rainbow.load(tmp_path / "m", v_max=50.0)
    model = Rainbow("MlpPolicy", "CartPole-v1", distributional=False, v_max=50.0, **FAST)
    model.set_parameters(str(tmp_path / "m"))


def test_random_weights_leave_the_support_alone(tmp_path: Any) -> None:
    # As SB3's own tests of saving do
    model = Rainbow("MlpPolicy", "CartPole-v1", **FAST)
    state = {name: th.rand_like(tensor) for name, tensor in model.policy.state_dict().items()}
    model.policy.load_state_dict(state)
    model.save(tmp_path / "m")
    loaded = Rainbow.load(tmp_path / "m")
    assert loaded.q_net.support[[0, -1]].tolist() == [-100.0, 100.0]
    for name, tensor in loaded.policy.state_dict().items():
        assert th.equal(tensor, state[name])


def test_a_model_of_another_algorithm(tmp_path: Any) -> None:
    DQN("MlpPolicy", "CartPole-v1", buffer_size=100).save(tmp_path / "dqn")
    with pytest.raises(ValueError, match="saved by another algorithm"):
        Rainbow.load(tmp_path / "dqn")
