"""Compiled kernels for an update and for acting, only where they compute what torch would."""

from collections.abc import Iterable
from functools import cache
from itertools import chain
from operator import attrgetter, methodcaller
from typing import Any

import numpy as np
import torch as th
from torch import nn
from torch.nn.modules import module as torch_module

from sb3_rainbow.fast import mlp_kernels as kernels
from sb3_rainbow.fast.adam import AdamOnVector
from sb3_rainbow.fast.mlp_update import MlpUpdate, parameters_of, table_of
from sb3_rainbow.network.noisy_linear import NoisyLinear
from sb3_rainbow.network.rainbow_network import RainbowNetwork
from sb3_rainbow.policies import RainbowPolicy

# With more weights behind an extractor that learns, matrix products are what costs, and torch has
# more threads for them
_MOST_WEIGHTS = 500_000
_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_GLOBAL_HOOKS = tuple(f"_global{name}" for name in _HOOKS)
_TRAINS = attrgetter("requires_grad")
_VALUES: Any = methodcaller("values")  # a scripted module's are in no dict
_HOOKS_OF_PARAMETER = attrgetter("_backward_hooks", "_post_accumulate_grad_hooks")
_ACTING = ("predict", "_predict", "forward", "obs_to_tensor", "set_training_mode")


def kernels_apply(
    q_net: RainbowNetwork, q_net_target: RainbowNetwork, optimizer: th.optim.Optimizer
) -> bool:
    """Whether both networks are ReLU perceptrons of the package's own parts, in float32 on the CPU,
    behind any extractor, and Adam trains the online one.
    """
    if not (_is_perceptron(q_net) and _is_perceptron(q_net_target)):
        return False
    online, target = parameters_of(q_net), parameters_of(q_net_target)
    ids = set(map(id, online))
    return (
        all(map(_TRAINS, online))
        and ids.isdisjoint(map(id, target))
        and np.array_equal(table_of(q_net), table_of(q_net_target))
        and _constants(q_net) == _constants(q_net_target)
        and AdamOnVector.is_possible(optimizer, ids)
    )


def _constants(net: RainbowNetwork) -> tuple[Any, ...]:
    """What two networks must have in common besides their tables."""
    return (net.n_actions, net.n_atoms, net.head, net.dueling, net.v_min, net.v_max)


def _is_perceptron(net: RainbowNetwork) -> bool:
    if type(net) is not RainbowNetwork or type(net.activation) is not nn.ReLU:
        return False
    if "advantage_layers" in net._modules:
        return False
    plain = all(type(layer) in (nn.Linear, NoisyLinear) for layer in net.layers)
    extractor = net.features_extractor
    # Buffers would have to follow to the target network, and noise be drawn.
    stateful = list(extractor.buffers()) or any(
        isinstance(m, NoisyLinear) for m in extractor.modules()
    )
    if not plain or stateful or not _is_untouched(net):
        return False
    parameters, table = parameters_of(net), table_of(net)
    sizes = (table[:, kernels.INPUTS] + 1) * table[:, kernels.OUTPUTS]
    n_parameters = int(((1 + table[:, kernels.NOISY]) * sizes).sum())
    learned = list(extractor.parameters())
    if learned and n_parameters > _MOST_WEIGHTS:
        return False
    return (
        len(parameters) == len(set(map(id, parameters))) == len(list(net.parameters()))
        and all(
            p is not None
            and (p.dtype, p.device.type) == (th.float32, "cpu")
            and (p.is_contiguous() or p.is_contiguous(memory_format=th.channels_last))  # no gaps
            and not p.is_shared()  # with other processes, which would see the memory that was
            for p in parameters
        )
        and sum(p.numel() for p in parameters) - sum(p.numel() for p in learned) == n_parameters
        and table[0, kernels.INPUTS] == net.features_dim
        and table[-1, kernels.OUTPUTS] == (net.n_actions + net.dueling) * net.n_atoms
        and bool((table[1:, kernels.INPUTS] == table[:-1, kernels.OUTPUTS]).all())
    )


