"""Whether networks and policies are the package's own, with nothing overridden or replaced."""

from collections.abc import Iterable
from functools import cache
from itertools import chain
from operator import attrgetter, is_
from typing import Any

from torch import nn
from torch.nn.modules import module as torch_module

_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_GLOBAL_HOOKS = ("_global_forward_hooks", "_global_forward_pre_hooks", "_global_backward_hooks")


_TRAINS = attrgetter("requires_grad")
_HOOKS_OF_PARAMETER = attrgetter("_backward_hooks", "_post_accumulate_grad_hooks")


def _values(dicts: Iterable[dict[str, Any]]) -> Iterable[Any]:
    return chain.from_iterable(map(dict.values, dicts))


@cache
def _methods(kind: Any) -> frozenset[str]:
    return frozenset(name for name in dir(kind) if callable(getattr(kind, name, None)))


def _hooks(modules: Iterable[nn.Module]) -> list[dict[Any, Any]]:
    own = [getattr(m, name) for m in modules for name in _HOOKS]
    return own + [getattr(torch_module, name) for name in _GLOBAL_HOOKS]


def are_hooked(parameters: Iterable[nn.Parameter]) -> bool:
    """Whether someone waits for the gradient of a parameter."""
    return any(chain.from_iterable(map(_HOOKS_OF_PARAMETER, parameters)))


def are_untouched(root: nn.Module) -> bool:
    """Whether neither modules nor parameters have hooks, nor modules attributes in the place of
    their class's methods.
    """
    modules = list(root.modules())
    typed: list[tuple[Any, nn.Module]] = [(type(module), module) for module in modules]
    return not (any(_hooks(modules)) or are_hooked(root.parameters())) and all(
        _methods(kind).isdisjoint(vars(module)) for kind, module in typed
    )


def inherits(thing: Any, kind: type, *methods: str) -> bool:
    """Whether an object of a subclass of ``kind`` has these methods of it as they are there."""
    own = all(getattr(type(thing), name) is getattr(kind, name) for name in methods)
    return own and vars(thing).keys().isdisjoint(methods)


class Watch:
    """Tells whether a module's parts, types, hooks, attributes, parameters and buffers are the
    same.

    It costs microseconds, where a walk over the modules costs as much as a matrix product.

    Args:
        root: module to watch, with all that is inside.
    """

    def __init__(self, root: nn.Module) -> None:
        self._modules = list(root.modules())
        self._types = list(map(type, self._modules))
        self._attributes = list(map(vars, self._modules))
        self._n_attributes = list(map(len, self._attributes))
        self._hooks = _hooks(self._modules)
        self._has_hooks = any(self._hooks)
        held = [d for m in self._modules for d in (m._modules, m._parameters, m._buffers)]
        self._held = [d for d in held if d]
        self._holds = list(_values(self._held))
        self._parameters = list(root.parameters())
        self._trained = list(map(_TRAINS, self._parameters))
        # only these can have hooks
        self._learning = [p for p in self._parameters if p.requires_grad]
        self._has_hooked_parameters = are_hooked(self._learning)

    def sees_no_change(self) -> bool:
        """Whether all is as it was when the watch began."""
        holds = list(_values(self._held))
        return (
            len(holds) == len(self._holds)
            and all(map(is_, holds, self._holds))
            and list(map(type, self._modules)) == self._types
            and list(map(len, self._attributes)) == self._n_attributes
            and any(self._hooks) == self._has_hooks
            and list(map(_TRAINS, self._parameters)) == self._trained
            and are_hooked(self._learning) == self._has_hooked_parameters
        )
