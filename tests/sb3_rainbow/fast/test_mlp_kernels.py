"""The compiled kernels against torch's autograd and optimizer, behind extractors that learn too."""

import pickle
from contextlib import nullcontext
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.torch_layers import NatureCNN
from torch import nn

from sb3_rainbow.fast import learning_kernels as kernels
from sb3_rainbow.learner.learner import Learner
from sb3_rainbow.policies import CnnPolicy, MlpPolicy, MultiInputPolicy
from sb3_rainbow.type_aliases import Batch
from tests.sb3_rainbow.small import Extracting, identical, make, make_policy, random_batch, weights

N_ACTIONS = 5
BOX, IMAGES = spaces.Box(-1, 1, (6,), np.float32), spaces.Box(0, 255, (2, 36, 36), np.uint8)


class Convolutions(Extracting):
    """Small, learning unless they are frozen, and nothing that the kernels know."""

    def __init__(
        self, space: spaces.Space, norm: type[nn.Module] = nn.Identity, frozen: bool = False
    ) -> None:
        layers = nn.Conv2d(2, 4, 3, stride=2), norm(4), nn.ReLU(), nn.Flatten()
        super().__init__(space, lambda: nn.Sequential(*layers), 4 * 17 * 17)
        self.requires_grad_(not frozen)


def make_learner(
    cpu_kernels: bool, space: spaces.Box = BOX, double_q: bool = True, **kwargs: Any
) -> Learner:
    th.manual_seed(3)
    settings: dict[str, Any] = {
        "net_arch": [24, 16, 12],
        "distributional": True,
        "v_min": -4.0,
        "v_max": 4.0,
        # A large epsilon, so that Adam does not blow up the rounding of tiny gradients
        "optimizer_kwargs": {"weight_decay": 1e-3, "eps": 1e-2},
        **kwargs,
    }
    kind, rate = (CnnPolicy, 1e-3) if space is IMAGES else (MlpPolicy, 1e-2)
    policy = kind(space, spaces.Discrete(N_ACTIONS), lambda _: rate, **settings)
    for p in policy.q_net_target.parameters():
        p.data += 0.3 * th.randn_like(p)
    return Learner(policy, double_q, 0.5, cpu_kernels=cpu_kernels)


def make_batch(seed: int, masked: bool = False, images: bool = False) -> Batch:
    """In the one of seed 3 some actions were never taken."""
    generator = th.Generator().manual_seed(seed)
    masks = th.rand(32, N_ACTIONS, generator=generator) < 0.5
    masks[1:, seed % N_ACTIONS] = True
    masks[0] = False  # as someone who fills a buffer by hand may leave it
    batch = random_batch(6, N_ACTIONS, 32, seed, masks if masked or images else None)
    if images:
        drawn = th.randint(0, 256, (2, 32, 2, 36, 36), generator=generator, dtype=th.uint8)
        batch = batch._replace(observations=drawn[0], next_observations=drawn[1])
    return batch._replace(actions=batch.actions.clamp(max=2)) if seed == 3 else batch


SEEN: dict[str, Any] = {"space": IMAGES, "features_extractor_class": Convolutions, "n_atoms": 11}


@pytest.mark.parametrize("action", [-1, N_ACTIONS])
def test_an_action_outside_of_the_space_is_an_error(action: int) -> None:
    """As someone who fills a buffer by hand may leave it; torch refuses it too."""
    batch = make_batch(0)
    batch.actions[3] = action
    with pytest.raises(IndexError, match="outside of the action space"):
        make_learner(True).update(batch)
    with pytest.raises(RuntimeError, match="out of bounds"):
        make_learner(False).update(batch)


