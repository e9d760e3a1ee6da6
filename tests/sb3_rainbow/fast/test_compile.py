"""compile=True changes the speed and nothing else, and does without where it cannot."""

import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from torch import nn

from sb3_rainbow import MlpPolicy, Rainbow
from sb3_rainbow.network.rainbow_network import RainbowNetwork

FAST: dict[str, Any] = {
    "learning_starts": 20,
    "train_freq": 4,
    "buffer_size": 500,
    "batch_size": 8,
    "seed": 0,
    "policy_kwargs": {"net_arch": [16]},
    "compile": True,
    "cpu_kernels": False,
    "device": "cpu",
}


@pytest.fixture(autouse=True)
def _forget_graphs() -> None:
    """Torch compiles one function at most eight times in a process."""
    th.compiler.reset()


@pytest.mark.parametrize("at_once", [False, True], ids=["when called", "at once"])
def test_without_a_compiler_one_warning_and_the_same_run(monkeypatch: Any, at_once: bool) -> None:
    def call(*args: Any) -> Any:
        raise RuntimeError("no C++ compiler was found\nand a long trace")

    def broken(*args: Any, **kwargs: Any) -> Any:
        return call() if at_once else call

    plain = Rainbow("MlpPolicy", "CartPole-v1", **{**FAST, "compile": False}).learn(100)
    monkeypatch.setattr(th, "compile", broken)
    model = Rainbow("MlpPolicy", "CartPole-v1", **FAST)
    with pytest.warns(UserWarning, match="compile=True has no effect.*no C.. compiler") as seen:
        model.learn(100)
    assert len(seen) == 1
    for name, value in plain.policy.state_dict().items():
        assert th.equal(value, model.policy.state_dict()[name])


class Normalized(BaseFeaturesExtractor):
    """Its statistics change on the way, which no pure function can."""

    def __init__(self, observation_space: spaces.Space) -> None:
        super().__init__(observation_space, features_dim=4)
        self.norm = nn.BatchNorm1d(4)

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return self.norm(obs)


class Frozen(BaseFeaturesExtractor):
    """Trained before, and not to be trained any more."""

    def __init__(self, observation_space: spaces.Space) -> None:
        super().__init__(observation_space, features_dim=5)
        self.linear = nn.Linear(4, 5).requires_grad_(False)

    def forward(self, obs: th.Tensor) -> th.Tensor:
        return self.linear(obs)


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"distributional": False, "dueling": False, "double_q": False, "noisy": False},
        {"distributional": "quantile", "cpu_kernels": False},
        {"policy_kwargs": {"net_arch": {"shared": [16], "streams": [8]}}},
        {"policy_kwargs": {"net_arch": [16], "optimizer_class": th.optim.RMSprop}},
        {"policy_kwargs": {"net_arch": [16], "features_extractor_class": Normalized}},
        {"policy_kwargs": {"net_arch": [16], "features_extractor_class": Frozen}},
        {"max_grad_norm": 1e-3},
    ],
    ids=str,
)
def test_one_graph_of_loss_and_gradient_is_what_autograd_does(
    monkeypatch: Any, settings: dict[str, Any]
) -> None:
    """Whether all of it can be one graph, without the minutes of a real compiler."""
    compiled = th.compile
    monkeypatch.setattr(
        th, "compile", lambda f, **kwargs: compiled(f, backend="eager", fullgraph=True)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="compile=True has no effect")
        model = Rainbow("MlpPolicy", "CartPole-v1", **{**FAST, **settings}).learn(60)
    plain = Rainbow("MlpPolicy", "CartPole-v1", **{**FAST, **settings, "compile": False}).learn(60)
    for name, value in plain.policy.state_dict().items():
        np.testing.assert_allclose(model.policy.state_dict()[name], value, rtol=1e-4, atol=1e-6)


class Scene(gym.Env[Any, Any]):
    """Random observations of any space; every action is as good."""

    action_space = spaces.Discrete(3)

    def __init__(self, space: spaces.Space) -> None:
        self.observation_space = space
        space.seed(0)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        return self.observation_space.sample(), 1.0, bool(self.np_random.random() < 0.1), False, {}


IMAGE = spaces.Box(0, 255, (3, 36, 36), np.uint8)


@pytest.mark.parametrize(
    ("policy", "space"),
    [
        ("CnnPolicy", IMAGE),
        ("MlpPolicy", spaces.Discrete(7)),
        ("MlpPolicy", spaces.MultiDiscrete([3, 4])),
        ("MlpPolicy", spaces.MultiBinary(5)),
        ("MultiInputPolicy", spaces.Dict(image=IMAGE, place=spaces.Discrete(4))),
    ],
    ids=str,
)
def test_observations_are_prepared_outside_of_the_graph(
    monkeypatch: Any, policy: str, space: spaces.Space
) -> None:
    compiled, runs = th.compile, []

    def counted(f: Any, **kwargs: Any) -> Any:
        graph = compiled(f, backend="eager", fullgraph=True)

        def run(*args: Any) -> Any:
            runs.append(1)
            return graph(*args)

        return run

    monkeypatch.setattr(th, "compile", counted)
    models = []
    for compile_ in (True, False):
        settings = {**FAST, "compile": compile_, "policy_kwargs": {}, "buffer_size": 100}
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message="compile=True has no effect")
            models.append(Rainbow(policy, Scene(space), **settings).learn(40))
    assert len(runs) == models[0]._n_updates > 0
    assert "extract_features" not in vars(models[0].q_net)
    for name, value in models[1].policy.state_dict().items():
        np.testing.assert_allclose(models[0].policy.state_dict()[name], value, rtol=1e-4, atol=1e-6)


def test_who_prepares_observations_otherwise_is_heard_in_the_graph_too(monkeypatch: Any) -> None:
    compiled = th.compile
    monkeypatch.setattr(
        th, "compile", lambda f, **kwargs: compiled(f, backend="eager", fullgraph=True)
    )

    class Halved(RainbowNetwork):
        def extract_features(self, obs: Any, features_extractor: Any) -> th.Tensor:
            return features_extractor(obs.float() / 2.0)

    class Policy(MlpPolicy):
        def make_q_net(self) -> RainbowNetwork:
            arguments = self._update_features_extractor(self.net_args, features_extractor=None)
            return Halved(**arguments).to(self.device)

    models = []
    for compile_ in (True, False):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            warnings.filterwarnings("error", message="compile=True has no effect")
            settings = {**FAST, "compile": compile_}
            models.append(Rainbow(Policy, "CartPole-v1", **settings).learn(40))
    for name, value in models[1].policy.state_dict().items():
        np.testing.assert_allclose(models[0].policy.state_dict()[name], value, rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_compiled_losses_are_the_eager_ones(tmp_path: Any) -> None:
    with warnings.catch_warnings():
        # Inductor and its dependencies warn about things of their own.
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message="compile=True has no effect")
        model = Rainbow("MlpPolicy", "CartPole-v1", **FAST).learn(60)
        plain = Rainbow("MlpPolicy", "CartPole-v1", **{**FAST, "compile": False}).learn(60)
        model.save(tmp_path / "m")
    for name, value in plain.policy.state_dict().items():
        np.testing.assert_allclose(model.policy.state_dict()[name], value, rtol=1e-3, atol=1e-5)
    assert Rainbow.load(tmp_path / "m").compile is True
