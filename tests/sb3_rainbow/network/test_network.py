"""Noisy layers and the dueling, distributional head."""

import copy
import re
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import NatureCNN
from torch import nn

from sb3_rainbow import NoisyLinear
from sb3_rainbow.network.convolutions import NatureConvolutions
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.policies import CnnPolicy, MlpPolicy
from tests.sb3_rainbow import small

OBS = spaces.Box(-1, 1, (4,), np.float32)
OBSERVATIONS = th.randn(6, 4, generator=th.Generator().manual_seed(0))


def make_policy(**kwargs: Any) -> MlpPolicy:
    given = {"net_arch": [32, 24, 16], "v_min": -5.0, "v_max": 5.0, **kwargs}
    return small.make_policy(OBS, 3, **given)


def make_net(**kwargs: Any) -> RainbowNetwork:
    return make_policy(**kwargs).q_net


def noisy_layers_of(net: RainbowNetwork) -> list[Any]:
    return [module for module in net.modules() if isinstance(module, NoisyLinear)]


def noise_of(layer: NoisyLinear) -> tuple[th.Tensor, th.Tensor]:
    """Weight and bias noise in effect, by difference from the mean weights at sigma = 1."""
    with th.no_grad():
        layer.weight_sigma.fill_(1.0)
        layer.bias_sigma.fill_(1.0)
        eye = th.eye(layer.in_features)
        zero = th.zeros(1, layer.in_features)
        bias = layer(zero) - layer(zero, noisy=False)
        weight = (layer(eye) - layer(eye, noisy=False) - bias).T
    return weight, bias[0]


def test_noise_is_factorized_with_the_moments_of_the_transformed_gaussian() -> None:
    th.manual_seed(0)
    layer = NoisyLinear(6, 5)
    noises = []
    for _ in range(4000):
        layer.reset_noise()
        noises.append(noise_of(layer))
    weight_noise, bias_noise = (th.stack(each) for each in zip(*noises, strict=True))
    assert np.linalg.matrix_rank(weight_noise[0].numpy(), tol=1e-4) == 1
    # E f(x)^2 = E|x| = sqrt(2/pi); the product of two independent ones has variance 2/pi.
    assert weight_noise.mean().abs() < 0.02
    assert weight_noise.var().item() == pytest.approx(2 / np.pi, rel=0.05)
    assert bias_noise.mean().abs() < 0.03
    assert bias_noise.var().item() == pytest.approx(np.sqrt(2 / np.pi), rel=0.05)
    # f keeps the sign, so that its second moment is not that of a Gaussian.
    kurtosis = (bias_noise**4).mean() / bias_noise.var() ** 2
    assert kurtosis.item() == pytest.approx(1.0 / (2 / np.pi), rel=0.08)


def test_initial_sigma_and_mean_ranges() -> None:
    layer = NoisyLinear(64, 100, sigma0=0.3)
    th.testing.assert_close(layer.weight_sigma.data, th.full((100, 64), 0.3 / 8))
    th.testing.assert_close(layer.bias_sigma.data, th.full((100,), 0.3 / 8))
    assert layer.weight_mu.abs().max() <= 1 / 8
    assert layer.weight_mu.std().item() == pytest.approx(1 / 8 / np.sqrt(3), rel=0.05)
    assert layer.bias_mu.std().item() == pytest.approx(1 / 8 / np.sqrt(3), rel=0.2)
    assert layer.epsilon_in.std() > 0.5  # a new layer has noise


def test_quantiles_explore_as_values_do() -> None:
    # The standard deviation of a Q-value under fresh noise, of fresh networks
    spread = {}
    for head in (False, "quantile"):  # a categorical one's is in proportion to its support
        th.manual_seed(0)
        net = make_net(distributional=head, net_arch=[64, 64])
        samples = []
        with th.no_grad():
            for _ in range(400):
                net.reset_noise()
                samples.append(net(OBSERVATIONS, noisy=True))
        # differences of actions: what all have in common chooses none
        values = th.stack(samples)
        spread[head] = float((values - values.mean(dim=2, keepdim=True)).std(dim=0).mean())
    assert spread["quantile"] == pytest.approx(spread[False], rel=0.2)


def test_quantiles_of_an_action_share_their_output_noise() -> None:
    layer = make_net(distributional="quantile", n_atoms=5).layers[-1]
    assert isinstance(layer, NoisyLinear)
    bias = noise_of(layer)[1].view(4, 5)
    th.testing.assert_close(bias, bias[:, :1].expand(-1, 5))
    assert bias[:, 0].std() > 0.1


@pytest.mark.parametrize("training", [True, False])
def test_noise_has_nothing_to_do_with_train_and_eval(training: bool) -> None:
    layer = NoisyLinear(4, 3).train(training)
    x = th.ones(1, 4)
    first = layer(x)
    th.testing.assert_close(layer(x), first)
    layer.reset_noise()
    assert not th.equal(layer(x), first)
    mean = nn.functional.linear(x, layer.weight_mu, layer.bias_mu)
    th.testing.assert_close(layer(x, noisy=False), mean)


