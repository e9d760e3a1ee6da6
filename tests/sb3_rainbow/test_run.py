"""Rainbow runs in every combination that SB3's users expect of an off-policy algorithm."""

import inspect
import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import DiscretizeAction
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecNormalize

from sb3_rainbow import HESSEL, NoisyLinear, PrioritizedReplayBuffer, Rainbow
from tests.sb3_rainbow import small
from tests.sb3_rainbow.small import Toy, weights


def make(env: Any = "CartPole-v1", policy: str = "MlpPolicy", **settings: Any) -> Rainbow:
    return small.make(policy, env, **{"gradient_steps": 1, **settings})


def record(model: Rainbow, n_steps: int, folder: Path) -> dict[str, list[Any]]:
    """Every value that a training logs."""
    model.set_logger(configure(str(folder), ["json"]))
    model.learn(n_steps, log_interval=1)
    model.logger.close()
    rows = [json.loads(row) for row in (folder / "progress.json").read_text().splitlines()]
    return {name: [row[name] for row in rows if name in row] for name in set().union(*rows)}


def test_returns_beyond_the_support_are_told_once() -> None:
    narrow, message = make(v_min=0.0, v_max=1.5), r"outside of the support \[0.0, 1.5\].*quantile"
    with pytest.warns(UserWarning, match=message) as report:
        narrow.learn(900)
    assert len(report) == 1
    make().learn(100)  # a warning would be an error


def test_the_constructor_begins_with_dqns_arguments_in_their_order() -> None:
    dqn = list(inspect.signature(DQN.__init__).parameters)
    ours = list(inspect.signature(Rainbow.__init__).parameters)
    assert ours[: len(dqn) - 1] == dqn[:-1]
    assert ours[-1] == dqn[-1] == "_init_setup_model"
    dqn, ours = (list(inspect.signature(kind.learn).parameters) for kind in (DQN, Rainbow))
    assert ours == [*dqn, "use_masking"]


PAIR = spaces.Dict(a=spaces.Discrete(3), b=spaces.Box(0, 1))


@pytest.mark.parametrize(
    ("env", "policy"),
    [
        (Toy(spaces.MultiBinary(5), length=9, terminated=True), "MlpPolicy"),
        (Toy(spaces.MultiDiscrete([3, 4]), length=9), "MlpPolicy"),
        (Toy(spaces.Box(-1.0, 1.0, (2, 3), np.float64), length=9), "MlpPolicy"),
        (Toy(PAIR, length=9, terminated=True), "MultiInputPolicy"),
        ("CliffWalking-v1", "MlpPolicy"),
        (FakeImageEnv(screen_height=36, screen_width=36, n_channels=1), "CnnPolicy"),
        (SimpleMultiObsEnv(random_start=False), "MultiInputPolicy"),
    ],
)
def test_every_kind_of_observation(env: Any, policy: str) -> None:
    model = make(env, policy, policy_kwargs={}, buffer_size=100).learn(60)
    action, _ = model.predict(model.observation_space.sample(), deterministic=True)
    assert model.action_space.contains(action.item())


def test_vec_normalize() -> None:
    three: dict[str, Any] = {"wrapper_class": DiscretizeAction, "wrapper_kwargs": {"bins": 3}}
    env = VecNormalize(make_vec_env("Pendulum-v1", n_envs=2, **three))
    buffer: Any = make(env).learn(450).replay_buffer
    # Stored as the env gave them, normalized with today's statistics when drawn
    leaves = np.flatnonzero(buffer.tree.leaves)
    plain, normalized = buffer._get_samples(leaves), buffer._get_samples(leaves, env)
    obs: Any = np.asarray(plain.observations)
    np.testing.assert_allclose(obs[:, 0] ** 2 + obs[:, 1] ** 2, 1.0, rtol=1e-4)
    expected_obs: Any = env.normalize_obs(obs)
    np.testing.assert_allclose(np.asarray(normalized.observations), expected_obs, rtol=1e-5)
    one_step = [env.normalize_reward(r) for r in buffer.rewards.reshape(-1)]
    leaf = int(leaves[0])
    expected = sum(0.99**k * one_step[leaf + 2 * k] for k in range(3))
    assert normalized.rewards[0, 0].item() == pytest.approx(expected, rel=1e-5)
    # The terminal observation at the time limit is unnormalized too.
    terminal = np.asarray(plain.next_observations)
    np.testing.assert_allclose(terminal[:, 0] ** 2 + terminal[:, 1] ** 2, 1.0, rtol=1e-3)


