"""Models on the hub: packaged, read by us and the zoo, refused where loading would run code."""

import inspect
import json
import shutil
import socket
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from safetensors.numpy import load, save
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_rainbow import Rainbow
from sb3_rainbow.zoo import hub
from sb3_rainbow.zoo.files import ZooError
from sb3_rainbow.zoo.model_file import write_statistics
from tests.sb3_rainbow.small import Toy
from tests.sb3_rainbow.zoo.crafted import CALL, rewritten, tampered
from tests.sb3_rainbow.zoo.runs import ENVS, SMALL, train, trained, workplace, zoo

__all__ = ["workplace"]
SETTINGS = {k: v for k, v in SMALL.items() if k not in ("policy", "n_timesteps", "learning_rate")}
MODEL = "rainbow-CartPole-v1.zip"


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any) -> None:
        raise AssertionError("a network call")

    monkeypatch.setattr(socket.socket, "connect", refuse)


def model_of(env: Any = "CartPole-v1", steps: int = 100, **settings: Any) -> Rainbow:
    given = {**SETTINGS, **settings}
    policy = given.pop("policy", "MlpPolicy")
    return Rainbow(policy, env, seed=0, device="cpu", **given).learn(steps)


def package(model: Rainbow, folder: str = "out", env_id: str = "CartPole-v1") -> Path:
    env: Any = model.get_env()
    return hub.package(model, env_id, folder, eval_env=env, command="", n_eval_episodes=1)