def test_online_and_target_noise_are_independent() -> None:
    policy = make_policy()
    online, target = policy.q_net, policy.q_net_target
    online.reset_noise()
    target.reset_noise()
    before = th.cat(list(target.buffers()))
    assert not th.equal(th.cat(list(online.buffers())), before)
    online.reset_noise()
    assert th.equal(th.cat(list(target.buffers())), before)


def test_each_environment_explores_by_noise_of_its_own() -> None:
    net = make_net(sigma0=2.0)
    obs = OBSERVATIONS[:1].expand(5, -1).contiguous()
    net.reset_noise(n_envs=5)
    together = net(obs, noisy=True)
    assert len({row.detach().numpy().tobytes() for row in together}) == 5
    rows = [layer.epsilon_rows for layer in noisy_layers_of(net)]
    for i in range(5):  # as a network that has this row's noise alone
        alone = copy.deepcopy(net)
        alone.reset_noise()
        for layer, (epsilon_in, epsilon_out) in zip(noisy_layers_of(alone), rows, strict=True):
            layer.epsilon_in.copy_(epsilon_in[i])
            layer.epsilon_out.copy_(epsilon_out[i])
        th.testing.assert_close(alone(obs[:1], noisy=True)[0], together[i])
    net.reset_noise()  # as for an update: one noise for the whole batch, whatever its size
    th.testing.assert_close(net(obs, noisy=True), net(obs[:1], noisy=True).expand(5, -1))


@pytest.mark.parametrize(
    ("noisy_layers", "expected"),
    [
        ("last_two", [False, False, True, True]),
        ("head", [False, False, False, True]),
        ("all", [True] * 4),
    ],
)
def test_which_layers_are_noisy(noisy_layers: Any, expected: list[bool]) -> None:
    net = make_net(noisy_layers=noisy_layers)
    assert [isinstance(layer, NoisyLinear) for layer in net.layers] == expected
    assert not noisy_layers_of(make_net(noisy=False, noisy_layers=noisy_layers))


def test_q_values_are_expectations_under_the_distribution() -> None:
    net = make_net()
    obs = th.randn(7, 4)
    probabilities = net.distribution(obs)
    assert probabilities.shape == (7, 3, 51)
    th.testing.assert_close(probabilities.sum(-1), th.ones(7, 3))
    th.testing.assert_close(net(obs), (probabilities * th.linspace(-5, 5, 51)).sum(-1))


STREAMS = {"shared": [20], "streams": [12, 8]}


def test_streams_have_layers_of_their_own() -> None:
    net = make_net(net_arch=STREAMS, n_atoms=5, noisy_layers="last_two")
    sizes = {
        name: [(layer.in_features, layer.out_features, type(layer)) for layer in layers]
        for name, layers in net.named_children()
        if isinstance(layers, nn.ModuleList)
    }
    hidden = [(20, 12, nn.Linear), (12, 8, NoisyLinear)]
    assert sizes == {
        "layers": [(4, 20, nn.Linear)],
        "value_layers": [*hidden, (8, 5, NoisyLinear)],
        "advantage_layers": [*hidden, (8, 15, NoisyLinear)],
    }
    by_hand = th.relu(net.layers[0](OBSERVATIONS))
    value, advantages = (
        last(th.relu(noisy(th.relu(plain(by_hand)), noisy=False)), noisy=False).view(6, -1, 5)
        for plain, noisy, last in (net.value_layers, net.advantage_layers)
    )
    logits = value + advantages - advantages.mean(dim=1, keepdim=True)
    th.testing.assert_close(net.logits(OBSERVATIONS), logits)
    net.reset_noise()
    epsilons = [x for layer in net._own_layers() for x in layer.buffers()]
    assert sum(e.numel() for e in epsilons) == 20 + 20 + 13 + 23
    assert all(e.abs().min() > 0 for e in epsilons)


def test_streams_without_dueling_are_one() -> None:
    net = make_net(net_arch=STREAMS, dueling=False, noisy=False)
    assert not noisy_layers_of(net)
    assert net.streams(OBSERVATIONS, noisy=True).shape == (6, 3, 51)
    assert not any(name.startswith("value") for name, _ in net.named_parameters())


@pytest.mark.parametrize("net_arch", [{}, {"shared": []}, {"streams": []}])
def test_a_dict_without_streams_is_a_list(net_arch: dict[str, list[int]]) -> None:
    given, plain = make_net(net_arch=net_arch), make_net(net_arch=[])
    assert given.state_dict().keys() == plain.state_dict().keys()


