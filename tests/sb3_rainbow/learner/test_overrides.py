"""Whatever a user overrides or replaces takes part in acting and in learning, on every path."""

from collections.abc import Callable
from operator import attrgetter
from typing import Any

import numpy as np
import pytest
import torch as th
from torch import nn
from torch.nn.utils import parametrizations

from sb3_rainbow import MlpPolicy, Rainbow
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from tests.sb3_rainbow.small import FAST, make, policy_of, weights

ACTIVATIONS = pytest.mark.parametrize("activation", [nn.ReLU, nn.Tanh])


def kwargs_of(activation: type[nn.Module]) -> dict[str, Any]:
    return {"net_arch": [16], "activation_fn": activation}


@pytest.mark.parametrize("where", ["class", "instance"])
@pytest.mark.parametrize(
    ("kind", "method"),
    [
        *((RainbowNetwork, method) for method in ("streams", "join", "forward")),
        *((MlpPolicy, method) for method in ("predict", "_predict")),
    ],
)
@ACTIVATIONS
def test_methods_of_the_network_and_of_the_policy(
    activation: type[nn.Module], kind: Any, method: str, where: str
) -> None:
    calls: list[Any] = []
    own = getattr(kind, method)

    def overridden(self: Any, *args: Any, **kwargs: Any) -> Any:
        calls.append(self)
        return own(self, *args, **kwargs)

    if where == "class":
        changed: Any = type("Changed", (kind,), {method: overridden})
        policy = changed if kind is MlpPolicy else policy_of(changed)
        model = make(policy, policy_kwargs=kwargs_of(activation))
    else:
        model = make(policy_kwargs=kwargs_of(activation))
        model.learn(24)  # with kernels, where there are any
        nets = model.q_net, model.q_net_target
        for part in (model.policy,) if kind is MlpPolicy else nets:
            setattr(part, method, lambda *a, _part=part, **k: overridden(_part, *a, **k))
    model.learn(24)
    model._n_updates = 50  # no look for the logs now
    calls.clear()
    model._explore(np.zeros((1, 4), np.float32), None)
    assert len(calls) == 1
    if kind is RainbowNetwork:
        calls.clear()
        model.train(2, 8)
        # Twice the online network, once the target network
        assert len(calls) == 2 * (1 if method == "forward" else 3)
        assert model._learner.kernels() is None


@ACTIVATIONS
def test_predict_of_the_algorithm(activation: type[nn.Module]) -> None:
    """With SB3's signature, without masks; training explores, whatever is the default here."""
    asked = set()

    class Always(Rainbow):
        def predict(self, observation, state=None, episode_start=None, deterministic=True):  # type: ignore[no-untyped-def, override]
            asked.add(deterministic)
            actions, state = super().predict(observation, state, episode_start, deterministic)
            return np.ones_like(actions), state

    kwargs: Any = {**FAST, "policy_kwargs": kwargs_of(activation)}
    model: Any = Always("MlpPolicy", "CartPole-v1", **kwargs).learn(60)
    assert (model.replay_buffer.actions[20:60] == 1).all()
    assert asked == {False}


class OwnLinear(nn.Linear):
    """A subclass that does something else."""

    def forward(self, inputs: th.Tensor) -> th.Tensor:
        return super().forward(inputs) + 1.0


def shadow(net: RainbowNetwork) -> None:
    layer: Any = net.layers[-1]
    own = layer.forward
    layer.forward = lambda *args: 5.0 - own(*args)


CHANGES: dict[str, Callable[[RainbowNetwork], Any]] = {
    "wrap": lambda net: setattr(net.layers, "1", nn.Sequential(net.layers[1], nn.Tanh())),
    "subclass": lambda net: setattr(net.layers, "0", OwnLinear(4, 16)),
    "activate": lambda net: setattr(net, "activation", nn.Sigmoid()),
    "normalize": lambda net: parametrizations.spectral_norm(net.layers[-1], "weight_mu"),
    "hook": lambda net: net.layers[-1].register_forward_hook(lambda *given: given[-1] * 3.0),
    "shadow": shadow,
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_changed_parts_act_and_learn(change: Callable[[RainbowNetwork], Any]) -> None:
    """A model changed under way goes on as one that never had kernels."""
    result = []
    for cpu_kernels in (True, False):
        model = make(cpu_kernels=cpu_kernels)
        assert (model._learner.kernels() is not None) == cpu_kernels
        model._learner.act(th.zeros(1, 4), None)
        th.manual_seed(5)
        for net in (model.q_net, model.q_net_target):
            change(net)
        before = [p.detach().clone() for p in model.q_net.parameters()]
        th.manual_seed(6)
        model.learn(60)
        assert model._learner.kernels() is None
        after = list(model.q_net.parameters())
        assert not any(th.equal(p, q) for p, q in zip(before, after, strict=True))
        buffer: Any = model.replay_buffer
        result.append((weights(model.q_net), th.from_numpy(buffer.actions)))
    th.testing.assert_close(*result)


def test_a_network_of_another_type_gets_its_kernels_back_with_its_own() -> None:
    model = make()
    assert model._learner.kernels() is not None
    model.policy.to(th.float64)
    assert model._learner.kernels() is None
    model.policy.to(th.float32)
    assert model._learner.kernels() is not None
    model.learn(40)


@pytest.mark.parametrize(
    ("part", "hook"),
    [
        ("layers.0", "register_forward_hook"),
        ("layers.0.weight_mu", "register_hook"),
        ("layers.0.weight_mu", "register_post_accumulate_grad_hook"),
    ],
)
def test_hooks_are_called_and_the_kernels_come_back_without_them(part: str, hook: str) -> None:
    model = make().learn(24)
    model._n_updates = 50  # no look for the logs now
    calls: list[Any] = []
    register = attrgetter(f"{part}.{hook}")(model.q_net)
    handle = register(lambda *given: calls.append(given))
    assert model._learner.kernels() is None
    model.train(2, 8)
    assert len(calls) == (4 if hook == "register_forward_hook" else 2)  # there, once to choose
    handle.remove()
    assert model._learner.kernels() is not None


@pytest.mark.parametrize("kernels", [True, False])
@pytest.mark.parametrize(("name", "value"), [("double_q", False), ("max_grad_norm", 0.1)])
def test_settings_of_the_update_may_change_after_the_model_was_made(
    name: str, value: Any, kernels: bool
) -> None:
    def learned(made: dict[str, Any], changed: dict[str, Any]) -> Any:
        model = make(cpu_kernels=kernels, **made)
        vars(model).update(changed)
        return model.learn(100).policy.parameters_to_vector()

    changed = learned({}, {name: value})
    np.testing.assert_array_equal(changed, learned({name: value}, {}))
    assert not np.array_equal(changed, learned({}, {}))


class PolicyAsInSB3(MlpPolicy):
    """Knows nothing of masks, and takes ``deterministic`` by its name alone in one place."""

    def _predict(self, observation, *, deterministic=True):  # type: ignore[no-untyped-def, override]
        return super()._predict(observation, deterministic=deterministic)

    def predict(self, observation, state=None, episode_start=None, deterministic=False):  # type: ignore[no-untyped-def, override]
        return super().predict(observation, state, episode_start, deterministic)


def test_signatures_of_sb3_serve_envs_without_masks() -> None:
    assert make(PolicyAsInSB3).learn(40)._n_updates > 0