def test_what_is_logged(tmp_path: Path) -> None:
    logged = record(make(learning_rate=lambda p: 1e-3 * p, distributional=True), 300, tmp_path)
    names = (
        "rollout/ep_rew_mean rollout/ep_len_mean rollout/exploration_rate time/fps "
        "time/total_timesteps train/n_updates train/loss train/learning_rate train/max_q "
        "train/clipped_support train/beta train/priority_spread train/noise_magnitude "
        "train/noise_magnitude_layer0 train/noise_magnitude_layer1"
    )
    assert set(names.split()) <= set(logged)
    assert all(np.isfinite(value) for values in logged.values() for value in values)
    assert logged["train/beta"][0] < 0.5 < logged["train/beta"][-1] <= 1.0
    assert logged["train/learning_rate"][0] > logged["train/learning_rate"][-1]
    assert 0 <= logged["train/clipped_support"][-1] <= 1


def test_beta_runs_linearly_from_start_to_end() -> None:
    model = make(beta_start=0.2, beta_end=0.8)
    result: list[float] = []

    def note(*_: Any) -> bool:
        result.append(model.beta)
        return True

    # The callback of step i + 1 sees the progress after step i.
    model.learn(100, callback=note)
    np.testing.assert_allclose(result, 0.2 + 0.6 * np.arange(100) / 100, atol=1e-9)
    model.gamma = 0.5  # so may gamma change
    model.learn(4, reset_num_timesteps=False)
    samples: Any = model.replay_buffer.sample(8)  # type: ignore[union-attr]
    assert set(samples.discounts.ravel().tolist()) <= {0.5, 0.25, 0.125}


@pytest.mark.parametrize("noisy", [True, False])
def test_epsilon_follows_sb3s_schedule_beside_the_noise_or_alone(
    tmp_path: Path, noisy: bool
) -> None:
    logged = record(make(noisy=noisy), 300, tmp_path)
    rates = logged["rollout/exploration_rate"]
    assert rates[0] > rates[-1] == 0.05
    assert ("train/noise_magnitude" in logged) == noisy
    model = make(noisy=noisy, exploration_initial_eps=1.0, exploration_final_eps=1.0).learn(40)
    obs = np.tile(np.zeros(4, np.float32), (400, 1))
    actions, _ = model.predict(obs)  # all by chance
    assert 120 < actions.sum() < 280
    assert len(set(model.predict(obs, deterministic=True)[0])) == 1
    off = make(noisy=noisy, exploration_initial_eps=0.0, exploration_final_eps=0.0)
    assert set(record(off, 300, tmp_path)["rollout/exploration_rate"]) == {0.0}


def test_actions_are_by_chance_until_learning_starts() -> None:
    env = Toy(spaces.Box(-1.0, 1.0, (1,)), lambda _: np.zeros(1, np.float32))
    off: Any = {"exploration_initial_eps": 0.0, "exploration_final_eps": 0.0}
    buffer: Any = make(env, noisy=False, learning_starts=50, **off).learn(50).replay_buffer
    assert 10 < buffer.actions[:50].sum() < 40


def test_hessel_et_als_settings_are_those_of_their_table() -> None:
    model = Rainbow("MlpPolicy", "CartPole-v1", buffer_size=1000, **HESSEL)
    assert model.q_net.head == "categorical"
    assert (model.n_atoms, model.v_min, model.v_max, model.n_steps) == (51, -10.0, 10.0, 3)
    assert (model.alpha, model.beta_start, model.tau) == (0.5, 0.4, 1.0)
    assert model.exploration_schedule(1.0) == model.exploration_schedule(0.0) == 0.0
    assert all(isinstance(layer, NoisyLinear) for layer in model.q_net.layers)
    assert {layer.sigma0 for layer in model.q_net.layers} == {0.5}
    assert model.policy.optimizer.param_groups[0]["eps"] == 1.5e-4
    schedule = make().lr_schedule
    assert [schedule(p) for p in (1.0, 0.5, 0.0)] == pytest.approx([1e-3, 5.5e-4, 1e-4])


