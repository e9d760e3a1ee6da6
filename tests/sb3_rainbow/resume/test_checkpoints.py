"""Two runs with one seed agree, and a run cut in two goes on as if it had not been."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.utils import set_random_seed
from stable_baselines3.common.vec_env import (
    VecCheckNan,
    VecEnvWrapper,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
)

from sb3_rainbow import Rainbow
from tests.sb3_rainbow.resume.runs import assert_same, make, make_stateful


@pytest.mark.parametrize(("n_envs", "noisy"), [(1, False), (3, True)])
def test_two_runs_with_one_seed_are_identical(n_envs: int, noisy: bool) -> None:
    def run(seed: int) -> Rainbow:
        return make(make_vec_env("CartPole-v1", n_envs), noisy=noisy, seed=seed).learn(360)

    assert_same(run(7), run(7))
    with pytest.raises(AssertionError):
        assert_same(run(7), run(8))


@pytest.mark.parametrize(("noisy", "again"), [(True, False), (False, False), (True, True)])
def test_a_cut_run_equals_a_whole_one(tmp_path: Any, noisy: bool, again: bool) -> None:
    """Also where the loaded model is saved again before it goes on."""
    # Annealing depends on a run's length: constant schedules make both runs comparable.
    constant: Any = {"learning_rate": 1e-3, "beta_end": 0.4, "exploration_final_eps": 1.0}
    whole = make(noisy=noisy, **constant).learn(500)

    first = make(noisy=noisy, **constant).learn(350)
    first.save(tmp_path / "model")
    first.save_replay_buffer(tmp_path / "buffer")
    env = first.get_env()
    del first
    for seed in range(1 + again):
        set_random_seed(seed)
        second = Rainbow.load(tmp_path / "model", env=env, force_reset=False)
        if again:
            second.save(tmp_path / "model")
    second.load_replay_buffer(tmp_path / "buffer")
    second.learn(150, reset_num_timesteps=False)
    assert_same(whole, second)


@pytest.mark.parametrize("way", ["load", "custom_objects", "load_checkpoint", "set_random_seed"])
def test_a_new_seed_wins_over_the_saved_generators(tmp_path: Any, way: str) -> None:
    make().learn(60).save(tmp_path / "m")
    make(make_stateful(1)).learn(60).save_checkpoint(tmp_path / "c")

    def draw(seed: int | None) -> tuple[float, float, int]:
        """What the generators give once learning goes on."""
        set_random_seed(99)
        given: Any = {} if seed is None or way == "set_random_seed" else {"seed": seed}
        if way == "custom_objects":
            given = {"custom_objects": given}
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


class OwnNormalize(VecNormalize):
    """A subclass, as users write them."""


@pytest.mark.parametrize(
    "wrap", [lambda env: OwnNormalize(VecMonitor(env)), lambda env: VecFrameStack(env, 3)]
)
def test_a_checkpoint_in_the_middle_of_a_run_with_several_envs(tmp_path: Any, wrap: Any) -> None:
    """It holds the state of SB3's wrappers too."""

    class Checkpoint(BaseCallback):
        """Writes one when a round of training is over, and goes on."""

        def _on_rollout_start(self) -> None:
            if self.num_timesteps == 360:
                model.save_checkpoint(tmp_path / "run.ckpt")

        def _on_step(self) -> bool:
            return True

    model = make(wrap(make_stateful()), learning_rate=lambda progress: 1e-3 * progress)
    whole = model.learn(600, callback=Checkpoint())
    env = wrap(make_stateful())
    env.seed(99)
    env.reset()
    loaded = Rainbow.load_checkpoint(tmp_path / "run.ckpt", env)
    assert loaded.num_timesteps == 360
    assert [path.name for path in tmp_path.iterdir()] == ["run.ckpt"]
    assert_same(whole, loaded.learn(240, reset_num_timesteps=False))


