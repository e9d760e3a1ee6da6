"""A trained model's greedy policy for programs without Python: ONNX, or torch's exported program.

Inputs and outputs have the same names in both:

- ``observations``: ``(B, ...)``, as the model's environment gives them, images as ``uint8`` with
  their channels first. Of a dict each entry is an input of its own, ``observations_<key>``. The
  statistics of a ``VecNormalize`` are not part of the policy.
- ``action_masks``: ``(B, n_actions)``, bool, True where allowed. In ONNX it may be left out, which
  allows everything.
- ``actions``: ``(B,)``, int64; ``q_values``: ``(B, n_actions)``, of the mean weights, unmasked.
"""

import copy
import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from torch import nn

from sb3_rainbow.network.losses import mask_q_values
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.policies import RainbowPolicy
from sb3_rainbow.rainbow import Rainbow

_MASKS = "action_masks"


class ExportError(ValueError):
    """A policy that cannot be exported."""


class GreedyPolicy(nn.Module):
    """What is exported: greedy actions and Q-values of a network's mean weights.

    ``keys`` of a dict of observations are in the order of their tensors.
    """

    def __init__(self, q_net: RainbowNetwork, keys: tuple[str, ...] = ()) -> None:
        super().__init__()
        self.q_net = q_net
        self.keys = keys

    def forward(self, *inputs: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Greedy actions and Q-values of inputs: the observations, then the masks."""
        *tensors, action_masks = inputs
        observations: Any = dict(zip(self.keys, tensors, strict=True)) if self.keys else tensors[0]
        q_values = self.q_net(observations)
        return mask_q_values(q_values, action_masks).argmax(dim=1), q_values


def to_onnx(model: Rainbow, path: str | os.PathLike[str]) -> None:
    """Write a trained model's greedy policy as an ONNX file, with any number of rows per call.

    Raises:
        ExportError: if the extra ``export`` is missing, or the network cannot be exported.
    """
    try:
        import onnx
        import onnxscript  # noqa: F401  which torch's exporter needs
    except ImportError as error:
        raise ExportError(
            f"{error.name} is missing: pip install 'sb3-rainbow-coop[export]'"
        ) from error
    program = to_program(model)
    observations = [f"observations_{key}" for key in _keys(model.policy)] or ["observations"]
    with warnings.catch_warnings(), _errors_alone():
        warnings.simplefilter("ignore")  # of torch about itself
        exported = th.onnx.export(
            program,
            input_names=[*observations, _MASKS],
            output_names=["actions", "q_values"],
            verbose=False,
        )
    assert exported is not None
    proto = exported.model_proto
    # An input that has an initializer of its name has a default: here one row for all rows.
    everything = np.ones((1, model.q_net.n_actions), dtype=np.bool_)
    proto.graph.initializer.append(onnx.numpy_helper.from_array(everything, _MASKS))
    for value in (*proto.graph.input, *proto.graph.output):
        rows = "mask_rows" if value.name == _MASKS else "rows"
        value.type.tensor_type.shape.dim[0].dim_param = rows
    onnx.checker.check_model(proto)
    onnx.save(proto, os.fspath(path))


def to_program(model: Rainbow) -> th.export.ExportedProgram:
    """A trained model's greedy policy by ``torch.export``, for its ``save`` or AOTInductor.

    Raises:
        ExportError: if it is no Rainbow, or its network cannot be exported.
    """
    if not isinstance(model, Rainbow):
        raise ExportError(f"expected a Rainbow model, got {type(model).__name__}")
    policy = model.policy
    of_policy = ((policy, name) for name in ("predict", "_predict", "obs_to_tensor"))
    for part, name in ((model, "predict"), *of_policy, (policy.q_net, "_predict")):
        home = getattr(part, name).__module__.partition(".")[0]
        if home not in ("sb3_rainbow", "stable_baselines3"):
            raise ExportError(
                f"{type(part).__name__} chooses actions by a {name} of its own, which would be lost"
            )
    space = copy.deepcopy(policy.observation_space)  # drawing would move its generator
    each = list(space.spaces.values()) if isinstance(space, spaces.Dict) else [space]
    two_rows = [th.as_tensor(np.stack([part.sample()] * 2)) for part in each]
    examples = (*two_rows, th.ones(2, policy.q_net.n_actions, dtype=th.bool))
    rows = th.export.Dim("rows", min=1)
    shapes = {"inputs": tuple({0: rows} for _ in examples)}
    greedy = GreedyPolicy(copy.deepcopy(policy.q_net).to("cpu"), _keys(policy)).eval()
    try:
        return th.export.export(greedy, examples, dynamic_shapes=shapes)
    except Exception as error:  # whatever a layer of one's own does in torch's tracer
        reason = str(error).strip().splitlines()[0] if str(error).strip() else repr(error)
        raise ExportError(
            f"the network of {type(policy).__name__} cannot be exported: {reason}"
        ) from error


def _keys(policy: RainbowPolicy) -> tuple[str, ...]:
    space = policy.observation_space
    return tuple(space.spaces) if isinstance(space, spaces.Dict) else ()


@contextmanager
def _errors_alone() -> Iterator[None]:
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