@pytest.fixture(scope="module")
def packaged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file that no test changes."""
    return package(model_of(steps=10), str(tmp_path_factory.mktemp("packaged")))


def small_images() -> FakeImageEnv:
    return FakeImageEnv(discrete=True, screen_height=36, screen_width=36, n_channels=1)


def counts() -> Toy:
    """Its spaces are of 32 bits."""
    env = Toy(spaces.MultiDiscrete([3, 4], dtype=np.int32), length=10)
    env.action_space = spaces.Discrete(2, dtype=np.int32)
    return env


def same_actions(a: Rainbow, b: Rainbow) -> bool:
    a.observation_space.seed(0)
    observations = [a.observation_space.sample() for _ in range(50)]
    actions = [[model.predict(o, deterministic=True)[0] for o in observations] for model in (a, b)]
    return actions[0] == actions[1]


def test_a_package_holds_model_card_and_results() -> None:
    from huggingface_hub import ModelCard

    model = model_of()
    env = make_vec_env("CartPole-v1", 2, seed=0)
    path = hub.package(model, "CartPole-v1", "out", eval_env=env, command="python -m train --me")
    assert path == Path("out") / MODEL
    results = json.loads(Path("out/results.json").read_text())
    card: Any = ModelCard.load("out/README.md")
    (evaluation,) = card.data.eval_results
    assert evaluation.metric_value == (
        f"{results['mean_reward']:.2f} +/- {results['std_reward']:.2f}"
    )
    assert evaluation.dataset_name == "CartPole-v1"
    assert card.data.model_name == "Rainbow"
    for part in ("python -m train --me", f"| {results['mean_reward']:.2f} |", "| PyTorch | 2."):
        assert part in card.text
    assert same_actions(model, hub.load(path, buffer_size=1))
    goes_on: Any = hub.load(path, env=env)
    assert goes_on.replay_buffer.buffer_size == 1000  # of 2 envs each
    assert zipfile.ZipFile(path).namelist() == ["settings.json", "arrays.safetensors"]


@pytest.mark.parametrize(
    ("env", "settings"),
    [
        ("CartPole-v1", {"learning_rate": LinearSchedule(1e-3, 1e-4, 0.5), "tau": 0.01}),
        ("CartPole-v1", {"train_freq": (2, "episode"), "distributional": "quantile"}),
        ("CartPole-v1", {"policy_kwargs": {"activation_fn": nn.Tanh, "noisy_layers": "head"}}),
        ("CartPole-v1", {"noisy": False, "exploration_final_eps": 0.2, "v_min": 0.0, "v_max": 9.0}),
        ("FrozenLake-v1", {"policy_kwargs": {"net_arch": {"shared": [8], "streams": [4]}}}),
        (small_images, {"policy": "CnnPolicy", "policy_kwargs": {"net_arch": {"streams": [8]}}}),
        (SimpleMultiObsEnv, {"policy": "MultiInputPolicy"}),
        (counts, {"stats_window_size": 7}),
    ],
)
@pytest.mark.filterwarnings("ignore:.*of the returns lie outside of the support")
def test_a_packaged_model_is_the_model(env: Any, settings: dict[str, Any]) -> None:
    vec_env = make_vec_env(env, seed=0)
    model = model_of(vec_env, 60, **settings)
    loaded = hub.load(package(model), env=vec_env, seed=1)
    assert same_actions(model, loaded)
    for name in ("observation_space", "action_space"):
        own, read = getattr(model, name), getattr(loaded, name)
        assert (own, own.dtype) == (read, read.dtype)
    assert type(loaded.policy) is type(model.policy)
    for name, weights in model.policy.state_dict().items():
        th.testing.assert_close(loaded.policy.state_dict()[name], weights, rtol=0, atol=0)
    left_out = ("env", "policy", "learning_rate", "buffer_size", "seed", "stats_window_size")
    for name in set(inspect.signature(Rainbow).parameters) - {*left_out, "_init_setup_model"}:
        assert getattr(loaded, name) == getattr(model, name), name
    assert loaded.lr_schedule(0.7) == model.lr_schedule(0.7)
    assert loaded._stats_window_size == settings.get("stats_window_size", 100)
    assert loaded.num_timesteps == model.num_timesteps > 0
    loaded.learn(50, reset_num_timesteps=False)


def test_settings_can_be_changed_but_not_what_the_weights_were_trained_for() -> None:
    path = package(model_of(v_min=0.0, v_max=100.0))
    assert hub.load(path, learning_rate=0.5, buffer_size=500).learning_rate == 0.5
    with pytest.raises(ZooError, match=r"support is \[0.0, 100.0\], the model's \[0.0, 7.0\]"):
        hub.load(path, v_max=7.0)


def test_a_head_that_is_left_to_the_default_is_the_one_of_the_arguments(packaged: Path) -> None:
    assert hub.load(packaged, v_min=None, v_max=None).distributional == "quantile"
    ranged = package(model_of(v_min=0.0, v_max=100.0), "ranged")
    assert hub.load(ranged, distributional=None).distributional == "categorical"
    with pytest.raises(ZooError, match="v_max without v_min"):
        hub.load(ranged, v_min=None)


def test_a_downloaded_model_is_enjoyed_and_trained_on(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    train("-n 200")
    path = package(model_of(), "hub/rainbow-CartPole-v1")
    monkeypatch.setattr("sb3_rainbow.zoo.hub.hf_hub_download", lambda *parts: "/".join(parts))
    assert same_actions(hub.load(path), hub.load_from_hub("hub/rainbow-CartPole-v1", MODEL))
    shutil.copy(path, "logs/rainbow/CartPole-v1_1/CartPole-v1.zip")
    zoo("enjoy --env CartPole-v1 --no-render -n 50")
    assert "Mean reward" in capsys.readouterr().out
    train(f"-n 100 -i {path}")
    assert trained(2).num_timesteps == 100


def test_the_evaluation_is_under_masks() -> None:
    """The environment raises where it is not."""
    package(model_of(f"{ENVS}:MaskedZoo-v0"), env_id="MaskedZoo-v0")
    assert "| MaskedZoo-v0 | 1 | 20.00 | 0.00 | greedy | yes |" in Path("out/README.md").read_text()
    model = hub.load("out/rainbow-MaskedZoo-v0.zip")
    with pytest.warns(UserWarning, match="mask"):
        model.predict(model.observation_space.sample())


class Swish(nn.Module):
    def forward(self, x: Any) -> Any:
        return x * x.sigmoid()


def test_what_only_a_pickle_could_hold_is_named() -> None:
    kwargs = {"net_arch": [8], "activation_fn": Swish}
    model = model_of(steps=10, policy_kwargs=kwargs, learning_rate=lambda progress: 1e-3)
    with pytest.raises(ZooError, match=r"learning_rate = <function .*activation_fn = .*Swish'>"):
        package(model)
    assert not Path("out", MODEL).exists()
    model.save("model.zip")
    with pytest.raises(ZooError, match="pass trust=True"):
        hub.load("model.zip")
    assert same_actions(model, hub.load("model.zip", trust=True))


def test_a_layer_of_ones_own_is_named() -> None:
    model = model_of(steps=10)
    model.q_net.layers[0] = nn.Linear(4, 16, bias=False)
    with pytest.raises(ZooError, match=r"q_net.layers.0.bias has shape None, the settings say"):
        package(model)


def test_what_a_pickle_calls_is_called_for_those_alone_who_trust_its_author() -> None:
    model_of(steps=10).save("model.zip")
    path = tampered(Path("model.zip"), Path("tampered.zip"), "anything")
    Path("bad.pkl").write_bytes(CALL)
    with pytest.raises(ZooError, match=r"tampered.zip cannot be loaded .* pass trust=True"):
        hub.load(path)
    with pytest.raises(ZooError, match=r"bad.pkl cannot be loaded"):
        hub.load_vec_normalize("bad.pkl", make_vec_env("CartPole-v1"))
    assert not Path("called").exists()
    hub.load(path, trust=True)
    assert Path("called").exists()


def forged(path: Path, where: str, name: str, value: Any) -> Path:
    """A packaged file with another setting, or another of its arrays."""

    def change(file: str, content: bytes) -> bytes:
        if file == "arrays.safetensors":
            return save(load(content) | ({name: value} if where == "arrays" else {}))
        settings = json.loads(content)
        settings.get(where, {})[name] = value
        return json.dumps(settings).encode()

    return rewritten(path, Path("forged.zip"), change)


BIAS = "policy.q_net.layers.0.bias"


@pytest.mark.parametrize(
    ("where", "name", "value", "message"),
    [
        ("arguments", "env", "os:path-v0", "unknown setting env"),
        ("arguments", "predict", 1, "unknown setting predict"),
        ("arguments", "gamma", "0.9", "gamma cannot be '0.9'"),
        ("arguments", "n_steps", 10**9, "n_steps cannot be 1000000000: at most 1000"),
        ("arguments", "replay_buffer_kwargs", {"n_steps": 10**8}, "n_steps cannot be 100000000"),
        ("arguments", "gamma", float("nan"), "NaN is no number"),
        ("arguments", "gamma", 1.5, r"gamma must lie in \[0, 1\]"),
        ("arguments", "policy", "os.mkdir", "policy cannot be 'os.mkdir'; known: RainbowPolicy"),
        ("arguments", "n_atoms", 10**12, r"the settings say \(3000000000000"),
        ("policy_kwargs", "net_arch", [10**9, 10**9], r"the settings say \(1000000000"),
        ("policy_kwargs", "activation_fn", "Swish", "activation_fn cannot be 'Swish'"),
        ("policy_kwargs", "__class__", "str", "unknown setting __class__"),
        ("counters", "num_timesteps", "1", "num_timesteps cannot be '1'"),
        ("counters", "predict", 1, "unknown setting predict"),
        ("action_space", "type", "Text", "action_space cannot be"),
        ("observation_space", "type", "Discrete", "observation_space cannot be"),
        ("arrays", BIAS, np.zeros(3, np.float32), r"bias has shape \(3,\), .* say \(16,\)"),
        ("arrays", "policy.another", np.zeros(3), r"another has shape \(3,\), .* say None"),
        ("arrays", "observation_space.low", np.zeros(3, np.float32), "low"),
    ],
)
def test_settings_are_held_against_their_types_and_arrays_against_the_network(
    where: str, name: str, value: Any, message: str, packaged: Path
) -> None:
    with pytest.raises(ZooError, match=rf"forged.zip cannot be loaded as Rainbow: .*{message}"):
        hub.load(forged(packaged, where, name, value))


def test_statistics_travel_along() -> None:
    env = VecNormalize(make_vec_env("CartPole-v1"), clip_obs=np.inf, clip_reward=np.float32(9.0))  # type: ignore[arg-type]
    package(model_of(env))
    assert env.training
    assert env.norm_reward
    loaded = hub.load_vec_normalize("out/vec_normalize.zip", make_vec_env("CartPole-v1"))
    observation = np.linspace(-9.0, 9.0, 4, dtype=np.float32)[None]
    np.testing.assert_array_equal(loaded.normalize_obs(observation), env.normalize_obs(observation))
    assert not loaded.training
    env.save("own.pkl")
    with pytest.raises(ZooError, match=r"own.pkl cannot be loaded"):
        hub.load_vec_normalize("own.pkl", make_vec_env("CartPole-v1"))
    loaded = hub.load_vec_normalize("own.pkl", make_vec_env("CartPole-v1"), trust=True)
    np.testing.assert_array_equal(loaded.normalize_obs(observation), env.normalize_obs(observation))
    with pytest.raises(ZooError, match=r"observations.*mean has shape \(4,\)"):
        hub.load_vec_normalize("out/vec_normalize.zip", make_vec_env("Acrobot-v1"))
    with pytest.raises(ZooError, match="its format is 'VecNormalize 1', expected 'Rainbow 1'"):
        hub.load("out/vec_normalize.zip")
    assert "load_vec_normalize" in Path("out/README.md").read_text()
    package(model_of())  # another model, without
    assert "load_vec_normalize" not in Path("out/README.md").read_text()
    assert not Path("out/vec_normalize.zip").exists()


def test_a_readme_of_something_else_stays() -> None:
    Path("own").mkdir()
    Path("own/README.md").write_text("# My project\n")
    with pytest.raises(ZooError, match="choose a folder"):
        package(model_of(), "own")
    assert [path.name for path in Path("own").iterdir()] == ["README.md"]


def test_statistics_of_a_dict_travel_along() -> None:
    env = VecNormalize(make_vec_env(SimpleMultiObsEnv), norm_obs_keys=["vec"], gamma=0.9)
    env.reset()
    for _ in range(20):
        env.step(np.array([0]))
    write_statistics(env, "statistics.zip")
    loaded = hub.load_vec_normalize("statistics.zip", make_vec_env(SimpleMultiObsEnv))
    rows: Any = env.observation_space.sample()
    wanted: Any = env.normalize_obs(rows)
    result: Any = loaded.normalize_obs(rows)
    for key in wanted:
        np.testing.assert_array_equal(result[key], wanted[key])


def test_files_that_are_no_model_of_rainbow(packaged: Path) -> None:
    DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu").save("dqn.zip")
    Path("text.zip").write_text("no archive")
    with zipfile.ZipFile("other.zip", "w") as archive:
        archive.writestr("readme", "nothing")
    rewritten(packaged, Path("small.zip"), compression=zipfile.ZIP_LZMA)
    version = "_stable_baselines3_version"
    rewritten(Path("dqn.zip"), Path("old.zip"), lambda name, x: b"9.9.9" if name == version else x)
    for name, trust, message in [
        ("dqn.zip", False, "it was not packaged"),
        ("text.zip", False, "not a zip file"),
        ("other.zip", False, "it was not packaged"),
        ("missing.zip", False, "No such file"),
        ("small.zip", False, "it is compressed"),
        ("dqn.zip", True, "was the file saved by another algorithm"),
        ("old.zip", True, r"\(saved by Stable-Baselines3 9\.9\.9, this is 2\."),
    ]:
        with pytest.raises(ZooError, match=rf"{name} cannot be loaded as Rainbow: .*{message}"):
            hub.load(name, trust=trust)
