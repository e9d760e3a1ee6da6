"""Models on the hub: packaged, read by huggingface_sb3 and the zoo, refused where they run code."""

import base64
import io
import json
import os
import pickle
import shutil
import socket
import zipfile
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import yaml
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch import nn

from sb3_rainbow import Rainbow
from tests.sb3_rainbow.zoo.runs import ENVS, SMALL, train, workplace, zoo

__all__ = ["workplace"]
SETTINGS = {k: v for k, v in SMALL.items() if k not in ("policy", "n_timesteps", "learning_rate")}
ROOT = Path(__file__).resolve().parents[3]
MODEL = "rainbow-CartPole-v1.zip"


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*args: Any) -> None:
        raise AssertionError("a network call")

    monkeypatch.setattr(socket.socket, "connect", refuse)


@pytest.fixture
def downloads(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The hub's place is taken by the folder ``hub``; what was asked of it."""
    from requests.exceptions import HTTPError

    asked: list[str] = []

    def download(repo_id: str, filename: str, **kwargs: Any) -> str:
        asked.append(filename)
        path = Path("hub") / repo_id.partition("/")[2] / filename
        if not path.exists():
            raise HTTPError(f"404: {path}")
        return str(path)

    monkeypatch.setattr("huggingface_hub.hf_hub_download", download)
    monkeypatch.setattr("sb3_rainbow.zoo.hub.hf_hub_download", download)
    return asked


def model_of(env: Any = "CartPole-v1", steps: int = 100, **settings: Any) -> Rainbow:
    given = {**SETTINGS, **settings}
    return Rainbow("MlpPolicy", env, seed=0, device="cpu", **given).learn(steps)


def same_actions(a: Rainbow, b: Rainbow) -> bool:
    a.observation_space.seed(0)
    observations = np.stack([a.observation_space.sample() for _ in range(50)])
    actions = [model.predict(observations, deterministic=True)[0] for model in (a, b)]
    return bool((actions[0] == actions[1]).all())


def test_a_package_holds_model_card_and_results() -> None:
    from huggingface_hub import ModelCard

    from sb3_rainbow.zoo import hub

    model = model_of()
    env = make_vec_env("CartPole-v1", 2, seed=0)
    path = hub.package(model, "CartPole-v1", "out", eval_env=env, command="python -m train --me")
    assert path == Path("out") / MODEL
    results = json.loads(Path("out/results.json").read_text())
    card = ModelCard.load("out/README.md")
    assert card.data.eval_results is not None
    (evaluation,) = card.data.eval_results
    assert evaluation.metric_value == (
        f"{results['mean_reward']:.2f} +/- {results['std_reward']:.2f}"
    )
    assert evaluation.dataset_name == "CartPole-v1"
    assert card.data.model_name == "Rainbow"
    for part in ("python -m train --me", f"| {results['mean_reward']:.2f} |", "| PyTorch | 2."):
        assert part in card.text
    loaded = hub.load(path, buffer_size=1)
    assert same_actions(model, loaded)
    assert zipfile.ZipFile(path).testzip() is None
    assert "_rng_state" not in json.loads(zipfile.ZipFile(path).read("data"))


@pytest.mark.parametrize(
    "settings",
    [
        {"learning_rate": lambda: __import__("rl_zoo3").linear_schedule(1e-3)},
        {"train_freq": (2, "episode"), "distributional": "quantile"},
        {"policy_kwargs": {"activation_fn": nn.Tanh, "net_arch": {"streams": [8]}}},
    ],
)
def test_what_a_run_saves_can_be_loaded(settings: dict[str, Any]) -> None:
    """The zoo's own file of a run, generators and all."""
    from sb3_rainbow.zoo import hub

    given = {k: v() if k == "learning_rate" else v for k, v in settings.items()}
    model = model_of(**given)
    model.save("model.zip")
    loaded = hub.load("model.zip", env=gym.make("CartPole-v1"))
    assert same_actions(model, loaded)
    loaded.learn(50)


def test_the_papers_policies_can_be_loaded() -> None:
    from sb3_rainbow.zoo import hub

    stored = [*(ROOT / "results" / "cut" / "runs").glob("rainbow-optimized-*/policy.zip")]
    for path in stored:
        assert hub.load(path, buffer_size=1).action_space == spaces.Discrete(12)
    assert stored


def test_huggingface_sb3_and_the_zoo_read_it(
    downloads: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from huggingface_sb3 import EnvironmentName, load_from_hub
    from rl_zoo3.load_from_hub import download_from_hub

    from sb3_rainbow.zoo import hub

    train("-n 200")
    zoo("push --env CartPole-v1 --no-upload --n-eval-episodes 2 -n 20 --seed 1")
    assert Path("hub/rainbow-CartPole-v1/replay.mp4").stat().st_size > 0
    card = Path("hub/rainbow-CartPole-v1/README.md").read_text()
    assert "\npython " in card
    trained = Rainbow.load("logs/rainbow/CartPole-v1_1/CartPole-v1.zip")
    assert same_actions(trained, hub.load_from_hub("me/rainbow-CartPole-v1", MODEL))
    monkeypatch.setenv("TRUST_REMOTE_CODE", "True")
    assert same_actions(trained, Rainbow.load(load_from_hub("me/rainbow-CartPole-v1", MODEL)))
    download_from_hub("rainbow", EnvironmentName("CartPole-v1"), 0, "downloaded", "me")
    zoo("enjoy --env CartPole-v1 -f downloaded --no-render -n 50")
    assert "Mean reward" in capsys.readouterr().out
    assert {MODEL, "config.yml", "args.yml", "env_kwargs.yml"} <= set(downloads)


def test_it_is_evaluated_under_masks_and_uploaded(monkeypatch: pytest.MonkeyPatch) -> None:
    uploaded: dict[str, Any] = {}

    class Api:
        def __init__(self, token: str | None) -> None: ...

        def create_repo(self, repo_id: str, exist_ok: bool) -> str:
            return f"https://huggingface.co/{repo_id}"

        def upload_folder(self, **given: Any) -> None:
            uploaded.update(given)

    monkeypatch.setattr("sb3_rainbow.zoo.hub.HfApi", Api)
    train(f"--env MaskedZoo-v0 --gym-packages {ENVS} -n 100")
    push = f"push --env MaskedZoo-v0 --gym-packages {ENVS} --n-eval-episodes 2 -n 20 -o out"
    with pytest.raises(SystemExit, match="--organization says where to upload"):
        zoo(push)
    zoo(f"{push} -orga me -m first")
    assert uploaded == {
        "repo_id": "me/rainbow-MaskedZoo-v0",
        "folder_path": Path("out"),
        "commit_message": "first",
    }
    assert json.loads(Path("out/results.json").read_text())["mean_reward"] == 20.0
    assert yaml.safe_load(Path("out/env_kwargs.yml").read_text()) == {}


class Payload:
    """A pickle that runs a command."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("pwned",)


class Swish(nn.Module):
    def forward(self, x: Any) -> Any:
        return x * x.sigmoid()


def tampered(**settings: Any) -> str:
    """A model's file with other settings; what is no JSON is pickled, as SB3 does."""
    model_of(steps=10).save("model.zip")
    with zipfile.ZipFile("model.zip") as old, zipfile.ZipFile("tampered.zip", "w") as new:
        data = json.loads(old.read("data"))
        for name, value in settings.items():
            pickled = base64.b64encode(pickle.dumps(value)).decode()
            plain = isinstance(value, str | int | None)
            data[name] = value if plain else {":type:": "?", ":serialized:": pickled}
        for name in old.namelist():
            new.writestr(name, json.dumps(data) if name == "data" else old.read(name))
    return "tampered.zip"


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"policy_kwargs": {"net_arch": [8], "x": Payload()}}, r"it wants to run posix\.mkdir"),
        ({"anything": Payload()}, r"it wants to run posix\.mkdir"),
        ({"policy_kwargs": {"activation_fn": Swish}}, r"test_hub\.Swish.* trusted=\["),
        ({"policy_class": DQN}, r"stable_baselines3\.dqn\.dqn\.DQN"),
        ({"env": "os:path-v0"}, "it wants to set env"),
        ({"predict": 1}, "it wants to set predict"),
    ],
)
def test_code_that_is_not_known_is_refused(settings: dict[str, Any], said: str) -> None:
    from sb3_rainbow.zoo import hub
    from sb3_rainbow.zoo.files import ZooError

    with pytest.raises(ZooError, match=rf"tampered.zip cannot be loaded as Rainbow: .*{said}"):
        hub.load(tampered(**settings))
    assert not Path("pwned").exists()