def test_the_target_moves_at_every_update_or_at_an_interval() -> None:
    def distance(**kwargs: Any) -> float:
        model = make(**kwargs).learn(64)
        return float((weights(model.q_net) - weights(model.q_net_target)).norm())

    assert distance(tau=1.0) == 0.0
    assert distance(tau=0.0) > distance(tau=0.1) > 0.0
    # Steps 21 to 64 train; the copy at step 64 comes before that step's update.
    assert 0.0 < distance(tau=1.0, target_update_interval=64) < distance(tau=0.0)


def test_a_small_network_on_another_device_is_a_warning() -> None:
    with pytest.warns(UserWarning, match="slower on meta than on the CPU: pass device='cpu'"):
        Rainbow("MlpPolicy", "CartPole-v1", buffer_size=100, device="meta")
    images = FakeImageEnv(4, 40, 40, 1, discrete=True)
    Rainbow("CnnPolicy", images, buffer_size=100, device="meta")  # a warning would be an error


def test_more_envs_than_the_target_interval_is_a_warning() -> None:
    with pytest.warns(UserWarning, match=r"number of environments used is greater.*\(2 > 1\)"):
        make(make_vec_env("CartPole-v1", 2), target_update_interval=1)


def test_training_before_a_window_is_complete_waits() -> None:
    assert make(n_steps=5, learning_starts=0, train_freq=1).learn(12)._n_updates == 12 - 4


class Hearing(PrioritizedReplayBuffer):
    """A subclass that wants to know when the envs are reset."""

    heard = 0

    def truncate(self) -> None:
        self.heard += 1
        super().truncate()


def test_no_return_crosses_a_reset_that_cannot_be_seen_of_which_a_subclass_hears() -> None:
    env = Toy(spaces.Box(0, 1, (1,)), lambda step: np.zeros(1, np.float32), float)
    model = make(env, train_freq=1, gamma=1.0, n_steps=3, replay_buffer_class=Hearing).learn(15)
    buffer: Any = model.replay_buffer
    before = buffer.heard
    model.learn(15)
    returns = buffer._get_samples(np.arange(12, 16)).rewards.ravel().tolist()
    assert returns == [13 + 14 + 15, 14 + 15, 15, 1 + 2 + 3]
    model.learn(5, reset_num_timesteps=False)
    assert buffer.heard == before + 1
    # Cut there, not ended: the return goes on from where the episode stood.
    assert buffer.timeouts[:, 0].nonzero()[0].tolist() == [14]


def test_tensorboard_folder_is_called_rainbow(tmp_path: Any) -> None:
    pytest.importorskip("tensorboard")
    make(tensorboard_log=str(tmp_path)).learn(30)
    assert (tmp_path / "Rainbow_1").is_dir()