@pytest.mark.parametrize(
    "kwargs",
    [
        {},
        {"double_q": False},
        {"dueling": False},
        {"noisy": False},
        {"noisy_layers": "all"},
        {"distributional": False},
        {"distributional": False, "dueling": False, "noisy": False, "double_q": False},
        {"distributional": "quantile"},
        {"distributional": "quantile", "dueling": False, "double_q": False, "n_atoms": 1},
        {"net_arch": []},
        {"net_arch": [10]},
        {**SEEN, "net_arch": [16]},
        {**SEEN, "net_arch": []},
        {**SEEN, "net_arch": [16], "double_q": False},
        {**SEEN, "net_arch": [16], "noisy": False, "distributional": False},
        {**SEEN, "features_extractor_class": NatureCNN, "net_arch": [], "noisy_layers": "head"},
    ],
    ids=str,
)
def test_updates_agree_with_torch(kwargs: dict[str, Any]) -> None:
    """Also what an extractor learns, whose memory formats stay."""
    ours, reference = make_learner(True, **kwargs), make_learner(False, **kwargs)
    assert ours.kernels() is not None
    assert reference.kernels() is None
    sees = "space" in kwargs
    rtol, atol = (1e-2, 1e-4) if sees else (1e-3, 1e-5)
    batches = [make_batch(seed, masked=seed % 2 == 0, images=sees) for seed in range(4)]
    for seed, batch in enumerate(batches):
        results = []
        for learner in (ours, reference):
            th.manual_seed(seed)
            together = seed % 2 == 1
            if together:  # an update right after another, which leaves its gradients
                learner.update(batches[0])
            results.append(learner.update(batch, 0.1 if together else None))
            if not together:
                learner.move_target(0.1)
        th.testing.assert_close(results[0], results[1], rtol=1e-4, atol=1e-4 if sees else 1e-5)
        states = (x.policy.state_dict() for x in (ours, reference))
        th.testing.assert_close(*states, rtol=1e-4, atol=1e-5)
    for p, q in zip(*(x.policy.q_net.parameters() for x in (ours, reference)), strict=True):
        assert p.grad is not None
        th.testing.assert_close(p.grad, q.grad, rtol=rtol, atol=atol)
        state, other = ours.policy.optimizer.state[p], reference.policy.optimizer.state[q]
        assert state["step"] == other["step"] == 6
        assert state["exp_avg"].stride() == p.stride()
        th.testing.assert_close(state["exp_avg"], other["exp_avg"], rtol=rtol, atol=atol)
    for original in (ours, reference):  # and a copy goes on as what it was made of
        after = []
        for learner in (original, pickle.loads(pickle.dumps(original))):
            th.manual_seed(9)
            for seed in range(9, 12):
                learner.update(make_batch(seed, masked=True, images=sees))
                learner.move_target(0.1)
            after.append(learner.policy.state_dict())
        identical(*after)


@pytest.mark.parametrize(
    "kwargs",
    [
        {"activation_fn": nn.Tanh},
        {"optimizer_class": th.optim.RMSprop},
        {"optimizer_kwargs": {"amsgrad": True}},
        {"optimizer_kwargs": {"decoupled_weight_decay": True, "weight_decay": 0.1}},
        {**SEEN, "net_arch": [400]},  # too large behind one that learns
        {**SEEN, "net_arch": [8], "features_extractor_kwargs": {"norm": nn.BatchNorm2d}},
        {**SEEN, "net_arch": [8], "features_extractor_kwargs": {"frozen": True}},
    ],
    ids=str,
)
def test_torch_does_what_the_kernels_cannot(kwargs: dict[str, Any]) -> None:
    learner = make_learner(True, **kwargs)
    assert learner.kernels() is None
    learner.update(make_batch(0, images="space" in kwargs))


@pytest.mark.parametrize("kind", [th.optim.Adam, th.optim.SGD])
def test_an_optimizer_given_later_is_the_one_that_steps(kind: Any) -> None:
    model = make().learn(40)
    model.policy.optimizer = kind(model.q_net.parameters(), lr=1e-3)
    calls: list[Any] = []
    model.policy.optimizer.register_step_post_hook(lambda *_: calls.append(1))
    before = weights(model.q_net)
    model.learn(60, reset_num_timesteps=False)
    assert (model._learner.kernels() is not None) == (kind is th.optim.Adam)
    assert len(calls) == 60
    steps = {int(state["step"]) for state in model.policy.optimizer.state.values() if state}
    assert steps == ({60} if kind is th.optim.Adam else set())
    assert not th.equal(before, weights(model.q_net))


def test_options_that_older_torch_does_not_have_are_not_asked_for() -> None:
    learner = make_learner(True)
    del learner.policy.optimizer.param_groups[0]["decoupled_weight_decay"]  # as torch before 2.7
    assert learner.kernels() is not None


