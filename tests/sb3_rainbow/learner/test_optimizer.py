"""The policy's optimizer is one of torch's over the network's own parameters, whoever uses it."""

import copy
import pickle
from typing import Any

import pytest
import torch as th
from stable_baselines3.common.utils import set_random_seed
from torch import nn

from sb3_rainbow import Rainbow
from tests.sb3_rainbow.small import make, weights


def make_model(kernels: bool, **kwargs: Any) -> Rainbow:
    return make(learning_rate=1e-4, gradient_steps=1, cpu_kernels=kernels, **kwargs)


@pytest.fixture(name="model", params=[True, False], ids=["kernels", "torch"])
def model_of_each_kind(request: pytest.FixtureRequest) -> Rainbow:
    """On each of the two ways of an update."""
    return make_model(request.param)


def learn(model: Rainbow, total: int = 40) -> Rainbow:
    return model.learn(total, reset_num_timesteps=False)


def test_states_are_exchanged_with_a_plain_adam(model: Rainbow) -> None:
    learn(model)
    copies = [nn.Parameter(p.detach().clone()) for p in model.q_net.parameters()]
    plain = th.optim.Adam(copies, lr=1e-4)
    plain.load_state_dict(copy.deepcopy(model.policy.optimizer.state_dict()))
    gradients = [th.randn_like(p) for p in copies]
    optimizer = model.policy.optimizer
    for _ in range(2):
        for p, q, g in zip(copies, model.q_net.parameters(), gradients, strict=True):
            p.grad, q.grad = g.clone(), g.clone()
        plain.step()
        optimizer.step()
        th.testing.assert_close(nn.utils.parameters_to_vector(copies), weights(model.q_net))
        # and back
        optimizer.load_state_dict(copy.deepcopy(plain.state_dict()))
    n_steps = int(next(iter(optimizer.state.values()))["step"])
    learn(model, 4)
    assert {int(s["step"]) for s in optimizer.state.values()} == {n_steps + 1}


@pytest.mark.parametrize("kernels", [True, False])
def test_hooks_fire_once_per_update_and_change_nothing(kernels: bool) -> None:
    plain = learn(make_model(kernels), 60)
    model = make_model(kernels)
    seen: list[str] = []
    model.policy.optimizer.register_step_pre_hook(lambda *_: seen.append("pre"))
    model.policy.optimizer.register_step_post_hook(lambda *_: seen.append("post"))
    learn(model, 60)
    assert seen == ["pre", "post"] * model._n_updates
    assert th.equal(weights(model.q_net), weights(plain.q_net))


def test_a_pre_hook_sees_the_clipped_gradient_and_may_change_it(model: Rainbow) -> None:
    model.max_grad_norm = 1e-3
    norms: list[float] = []

    def hook(*_: Any) -> None:
        gradients = [p.grad for p in model.q_net.parameters() if p.grad is not None]
        norms.append(float(th.stack([g.norm() for g in gradients]).norm()))
        for g in gradients:
            g.zero_()

    model.policy.optimizer.register_step_pre_hook(hook)
    before = weights(model.q_net)
    learn(model)
    assert norms == pytest.approx([1e-3] * len(norms), rel=1e-3)
    assert th.equal(before, weights(model.q_net))


@pytest.mark.parametrize("put_in", [lambda g: -g, lambda g: None])
def test_a_gradient_that_a_pre_hook_puts_in_is_the_one_that_counts(put_in: Any) -> None:
    def swap(*_: Any) -> None:
        for p in model.q_net.parameters():
            p.grad = put_in(p.grad)

    results = []
    for kernels in (True, False):
        model = make_model(kernels)
        model.policy.optimizer.register_step_pre_hook(swap)
        results.append(weights(learn(model, 80).q_net))
    th.testing.assert_close(*results, atol=2e-4, rtol=0.0)  # of 1.5e-3 that they move
    assert model._n_updates > 10


def test_a_schedule_of_torch_counts_the_steps(model: Rainbow) -> None:
    th.optim.lr_scheduler.ExponentialLR(model.policy.optimizer, 0.9)
    learn(model)
    assert model.policy.optimizer._opt_called  # type: ignore[attr-defined]


def test_an_optimizer_of_some_parameters_moves_those_alone() -> None:
    model = learn(make_model(True))
    head = list(model.q_net.layers[-1].parameters())
    model.policy.optimizer = th.optim.Adam(head, lr=1e-3)
    before = {name: p.detach().clone() for name, p in model.q_net.named_parameters()}
    learn(model)
    moved = {n for n, p in model.q_net.named_parameters() if not th.equal(p, before[n])}
    assert moved == {n for n in before if n.startswith("layers.1.")}


@pytest.mark.parametrize("kernels", [True, False])
def test_a_policy_that_learned_pickles_to_its_numbers(kernels: bool) -> None:
    model = make_model(kernels, policy_kwargs={"net_arch": [64, 64]})
    n_weights = sum(p.numel() for p in model.policy.parameters())
    overhead = 40_000  # bytes, most of it about 500 for each tensor
    assert len(pickle.dumps(model.policy)) < 4 * n_weights + overhead
    learn(model)
    # Two moments of the online network's
    assert len(pickle.dumps(model.policy)) < 4 * 2 * n_weights + overhead
    assert len(pickle.dumps(model.q_net)) < 4 * n_weights // 2 + overhead
    assert len(pickle.dumps(model.policy.state_dict())) < 4 * n_weights + overhead
    assert len(pickle.dumps(model.get_parameters())) < 4 * 2 * n_weights + overhead
    before = weights(model.q_net)
    learn(model, 4)
    assert not th.equal(before, weights(model.q_net))


def test_a_deep_copy_learns_on_as_the_original(model: Rainbow) -> None:
    twin = copy.deepcopy(learn(model))
    results = []
    for each in (model, twin):
        set_random_seed(3)
        each.train(6, 8)
        results.append(weights(each.q_net))
    assert th.equal(*results)
    # and apart from the original
    for p in twin.q_net.parameters():
        p.data += 1.0
    assert th.equal(results[0], weights(model.q_net))
