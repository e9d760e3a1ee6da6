"""Layers, heads and noise of a user's own take part as they would in SB3."""

import copy
import io
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.envs import FakeImageEnv
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_rainbow import MlpPolicy, NoisyLinear, Rainbow
from sb3_rainbow.learner.learner import as_batch
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from tests.sb3_rainbow import small
from tests.sb3_rainbow.small import extracting, policy_of, weights


def make(policy: Any = "MlpPolicy", env: Any = "CartPole-v1", **kwargs: Any) -> Rainbow:
    return small.make(policy, env, **{"train_freq": 1, "policy_kwargs": {}, **kwargs})


def replace_layer(model: Rainbow, index: int, build: Callable[[], nn.Module]) -> None:
    """In both networks, of which the target does not learn."""
    for net in (model.q_net, model.q_net_target):
        net.layers[index] = build()
    model.q_net_target.requires_grad_(False)


def test_an_optimizer_keeps_what_is_not_the_networks() -> None:
    model = make()
    aux = nn.Parameter(th.zeros(1))
    model.policy.optimizer.add_param_group({"params": [aux]})
    aux.register_hook(lambda _: th.ones(1))
    model.q_net.layers[0].register_forward_hook(lambda *given: given[-1] + 0.0 * aux)
    replace_layer(model, 2, lambda: NoisyLinear(64, 153))
    model.learn(40)
    own, other = model.policy.optimizer.param_groups
    assert {id(p) for p in own["params"]} == {id(p) for p in model.q_net.parameters()}
    assert other["params"] == [aux]
    assert aux.grad is not None
    assert float(aux.grad) == 1.0  # of the last update alone


class Backbone(BaseFeaturesExtractor):
    """Its first layer learns nothing; its second, unless it is ``frozen``."""

    def __init__(self, space: spaces.Space) -> None:
        super().__init__(space, 8)
        self.pretrained, self.tuned, self.frozen = nn.Linear(4, 8), nn.Linear(8, 8), False

    def forward(self, observations: th.Tensor) -> th.Tensor:
        with th.no_grad():
            hidden = self.pretrained(observations)
        with th.set_grad_enabled(not self.frozen and th.is_grad_enabled()):
            outputs: th.Tensor = self.tuned(hidden)
            return outputs


@pytest.mark.parametrize("kernels", [True, False])
def test_what_an_extractor_does_not_train_stays(kernels: bool) -> None:
    kwargs = {"features_extractor_class": Backbone, "optimizer_kwargs": {"weight_decay": 0.1}}
    model = make(policy_kwargs=kwargs, cpu_kernels=kernels)
    extractor: Any = model.q_net.features_extractor
    first, second = weights(extractor.pretrained), weights(extractor.tuned)
    model.learn(60)
    assert th.equal(weights(extractor.pretrained), first)
    moved = weights(extractor.tuned)
    assert not th.equal(moved, second)
    extractor.frozen = True
    model.learn(60, reset_num_timesteps=False)
    assert th.equal(weights(extractor.tuned), moved)
    assert (model._learner.kernels() is not None) == kernels


class Built(MlpPolicy):
    def _build(self, lr_schedule: Any) -> None:
        self.q_net, self.q_net_target = self.make_q_net(), self.make_q_net()
        self.q_net_target.requires_grad_(False)
        self.optimizer = th.optim.Adam(self.q_net.parameters(), lr=lr_schedule(1))


def compiled(model: Rainbow) -> None:
    model.policy.q_net = th.compile(model.policy.q_net, backend="eager")  # type: ignore[assignment]
    model._create_aliases()


def tied(model: Rainbow) -> None:
    for net in (model.q_net, model.q_net_target):
        net.layers[2] = net.layers[1]


def flattened(model: Rainbow) -> None:
    for net in (model.q_net, model.q_net_target):
        net.features_extractor.flatten = nn.Sequential(nn.Flatten(), nn.Tanh())


class Spectrum(nn.Linear):
    """Its weights are complex, for which torch has no fused Adam."""

    def __init__(self) -> None:
        super().__init__(4, 8, dtype=th.cfloat)

    def forward(self, x: th.Tensor) -> th.Tensor:
        return super().forward(x.to(th.cfloat)).abs()