SIZES = "net_arch must be a list of positive sizes or .*got "
NO_SIZES = (8, [8, 0], [8.5], [{"vf": [4]}], np.array([8, 8]), {"streams": 4})


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"v_min": 1.0, "v_max": 1.0}, "v_min must be below v_max, both finite, got 1.0 and 1.0"),
        ({"v_min": 2.0, "v_max": 1.0}, "v_min must be below v_max"),
        ({"v_max": np.inf}, "v_min must be below v_max"),
        ({"n_atoms": 20.5}, "n_atoms must be a whole number, at least 2, got 20.5"),
        ({"n_atoms": 1}, "n_atoms must be a whole number, at least 2, got 1"),
        ({"noisy_layers": "first"}, "noisy_layers must be one of .* got 'first'"),
        ({"net_arch": {"pi": [4], "shared": [4]}}, r"shared=\[.*streams=\[.*got {'pi'"),
        *(({"net_arch": wrong}, f"{SIZES}{re.escape(repr(wrong))}") for wrong in NO_SIZES),
        ({"distributional": "quantiles"}, "'categorical' or 'quantile', got 'quantiles'"),
        ({"distributional": None}, r"needs distributional.* loaded by Rainbow\.load"),
        ({"distributional": "quantile", "n_atoms": 0}, "n_atoms must be.*at least 1, got 0"),
    ],
    ids=str,
)
def test_heads_that_cannot_be_built(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_net(**kwargs)


def test_quantiles_are_values_and_their_mean_is_the_q_value() -> None:
    net = make_net(distributional="quantile", n_atoms=4)
    th.testing.assert_close(net(OBSERVATIONS), net.logits(OBSERVATIONS).mean(dim=2))
    th.testing.assert_close(net.distribution(OBSERVATIONS), th.full((6, 3, 4), 0.25))


def test_a_prediction_in_inference_mode_leaves_a_copy_able_to_learn() -> None:
    """Its noise gets its memory with the first prediction."""
    policy = copy.deepcopy(make_policy())
    with th.inference_mode():
        policy.predict(np.zeros(4, np.float32))
    policy.q_net.reset_noise()
    policy.q_net.logits(OBSERVATIONS).sum().backward()
    policy.optimizer.step()


def test_a_copy_made_in_inference_mode_explores_outside_of_it() -> None:
    with th.inference_mode():
        policy = copy.deepcopy(make_policy())
    policy.q_net.reset_noise()
    policy.predict(np.zeros(4, np.float32), deterministic=False)


SMALL_IMAGES = spaces.Box(0, 255, (1, 40, 40), np.uint8)


@pytest.mark.parametrize("kwargs", [{}, {"features_extractor_class": NatureCNN}])
def test_weights_of_images_go_into_a_vector_and_back(kwargs: dict[str, Any]) -> None:
    one, other = (small.make_policy(SMALL_IMAGES, 3, CnnPolicy, **kwargs) for _ in range(2))
    vector = one.parameters_to_vector()
    # in the order of their values, not of their memory
    values = [parameter.detach().numpy().flatten() for parameter in one.parameters()]
    np.testing.assert_array_equal(vector, np.concatenate(values))
    other.load_from_vector(vector)
    np.testing.assert_array_equal(
        other.q_net.parameters_to_vector(), one.q_net.parameters_to_vector()
    )


def test_a_size_of_features_asks_for_dqns_extractor() -> None:
    given: dict[str, Any] = {"features_extractor_kwargs": {"features_dim": 64}}
    net: Any = small.make_policy(SMALL_IMAGES, 3, CnnPolicy, **given).q_net
    assert type(net.features_extractor) is NatureCNN
    assert [(type(layer), layer.in_features) for layer in net.layers] == [(NoisyLinear, 64)]
    given["features_extractor_class"] = NatureConvolutions
    with pytest.raises(ValueError, match=r"features_dim=64.*streams=\[64\].*NatureCNN"):
        small.make_policy(SMALL_IMAGES, 3, CnnPolicy, **given)


def test_images_have_the_published_network_by_default() -> None:
    """Hessel et al. 2018: after the convolutions, two streams of 512 noisy units, and no more."""
    net = small.make_policy(spaces.Box(0, 255, (4, 84, 84), np.uint8), 3, CnnPolicy).q_net
    linear = [m for m in net.modules() if isinstance(m, nn.Linear | NoisyLinear)]
    assert [(m.in_features, m.out_features) for m in linear] == [
        (3136, 512), (512, 51), (3136, 512), (512, 153),
    ]  # fmt: skip
    assert all(isinstance(m, NoisyLinear) for m in linear)
    filters = [m.weight for m in net.modules() if isinstance(m, nn.Conv2d)]
    assert [len(each) for each in filters] == [32, 64, 64]
    assert all(p.is_contiguous() for p in net.parameters())  # as tools that flatten them ask
