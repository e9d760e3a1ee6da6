"""What a file of a model brings back, and what it must agree with."""

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.utils import set_random_seed

from sb3_rainbow import Rainbow
from sb3_rainbow.policies import MlpPolicy
from tests.sb3_rainbow.resume.runs import make
from tests.sb3_rainbow.zoo.crafted import tampered


def test_a_policy_alone_survives(tmp_path: Any) -> None:
    model = make(distributional=False)
    model.policy.save(str(tmp_path / "p"))
    policy = MlpPolicy.load(str(tmp_path / "p"))
    obs = np.zeros((3, 4), np.float32)
    expected = model.policy.predict(obs, deterministic=True)[0]
    np.testing.assert_array_equal(policy.predict(obs, deterministic=True)[0], expected)


def test_loading_for_prediction_leaves_the_random_generators_alone() -> None:
    file = io.BytesIO()
    make(seed=None).save(file)
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
        ({"distributional": "quantile"}, r"support is \[-100.0, 100.0\], the model's none"),
    ],
)
def test_a_model_of_other_settings(tmp_path: Any, other: dict[str, Any], message: str) -> None:
    make(distributional=True).save(tmp_path / "m")
    with pytest.raises(ValueError, match=f"(?s){message}"):
        Rainbow.load(tmp_path / "m", **other)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"n_steps": 2}, "filled with n_steps=3, the model has n_steps=2"),
        ({"alpha": 0.5}, "alpha=0.6"),
        ({"prioritized": False}, "alpha"),
    ],
)
def test_a_replay_buffer_of_other_settings(
    tmp_path: Any, other: dict[str, Any], message: str
) -> None:
    make().learn(50).save_replay_buffer(tmp_path / "b")
    model = make(**other)
    present = model.replay_buffer
    with pytest.raises(ValueError, match=message):
        model.load_replay_buffer(tmp_path / "b.pkl")
    assert model.replay_buffer is present


@pytest.mark.parametrize(
    ("given", "head"),
    [
        ({}, ("quantile", -100.0, 100.0)),
        ({"v_min": 0.0, "v_max": 50.0}, ("categorical", 0.0, 50.0)),
        ({"distributional": True}, (True, -100.0, 100.0)),
        ({"distributional": False, "v_max": 50.0}, (False, -100.0, 50.0)),
        ({"distributional": "quantile", "v_min": 0.0}, ("quantile", 0.0, 100.0)),
    ],
)
def test_a_support_asks_for_the_categorical_head(
    tmp_path: Any, given: dict[str, Any], head: tuple[Any, ...]
) -> None:
    model = make(**given)
    assert (model.distributional, model.v_min, model.v_max) == head
    assert model.q_net.distributional == head[0]
    model.save(tmp_path / "m")
    loaded = Rainbow.load(tmp_path / "m")
    assert (loaded.distributional, loaded.v_min, loaded.v_max) == head


def test_parameters_of_other_settings(tmp_path: Any) -> None:
    model = make(v_min=np.float32(0.0), v_max=np.int64(100))
    model.save(tmp_path / "own")
    model.set_parameters(str(tmp_path / "own"))  # a support of numpy's numbers is the file's
    make(v_min=0.0, v_max=50.0).save(tmp_path / "m")
    with pytest.raises(ValueError, match=r"support is \[0.0, 50.0\]"):
        model.set_parameters(str(tmp_path / "m"))
    # SB3 raises RuntimeError for tensors that do not fit, and its users catch that.
    parameters: Any = model.get_parameters()
    assert set(parameters) == {"policy", "policy.optimizer"}
    model.set_parameters(parameters)
    last = list(parameters["policy"])[-1]
    del parameters["policy"][last]
    with pytest.raises(RuntimeError, match=last):
        model.set_parameters(parameters)


def test_a_gpu_is_left_alone_by_a_model_on_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a process that was forked from one which used it."""
    model = make()

    def fail() -> None:
        raise RuntimeError("Cannot re-initialize CUDA in forked subprocess")

    monkeypatch.setattr(th.cuda, "is_available", lambda: True)
    monkeypatch.setattr(th.cuda, "get_rng_state_all", fail)
    model.save(io.BytesIO())


@pytest.mark.parametrize(("n_envs", "n_steps"), [(1, 3), (3, 3), (1, 5)])
def test_who_only_predicts_needs_no_replay_buffer(tmp_path: Any, n_envs: int, n_steps: int) -> None:
    # As RL Zoo's enjoy.py loads what it shows
    env = make_vec_env("CartPole-v1", n_envs=n_envs)
    made = make(env, replay_buffer_kwargs={"n_steps": n_steps})
    made.save(tmp_path / "m")
    obs = np.random.default_rng(0).normal(size=(n_envs, 4)).astype(np.float32)
    expected, _ = made.predict(obs, deterministic=True)
    for given in (None, env):
        loaded: Any = Rainbow.load(tmp_path / "m", env=given, buffer_size=1, seed=0)
        np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], expected)
        assert loaded.replay_buffer.buffer_size == n_steps + 1  # a window and what it leads to
    loaded.learn(60)


@pytest.mark.parametrize(
    ("made", "loaded", "tau"),
    [
        ({}, {}, 5e-3),
        ({}, {"target_update_interval": 100}, 1.0),
        ({}, {"target_update_interval": 100, "tau": 1e-3}, 1e-3),
        ({}, {"tau": 0.2}, 0.2),
        ({"target_update_interval": 100}, {}, 1.0),
        ({"target_update_interval": 100}, {"target_update_interval": None}, 5e-3),
        ({"target_update_interval": 100}, {"target_update_interval": None, "tau": 1.0}, 1.0),
        ({"tau": 0.005}, {"target_update_interval": 100}, 0.005),
        ({}, {"custom_objects": {"target_update_interval": 100}}, 1.0),
    ],
)
def test_a_new_target_interval_brings_its_tau(
    tmp_path: Any, made: dict[str, Any], loaded: dict[str, Any], tau: float
) -> None:
    make(**made).save(tmp_path / "m")
    model = Rainbow.load(tmp_path / "m", **loaded)
    assert model.tau == tau
    given = {**made, **loaded, **loaded.get("custom_objects", {})}
    assert model.target_update_interval == given.get("target_update_interval")
    # What was chosen at loading stays chosen.
    model.save(tmp_path / "again")
    assert Rainbow.load(tmp_path / "again").tau == tau


@pytest.mark.filterwarnings("ignore:`n_steps=3` is ignored")  # SB3 looks at the buffer first
def test_files_of_another_algorithm(tmp_path: Any) -> None:
    make().save(tmp_path / "m")
    with pytest.raises(ValueError, match=r"loaded by Rainbow\.load"):
        DQN.load(tmp_path / "m")
    DQN("MlpPolicy", "CartPole-v1", buffer_size=100).save(tmp_path / "dqn")
    with pytest.raises(ValueError, match="saved by another algorithm"):
        Rainbow.load(tmp_path / "dqn")
    (tmp_path / "text.zip").write_text("no model")
    with pytest.raises(ValueError, match="wasn't a zip-file"):  # SB3's own
        make().set_parameters(str(tmp_path / "text.zip"))


def test_parameters_are_read_without_running_what_is_stored_beside_them(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    model: Any = make()
    model.save("model")
    path = tampered(tmp_path / "model.zip", tmp_path / "tampered.zip", "anything")
    model.set_parameters(str(path))
    with path.open("rb") as file:
        model.set_parameters(file)
    assert not Path("called").exists()