@pytest.mark.parametrize("images", [False, True])
def test_updates_that_nobody_disturbs_are_those_that_look_each_time(images: bool) -> None:
    results = []
    for look_once in (True, False):
        learner = make_learner(True, **(SEEN if images else {}))
        assert learner.kernels() is not None
        th.manual_seed(5)
        for seed in range(0, 12, 4):
            with learner.undisturbed() if look_once else nullcontext():
                for i in range(seed, seed + 4):
                    learner.update(make_batch(i, images=images), tau=0.1)
            learner.policy.optimizer.param_groups[0]["lr"] *= 0.5  # what happens between counts
            with th.no_grad():
                next(learner.policy.q_net.parameters()).mul_(0.9)
        assert {int(s["step"]) for s in learner.policy.optimizer.state.values()} == {12}
        results.append(weights(learner.policy))
    assert th.equal(*results)


def test_a_round_that_fails_ends_the_trust() -> None:
    learner, steps = make_learner(True), list[int]()
    learner.update(make_batch(0))
    with pytest.raises(AttributeError), learner.undisturbed():
        learner.update(make_batch(1)._replace(actions=None))  # type: ignore[arg-type]
    learner.policy.optimizer.register_step_post_hook(lambda *_: steps.append(1))
    learner.update(make_batch(2))
    assert steps == [1]


@pytest.mark.parametrize("cpu_kernels", [True, False])
@pytest.mark.parametrize("settings", [{}, {"distributional": False, "prioritized": False}], ids=str)
def test_a_batch_of_one(cpu_kernels: bool, settings: dict[str, Any]) -> None:
    model = make(batch_size=1, cpu_kernels=cpu_kernels, **settings)
    model.learn(60, log_interval=10**6)
    logged = dict(model.logger.name_to_value)
    assert {"train/loss", "train/max_q"} <= set(logged)
    assert np.isfinite(list(logged.values())).all(), logged
    assert th.isfinite(weights(model.q_net)).all()


@pytest.mark.parametrize("other", [spaces.Discrete(3), IMAGES])
def test_the_kernels_stand_behind_extractors_of_dicts(other: spaces.Space) -> None:
    policy = make_policy(spaces.Dict(a=BOX, b=other), 2, MultiInputPolicy)
    assert Learner(policy, double_q=True, max_grad_norm=1.0).kernels() is not None


@pytest.mark.parametrize("network", ["q_net", "q_net_target"])
@pytest.mark.parametrize("layer", [0, -1])
def test_a_layer_whose_weights_are_replaced_counts_and_trains(network: str, layer: int) -> None:
    ours, reference = make_learner(True), make_learner(False)
    assert ours.kernels() is not None
    batch, results = make_batch(0), []
    for learner in (ours, reference):
        th.manual_seed(1)
        learner.update(batch)
        learner.move_target(0.1)
        parameter = next(getattr(learner.policy, network).layers[layer].parameters())
        # As a callback might, or a user who puts one layer of another network in its place
        parameter.data = 0.1 * th.randn(parameter.shape, generator=th.Generator().manual_seed(1))
        before = parameter.detach().clone()
        th.manual_seed(2)
        results.append(learner.update(batch))
        learner.move_target(0.1)
        assert not th.equal(parameter, before)
    th.testing.assert_close(*results, rtol=1e-4, atol=1e-5)
    states = (x.policy.state_dict() for x in (ours, reference))
    th.testing.assert_close(*states, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("masked", [False, True])
def test_exploring_actions_are_those_of_the_policy_under_the_same_noise(masked: bool) -> None:
    model = make(sigma0=2.0, policy_kwargs={})
    obs = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    masks = np.random.default_rng(1).random((50, 2)) < 0.6 if masked else None
    if masks is not None:
        masks[:, 0] |= ~masks.any(axis=1)
    th.manual_seed(4)
    expected, _ = model.predict(obs, action_masks=masks)
    th.manual_seed(4)
    np.testing.assert_array_equal(model._explore(obs, masks), expected)
    assert 0 < expected.mean() < 1


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["returns", "discounts"])
def test_a_target_that_is_no_number_stays_in_its_array(bad: float, where: str) -> None:
    memory = np.zeros(4 * 51, np.float32)
    target = memory[51:153].reshape(2, 51)
    numbers = {name: np.ones((2, 1), np.float32) for name in ("returns", "discounts")}
    numbers[where][1] = bad
    kernels.projected_target(
        np.full((2, 51), 1 / 51, np.float32),
        *(numbers["returns"], numbers["discounts"], np.zeros((2, 1), np.float32)),
        *(-1.0, 1.0),
        target,
    )
    assert not memory[:51].any()
    assert not memory[153:].any()
    assert target[0].sum() == pytest.approx(1.0)
    if np.isnan(bad):
        assert np.isnan(target[1]).all()