SHARES = ("alpha", "beta_end", "exploration_final_eps", "exploration_fraction")
NUMBERS = ("sigma0", "max_grad_norm", "n_atoms", "target_update_interval")
INTERVAL = "target_update_interval must be at least 1 and whole"


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"n_steps": 2.5}, "n_steps must be an integer, at least 1, got 2.5"),
        ({"max_grad_norm": -1.0}, "max_grad_norm must be positive, or None, got -1.0"),
        ({"batch_size": 8.0}, "batch_size must be an integer, at least 1, got 8.0"),
        ({"tau": "5e-3"}, "tau must lie in .0, 1., got '5e-3'"),  # YAML's, without a dot
        ({"sigma0": -0.1}, "sigma0 must be finite and not negative, got -0.1"),
        ({"sigma0": np.inf}, "sigma0 must be finite and not negative, got inf"),
        ({"beta_start": -0.5}, "beta_start must lie in .0, 1., got -0.5"),
        *(({name: 1.5}, f"{name} must lie in .0, 1., got 1.5") for name in SHARES),
        ({"replay_buffer_kwargs": {"beta": 0.9}}, "Pass beta_start and beta_end"),
        ({"v_min": 0.0}, "v_min without v_max: pass both"),
        ({"v_max": 9.0, "distributional": True}, "v_max without v_min: pass both"),
        ({"buffer_size": 3}, "buffer_size=3 is too small"),
        ({"buffer_size": 1e6}, "buffer_size must be an integer, at least 1, got 1000000.0"),
        ({"policy_kwargs": {"n_atoms": 11}}, "Pass n_atoms to Rainbow itself"),
        ({"prioritized": "False"}, "prioritized must be True, False or None, got 'False'"),
        ({"dueling": None}, "dueling must be True or False, got None"),
        ({"noisy": "yes"}, "noisy must be True or False, got 'yes'"),
        *(({name: "51"}, f"{name} must be a number, got '51'") for name in NUMBERS),
        ({"v_min": "a", "v_max": "b"}, "v_min must be a number, got 'a'"),
        *(({"target_update_interval": wrong}, INTERVAL) for wrong in (0, 10.5, np.inf)),
    ],
)
def test_bad_arguments(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


@pytest.mark.parametrize("cpu_kernels", [True, False])
def test_freezing_and_freeing_after_the_model_was_made(cpu_kernels: bool) -> None:
    model = make(cpu_kernels=cpu_kernels).learn(60)
    first, last = model.q_net.layers[-2:]
    for frozen in (True, False):
        first.requires_grad_(not frozen)
        before = weights(first), weights(last)
        model.learn(20, reset_num_timesteps=False)
        assert weights(first).equal(before[0]) == frozen
        assert not weights(last).equal(before[1])


@pytest.mark.parametrize("gradient_steps", [1, 7, -1])
def test_each_hundred_updates_are_looked_at(gradient_steps: int) -> None:
    """However many updates a round has: whole episodes of CartPole, here."""

    class Looking(Rainbow):
        def train(self, gradient_steps: int, batch_size: int = 100) -> None:
            before = self._n_updates
            super().train(gradient_steps, batch_size)
            if "train/max_q" in self.logger.name_to_value:
                looked.add(-(-before // 100))
                del self.logger.name_to_value["train/max_q"]

    looked: set[int] = set()
    freq: Any = (1, "episode") if gradient_steps < 0 else 4
    settings: Any = {**small.FAST, "train_freq": freq, "gradient_steps": gradient_steps}
    model = Looking("MlpPolicy", "CartPole-v1", **settings).learn(1_000)
    assert looked == {*range(-(-model._n_updates // 100))}


def test_an_observation_that_is_not_finite_is_named_as_a_cause() -> None:
    shown = [np.full(3, 0.5)] * 9 + [np.full(3, np.nan)] * 2
    with pytest.raises(ValueError, match="Or an observation is not finite"):
        make(Toy(spaces.Box(-1, 1, (3,)), shown.__getitem__, length=10)).learn(200)


def test_a_head_may_be_chosen_by_numpys_booleans() -> None:
    assert make(distributional=np.True_).q_net.head == "categorical"
    assert make(distributional=np.False_).q_net.head == "scalar"


def test_bad_environments() -> None:
    with pytest.raises(AssertionError, match=r"only supports .*Discrete"):
        Rainbow("MlpPolicy", "Pendulum-v1")
    with pytest.raises(ValueError, match="MultiInputPolicy"):
        Rainbow("MlpPolicy", SimpleMultiObsEnv())
    from_five = Toy(spaces.Box(0, 1, (1,)))
    from_five.action_space = spaces.Discrete(2, start=5)
    with pytest.raises(ValueError, match="start at 0, got start=5"):
        Rainbow("MlpPolicy", from_five)


def test_predict_takes_a_tuple_of_numbers_and_names_what_reset_returns() -> None:
    env = gym.make("CartPole-v1")
    model = make(env)
    assert model.predict((0.0, 0.0, 0.0, 0.0), deterministic=True)[0].shape == ()  # type: ignore[arg-type]
    assert model.predict(np.zeros((0, 4), np.float32))[0].shape == (0,)  # as SB3's DQN
    with pytest.raises(ValueError, match="got a tuple"):
        model.predict(env.reset())  # type: ignore[arg-type]