def test_the_same_file_runs_its_code_in_sb3s_own_load() -> None:
    """What the check is there for."""
    Rainbow.load(tampered(anything=Payload()))
    assert Path("pwned").exists()


class Attribute:
    """Pickled as Python 3.11.2 pickles an enumeration's member."""

    def __init__(self, of: Any, name: str) -> None:
        self.reduced = getattr, (of, name)

    def __reduce__(self) -> Any:
        return self.reduced


def test_members_of_enumerations_as_older_pythons_pickle_them() -> None:
    from sb3_rainbow.zoo.unpickling import UnknownCodeError, unpickle

    member = pickle.dumps(Attribute(TrainFrequencyUnit, "STEP"))
    assert unpickle(member) is TrainFrequencyUnit.STEP
    for of, name in ((TrainFrequencyUnit, "mro"), (np.ndarray, "tofile"), (np.dtype("f4"), "str")):
        with pytest.raises(UnknownCodeError, match=f"getattr for '{name}' of"):
            unpickle(pickle.dumps(Attribute(of, name)))


def test_a_dotted_name_does_not_lead_out_of_a_known_module() -> None:
    from sb3_rainbow.zoo.unpickling import UnknownCodeError, unpickle

    def named(module: str, name: str) -> bytes:
        texts = b"".join(b"\x8c" + bytes([len(x)]) + x.encode() for x in (module, name))
        return b"\x80\x04" + texts + b"\x93."

    assert unpickle(named("numpy", "ndarray")) is np.ndarray
    for module, name in [
        ("sb3_rainbow.policies", "nn.Module"),
        ("numpy", "f2py"),
        ("builtins", "getattr"),
        ("torch.storage", "_load_from_bytes"),
    ]:
        with pytest.raises(UnknownCodeError, match=name):
            unpickle(named(module, name))


