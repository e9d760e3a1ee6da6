"""Exported policies act as the model does, in ONNX Runtime and as a program of torch's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DQN
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from torch import nn

from sb3_rainbow import MlpPolicy, Rainbow
from sb3_rainbow.export import ExportError, to_onnx, to_program
from tests.sb3_rainbow.small import make

onnxruntime = pytest.importorskip("onnxruntime")


def acrobot(policy: Any = "MlpPolicy", **settings: Any) -> Rainbow:
    return make(policy, "Acrobot-v1", **settings)


def session(model: Rainbow, path: Path) -> Any:
    to_onnx(model, path)
    return onnxruntime.InferenceSession(path)


def drawn(space: spaces.Space, n: int) -> Any:
    space.seed(0)
    if isinstance(space, spaces.Dict):
        return {key: drawn(part, n) for key, part in space.items()}
    return np.stack([space.sample() for _ in range(n)])


def masks(n: int, n_actions: int) -> np.ndarray:
    result = np.random.default_rng(0).random((n, n_actions)) < 0.5
    result[:, 0] |= ~result.any(axis=1)
    return result


def assert_chosen(model: Rainbow, observations: Any, actions: Any, masks: Any = None) -> None:
    """As the model chooses, but where two values are the same up to rounding."""
    tensors, _ = model.policy.obs_to_tensor(observations)
    q_values, rows = model.q_net(tensors).detach().numpy(), np.arange(len(actions))
    expected, _ = model.predict(observations, deterministic=True, action_masks=masks)
    assert np.mean(actions == expected) > 0.95
    best = q_values[rows, expected]
    np.testing.assert_allclose(q_values[rows, actions], best, rtol=1e-4, atol=1e-4)
    assert masks is None or masks[rows, actions].all()


def images() -> FakeImageEnv:
    return FakeImageEnv(screen_height=40, screen_width=40, n_channels=2)


@pytest.mark.parametrize(
    ("policy", "env", "kwargs"),
    [
        ("MlpPolicy", "Acrobot-v1", {"distributional": True}),
        ("MlpPolicy", "Acrobot-v1", {"distributional": False, "dueling": False, "noisy": False}),
        ("MlpPolicy", "Acrobot-v1", {"policy_kwargs": {"net_arch": {"streams": [8]}}}),
        ("CnnPolicy", images, {}),
        ("MultiInputPolicy", SimpleMultiObsEnv, {}),
    ],
)
def test_a_thousand_actions_in_onnx(
    policy: str, env: Any, kwargs: dict[str, Any], tmp_path: Path
) -> None:
    settings = {"policy_kwargs": {}, **kwargs}
    model = make(policy, env if isinstance(env, str) else env(), **settings)
    runtime = session(model, tmp_path / "policy.onnx")
    observations = drawn(model.observation_space, 1000)
    feed = {"observations": observations}
    if isinstance(observations, dict):
        feed = {f"observations_{key}": value for key, value in observations.items()}
    actions, q_values = runtime.run(None, feed)
    assert_chosen(model, observations, actions)
    with th.no_grad():
        tensors, _ = model.policy.obs_to_tensor(observations)
        np.testing.assert_allclose(q_values, model.q_net(tensors), rtol=1e-4, atol=1e-4)
    allowed = masks(1000, model.q_net.n_actions)
    masked, _ = runtime.run(None, {**feed, "action_masks": allowed})
    assert_chosen(model, observations, masked, allowed)
    assert (masked != actions).any()
    one = {name: value[:1] for name, value in feed.items()}
    assert runtime.run(["actions"], one)[0] == actions[:1]


def test_masks_may_be_left_out_and_rows_are_any_number(tmp_path: Path) -> None:
    runtime = session(acrobot(), tmp_path / "policy.onnx")
    assert [(i.name, i.shape, i.type) for i in runtime.get_inputs()] == [
        ("observations", ["rows", 6], "tensor(float)")
    ]
    assert [(i.name, i.shape) for i in runtime.get_overridable_initializers()] == [
        ("action_masks", ["mask_rows", 3])
    ]
    assert [(o.name, o.shape) for o in runtime.get_outputs()] == [
        ("actions", ["rows"]),
        ("q_values", ["rows", 3]),
    ]
    wrong = {"action_masks": np.ones((2, 4), np.bool_)}
    with pytest.raises(Exception, match="action_masks"):  # ONNX Runtime's own, of another shape
        runtime.run(None, {"observations": np.zeros((2, 6), np.float32), **wrong})


def test_a_program_of_torchs_acts_alike_once_it_is_loaded(tmp_path: Path) -> None:
    model = acrobot()
    th.export.save(to_program(model), tmp_path / "policy.pt2")
    program = th.export.load(tmp_path / "policy.pt2").module()
    observations = drawn(model.observation_space, 50)
    allowed = masks(50, 3)
    actions, _ = program(th.as_tensor(observations), th.as_tensor(allowed))
    assert_chosen(model, observations, actions.numpy(), allowed)


class Branching(nn.Module):
    """What no tracer can follow: a decision that depends on the numbers."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        return th.relu(x) if float(x.sum()) > 0 else th.tanh(x)


class Stubborn(MlpPolicy):
    """Acts by a rule of its own."""

    def _predict(self, observation: Any, *args: Any, **kwargs: Any) -> Any:
        return th.zeros(len(observation), dtype=th.int64)


def test_what_cannot_be_exported_is_one_clear_error(tmp_path: Path) -> None:
    path = tmp_path / "policy.onnx"
    contrary: Any = acrobot()
    contrary.policy.predict = lambda *_, **__: None
    branching = acrobot(policy_kwargs={"activation_fn": Branching})
    other: Any = DQN("MlpPolicy", "CartPole-v1", buffer_size=10, device="cpu")
    for model, message in (
        (branching, "network of RainbowPolicy cannot be exported: .+"),
        (acrobot(Stubborn), "Stubborn chooses actions by a _predict of its own"),
        (contrary, "RainbowPolicy chooses actions by a predict of its own"),
        (other, "expected a Rainbow model, got DQN"),
    ):
        with pytest.raises(ExportError, match=message):
            to_onnx(model, path)
    assert not path.exists()