def _is_untouched(root: nn.Module) -> bool:
    """Whether neither modules nor parameters have hooks, nor modules attributes in the place of
    their class's methods.
    """
    modules = list(root.modules())
    typed: list[tuple[Any, nn.Module]] = [(type(module), module) for module in modules]
    return not (any(_hooks(modules)) or _are_hooked(root.parameters())) and all(
        _methods(kind).isdisjoint(vars(module)) for kind, module in typed
    )


@cache
def _methods(kind: Any) -> frozenset[str]:
    return frozenset(name for name in dir(kind) if callable(getattr(kind, name, None)))


def _hooks(modules: Iterable[nn.Module]) -> list[dict[Any, Any]]:
    own = [getattr(m, name) for m in modules for name in _HOOKS]
    return own + [getattr(torch_module, name) for name in _GLOBAL_HOOKS]


def _are_hooked(parameters: Iterable[nn.Parameter]) -> bool:
    return any(chain.from_iterable(map(_HOOKS_OF_PARAMETER, parameters)))


class _ChangeDetector:
    """Remembers a module's parts, types, hooks, attributes, parameters and buffers, to compare.

    A comparison takes microseconds, where a walk over the modules takes as long as a matrix
    product.
    """

    def __init__(self, root: nn.Module) -> None:
        self._modules = list(root.modules())
        self._attributes = list(map(vars, self._modules))
        self._hooks = _hooks(self._modules)
        parts = [d for m in self._modules for d in (m._modules, m._parameters, m._buffers)]
        self._parts = [d for d in parts if d]
        self._parameters = list(root.parameters())
        self._learning = [p for p in self._parameters if p.requires_grad]  # only these have hooks
        self._contents, self._seen = self._look()

    def _look(self) -> tuple[list[Any], tuple[Any, ...]]:
        contents = list(chain.from_iterable(map(_VALUES, self._parts)))
        return contents, (
            list(map(id, contents)),
            list(map(type, self._modules)),
            list(map(len, self._attributes)),
            any(self._hooks),
            list(map(_TRAINS, self._parameters)),
            _are_hooked(self._learning),
        )

    def is_unchanged(self) -> bool:
        """Whether all is as it was at the creation of this object, which keeps what it saw."""
        return self._look()[1] == self._seen


def _acts_plainly(policy: RainbowPolicy) -> bool:
    """Whether nothing that chooses actions was overridden or replaced."""
    kind = type(policy)
    own = all(getattr(kind, name) is getattr(RainbowPolicy, name) for name in _ACTING)
    return own and vars(policy).keys().isdisjoint(_ACTING)


class Shortcuts:
    """Compiled kernels for ReLU perceptrons on the CPU.

    Whether they apply is decided anew whenever the policy's modules or its optimizer changed.
    """

    def __init__(self, policy: RainbowPolicy) -> None:
        self.policy = policy
        self._detector: _ChangeDetector | None = None
        self._optimizer: th.optim.Optimizer | None = None
        self._mlp: MlpUpdate | None = None
        self.acts = False  # whether they may choose actions too, as of the last look

    def __getstate__(self) -> dict[str, Any]:
        # A copy makes its own: these refer to the modules and the memory of the original.
        return {**self.__dict__, "_detector": None, "_mlp": None}

    @property
    def kernels(self) -> MlpUpdate | None:
        """The compiled kernels, where they apply."""
        if self._mlp is not None and self._mlp.settled:
            return self._mlp
        if th.is_autocast_enabled("cpu"):
            return None
        optimizer = self.policy.optimizer
        if (
            self._detector is not None
            and self._optimizer is optimizer
            and self._detector.is_unchanged()
            and (self._mlp is None or self._mlp.is_current(optimizer))
        ):
            return self._mlp
        self._mlp = None
        self.policy.update_optimizer()
        nets = self.policy.q_net, self.policy.q_net_target
        if kernels_apply(*nets, optimizer):
            self._mlp = MlpUpdate(*nets)
        self.acts = _acts_plainly(self.policy)
        self._detector, self._optimizer = _ChangeDetector(self.policy), optimizer
        return self._mlp