@pytest.mark.filterwarnings("ignore:.*torch.jit.script")
@pytest.mark.filterwarnings("ignore:Guards may run slower on Python 3.13.0")  # torch.compile's
@pytest.mark.parametrize(
    ("policy", "kwargs", "change"),
    [
        ("MlpPolicy", extracting(lambda: th.jit.script(nn.Sequential(nn.Flatten())), 4), None),
        (Built, {}, None),
        ("MlpPolicy", {"net_arch": [64] * 3}, tied),
        ("MlpPolicy", {}, compiled),
        ("MlpPolicy", {}, flattened),
        ("MlpPolicy", {}, lambda model: model.policy.share_memory()),
        ("MlpPolicy", extracting(lambda: nn.Sequential(nn.LazyLinear(8), nn.ReLU()), 8), None),
        ("MlpPolicy", extracting(Spectrum, 8), None),
    ],
    ids=["scripted", "built", "tied", "compiled", "flattened", "shared", "lazy", "complex"],
)
def test_parts_of_all_kinds_learn_as_torch_does(policy: Any, kwargs: Any, change: Any) -> None:
    vectors = []
    for kernels in (True, False):
        model = make(policy, policy_kwargs=kwargs, cpu_kernels=kernels)
        if change is not None:
            change(model)
        before = copy.deepcopy(list(model.q_net.parameters()))
        shared = [p.is_shared() for p in model.policy.parameters()]
        model.learn(60)
        assert not any(map(th.equal, before, model.q_net.parameters()))
        assert [p.is_shared() for p in model.policy.parameters()] == shared
        vectors.append(weights(model.policy))
    th.testing.assert_close(*vectors, atol=5e-3, rtol=0.0)  # rounding, 60 updates later


def test_autocast_is_left_to_torch() -> None:
    model = make(policy_kwargs={"features_extractor_class": Backbone})
    with th.autocast("cpu", dtype=th.bfloat16):
        model.learn(40)
    assert model._n_updates > 0


class Ones(NoisyLinear):
    def reset_noise(self) -> None:
        self.epsilon_in.fill_(1.0)
        self.epsilon_out.fill_(1.0)


def test_a_layer_draws_noise_of_its_own() -> None:
    model = make()
    replace_layer(model, 2, lambda: Ones(64, 153))
    model.learn(40)
    assert bool((model.q_net.layers[2].epsilon_in == 1.0).all())  # type: ignore[union-attr]