def test_a_checkpoint_holds_statistics_even_where_the_env_is_reset(tmp_path: Any) -> None:
    env = VecNormalize(make_vec_env("CartPole-v1"))
    model = make(env)
    model.save_checkpoint(tmp_path / "before_the_first_step")
    model.learn(60).save_checkpoint(tmp_path / "c")
    fresh = VecNormalize(make_vec_env("CartPole-v1"))
    Rainbow.load_checkpoint(tmp_path / "c", fresh)
    obs = np.ones((1, 4))
    normalized = np.asarray(env.normalize_obs(obs))
    np.testing.assert_array_equal(fresh.normalize_obs(obs), normalized)
    assert not np.array_equal(normalized, obs)
    with pytest.raises(ValueError, match="wrap the env as at saving time"):
        Rainbow.load_checkpoint(tmp_path / "c", make_vec_env("CartPole-v1"))
    with pytest.raises(ValueError, match=r"obs_rms.* but VecCheckNan stands in its place"):
        Rainbow.load_checkpoint(tmp_path / "c", VecCheckNan(make_vec_env("CartPole-v1")))


def test_a_checkpoint_names_the_wrapper_whose_state_it_does_not_hold(tmp_path: Any) -> None:
    class Counting(VecEnvWrapper):
        steps = 0

        def reset(self) -> Any:
            return self.venv.reset()

        def step_wait(self) -> Any:
            self.steps += 1
            return self.venv.step_wait()

    model = make(VecMonitor(Counting(make_stateful())))
    with pytest.warns(UserWarning, match="Counting"):
        model.save_checkpoint(tmp_path / "c")


def test_hindsight_never_joins_the_episodes_before_and_after_a_checkpoint(tmp_path: Any) -> None:
    settings: Any = {"prioritized": False, "n_steps": 1, "replay_buffer_class": HerReplayBuffer}
    env = BitFlippingEnv(n_bits=10, continuous=False)  # of ten steps, unless it is solved
    model: Any = make(env, "MultiInputPolicy", **settings)
    model.learn(46).save_checkpoint(tmp_path / "c")
    assert not model.replay_buffer.ep_length[40:46].any()  # an episode that runs
    model = Rainbow.load_checkpoint(tmp_path / "c", env)
    assert (model.replay_buffer.ep_length[40:46] == 6).all()
    assert model.learn(54, reset_num_timesteps=False).replay_buffer.ep_start[46] == 46


def test_files_that_are_no_checkpoint(tmp_path: Any) -> None:
    (tmp_path / "text").write_text("hello")
    env = gym.make("CartPole-v1")
    with pytest.raises(ValueError, match="is no checkpoint of Rainbow"):
        Rainbow.load_checkpoint(tmp_path / "text", env)
    make(env).save(tmp_path / "model.zip")
    with pytest.raises(ValueError, match=r"written by save\(\)\? Then use load\(\)"):
        Rainbow.load_checkpoint(tmp_path / "model.zip", env)
    make(make_stateful(1)).save_checkpoint(tmp_path / "c")
    with pytest.raises(ValueError, match="no set_state"):
        Rainbow.load_checkpoint(tmp_path / "c", make_vec_env("CartPole-v1"))


def test_a_checkpoint_refuses_a_new_normalization_but_not_a_new_gamma(tmp_path: Any) -> None:
    path = tmp_path / "run.ckpt"
    model = make(make_vec_env("CartPole-v1")).learn(60)
    model.save_checkpoint(path)
    with pytest.raises(ValueError, match=r"nothing of VecNormalize.*wrap the env as"):
        Rainbow.load_checkpoint(path, VecNormalize(make_vec_env("CartPole-v1")))
    with pytest.raises(ValueError, match="buffer in the checkpoint was filled with n_steps=3"):
        Rainbow.load_checkpoint(path, make_vec_env("CartPole-v1"), n_steps=2)
    other: Any = Rainbow.load_checkpoint(path, make_vec_env("CartPole-v1"), gamma=0.9)
    assert other.learn(20, reset_num_timesteps=False).replay_buffer.gamma == 0.9
    with pytest.raises(ValueError, match=r"run\.ckpt is a checkpoint: use load_checkpoint"):
        Rainbow.load(path)
    with pytest.raises(ValueError, match="is a checkpoint"):
        model.set_parameters(str(path), exact_match=False)