def test_a_class_of_ones_own_can_be_trusted() -> None:
    from sb3_rainbow.zoo import hub

    kwargs = {"net_arch": [8], "activation_fn": Swish}
    model = model_of(steps=10, policy_kwargs=kwargs)
    model.save("model.zip")
    assert same_actions(model, hub.load("model.zip", trusted=[f"{__name__}.Swish"]))


def test_statistics_travel_along() -> None:
    from sb3_rainbow.zoo import hub
    from sb3_rainbow.zoo.files import ZooError

    env = VecNormalize(make_vec_env("CartPole-v1"))
    model = model_of(env)
    hub.package(model, "CartPole-v1", "out", eval_env=env, command="", n_eval_episodes=1)
    fresh = DummyVecEnv([lambda: gym.make("CartPole-v1")])
    loaded = hub.load_vec_normalize("out/vec_normalize.pkl", fresh)
    observation = np.ones((1, 4), np.float32)
    np.testing.assert_array_equal(loaded.normalize_obs(observation), env.normalize_obs(observation))
    assert not loaded.training
    Path("bad.pkl").write_bytes(pickle.dumps(Payload()))
    with pytest.raises(ZooError, match=r"bad.pkl .* posix\.mkdir"):
        hub.load_vec_normalize("bad.pkl", fresh)
    assert not Path("pwned").exists()


def test_files_that_are_no_model_of_rainbow() -> None:
    from sb3_rainbow.zoo import hub
    from sb3_rainbow.zoo.files import ZooError

    DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu").save("dqn.zip")
    Path("text.zip").write_text("no archive")
    with zipfile.ZipFile("other.zip", "w") as archive:
        archive.writestr("readme", "nothing")
    for name, said in [
        ("dqn.zip", r"stable_baselines3\.dqn\.policies\.DQNPolicy"),
        ("text.zip", "not a zip file"),
        ("other.zip", "no item named 'data'"),
        ("missing.zip", "No such file"),
    ]:
        with pytest.raises(ZooError, match=rf"{name} cannot be loaded as Rainbow: .*{said}"):
            hub.load(name)


def test_a_file_of_another_version_says_so() -> None:
    from sb3_rainbow.zoo import hub
    from sb3_rainbow.zoo.files import ZooError

    shutil.copy(tampered(policy_class=DQN), "old.zip")
    content = io.BytesIO()
    with zipfile.ZipFile("old.zip") as old, zipfile.ZipFile(content, "w") as new:
        for name in old.namelist():
            new.writestr(name, "9.9.9" if name == "_stable_baselines3_version" else old.read(name))
    Path("old.zip").write_bytes(content.getvalue())
    with pytest.raises(ZooError, match=r"\(saved by Stable-Baselines3 9\.9\.9, this is 2\."):
        hub.load("old.zip")