class Before(RainbowNetwork):
    """A noisy layer between extractor and layers."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.before = NoisyLinear(self.features_dim, self.features_dim)

    def extract_features(self, obs: PyTorchObs, features_extractor: Any) -> th.Tensor:
        features: th.Tensor = self.before(super().extract_features(obs, features_extractor))
        return features


class SharedPolicy(MlpPolicy):
    """Both networks see through one extractor."""

    shared: BaseFeaturesExtractor

    def make_features_extractor(self) -> BaseFeaturesExtractor:
        if not hasattr(self, "shared"):
            self.shared = super().make_features_extractor()
        return self.shared


class Frozen(Backbone):
    def __init__(self, space: spaces.Space) -> None:
        super().__init__(space)
        self.tuned.requires_grad_(False)


@pytest.mark.parametrize("kind", [Backbone, Frozen])
def test_an_extractor_that_both_networks_share_learns_unless_it_is_frozen(kind: Any) -> None:
    model = make(SharedPolicy, policy_kwargs={"features_extractor_class": kind})
    layer: Any = model.q_net.features_extractor.tuned
    assert model.q_net_target.features_extractor is model.q_net.features_extractor
    before = weights(layer)
    model.learn(60)
    assert th.equal(before, weights(layer)) == (kind is Frozen)
    assert not any(p.requires_grad for p in model.q_net_target.layers.parameters())


@pytest.mark.parametrize("policy", ["MlpPolicy", SharedPolicy])
def test_statistics_of_an_extractor_are_learned_shared_or_not(policy: Any) -> None:
    kwargs = extracting(lambda: nn.Sequential(nn.Linear(4, 8), nn.BatchNorm1d(8)), 8)
    model = make(policy, policy_kwargs=kwargs).learn(60)
    counts = [m for m in model.q_net.modules() if isinstance(m, nn.BatchNorm1d)]
    assert all(int(m.num_batches_tracked or 0) >= model._n_updates > 0 for m in counts)


def test_a_foreign_sample_has_a_weight_and_a_discount_for_each_transition() -> None:
    column = th.linspace(0.1, 1.0, 5)[:, None]
    given: Any = dict.fromkeys(("observations", "next_observations", "dones", "rewards"), column)
    own = {"actions": column, "weights": column, "discounts": column[:, 0]}
    batch = as_batch(SimpleNamespace(**given, **own), 0.9, masking=False)
    assert th.equal(batch.weights, column[:, 0])
    assert th.equal(batch.discounts, column)


def test_noise_of_a_subclass_is_drawn_and_silenced() -> None:
    model = make(policy_of(Before))
    net = model.q_net
    assert isinstance(net, Before)
    old = net.before.epsilon_in.clone()
    model.learn(40)
    assert not th.equal(old, net.before.epsilon_in)
    observations = th.rand(5, 4)
    quiet = net(observations, noisy=False)
    net.reset_noise()
    assert th.equal(quiet, net(observations, noisy=False))


def test_dropout_put_into_the_target_is_off() -> None:
    model = make()
    replace_layer(model, 1, lambda: nn.Sequential(nn.Linear(64, 64), nn.Dropout(0.5)))
    model.learn(40)
    assert not model.policy.q_net_target.layers[1].training


def test_none_means_to_load_what_it_means_to_the_constructor(tmp_path: Any) -> None:
    make(tau=0.5, prioritized=False, n_steps=1).save(tmp_path / "model")
    path = tmp_path / "model.zip"
    given: Any = dict.fromkeys(("tau", "prioritized", "n_steps", "learning_rate", "distributional"))
    loaded = Rainbow.load(path, **given)
    assert (loaded.tau, loaded.prioritized, loaded.n_steps) == (5e-3, True, 3)
    assert loaded.lr_schedule(0.0) == pytest.approx(1e-4)
    assert loaded.distributional == "quantile"
    assert Rainbow.load(path, tau=None, target_update_interval=100).tau == 1.0
    assert Rainbow.load(path).tau == 0.5
    with pytest.raises(ValueError, match="tau"):
        Rainbow.load(path, tau=2.0)


class Viewing(nn.Conv2d):
    """A convolution flattened by ``view``, as in many programs."""

    def forward(self, observations: th.Tensor) -> th.Tensor:
        features = super().forward(observations)
        return features.view(features.size(0), -1)


def test_an_extractor_that_views_its_images_as_rows() -> None:
    env = FakeImageEnv(2, screen_height=40, screen_width=40, n_channels=3, discrete=True)
    kwargs = extracting(lambda: Viewing(3, 4, 8, stride=6), 4 * 6 * 6)
    assert make("CnnPolicy", env, policy_kwargs=kwargs).learn(24)._n_updates > 0


class Running(BaseFeaturesExtractor):
    """Batch normalization, and a buffer of another name: the module around it says that it runs."""

    def __init__(self, space: spaces.Space) -> None:
        super().__init__(space, 4)
        self.norm = nn.BatchNorm1d(4)
        self.running_norm: Any = nn.Module()
        self.running_norm.register_buffer("mean", th.zeros(4))

    def forward(self, observations: th.Tensor) -> th.Tensor:
        if self.training:
            self.running_norm.mean.lerp_(observations.mean(0), 0.1)
        normalized: th.Tensor = self.norm(observations - self.running_norm.mean)
        return normalized


def test_running_statistics_reach_the_target_as_in_sb3_and_rest_in_the_logs() -> None:
    model: Any = make(policy_kwargs={"features_extractor_class": Running}, tau=0.01).learn(40)
    online, target = (net.features_extractor for net in (model.q_net, model.q_net_target))
    assert online.running_norm.mean.norm() > 0.0
    batch = as_batch(model.replay_buffer.sample(8), 0.99, False)
    model.policy.set_training_mode(True)
    model._learner.diagnostics(batch, th.ones(8))
    assert th.equal(online.running_norm.mean, target.running_norm.mean)
    assert th.equal(online.norm.running_mean, target.norm.running_mean)


def test_saving_leaves_shared_memory_shared() -> None:
    model = make().learn(40)
    model.policy.share_memory()
    model.save(io.BytesIO())
    assert all(p.is_shared() for p in model.policy.parameters())
