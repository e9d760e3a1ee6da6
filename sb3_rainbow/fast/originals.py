"""Whether networks and policies are the package's own, with nothing overridden or replaced."""

from collections.abc import Iterable
from functools import cache
from typing import Any

from torch import nn
from torch.nn.modules import module as torch_module

_HOOKS = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
_GLOBAL_HOOKS = ("_global_forward_hooks", "_global_forward_pre_hooks", "_global_backward_hooks")


@cache
def _methods(kind: type) -> frozenset[str]:
    return frozenset(name for name in dir(kind) if callable(getattr(kind, name, None)))


def _hooks(modules: Iterable[nn.Module]) -> list[dict[Any, Any]]:
    own = [getattr(m, name) for m in modules for name in _HOOKS]
    return own + [getattr(torch_module, name) for name in _GLOBAL_HOOKS]


def are_untouched(modules: Iterable[nn.Module]) -> bool:
    """Whether modules have no hooks, and no attributes in the place of their class's methods."""
    modules = list(modules)
    return not any(_hooks(modules)) and all(
        _methods(type(module)).isdisjoint(vars(module)) for module in modules
    )


def inherits(thing: Any, kind: type, *methods: str) -> bool:
    """Whether an object of a subclass of ``kind`` has these methods of it as they are there."""
    own = all(getattr(type(thing), name) is getattr(kind, name) for name in methods)
    return own and vars(thing).keys().isdisjoint(methods)


class Watch:
    """
    Tells whether a module's parts, types, hooks, attributes and parameters are still the same.

    It costs microseconds, where a walk over the modules costs as much as a matrix product.

    :param root: module to watch, with all that is inside
    """

    def __init__(self, root: nn.Module) -> None:
        self._modules = list(root.modules())
        self._types = [module.__class__ for module in self._modules]
        parts = [m._modules for m in self._modules if m._modules]
        self._parts = [(held, list(held.values())) for held in parts]
        self._dicts = [*map(vars, self._modules), *_hooks(self._modules)]
        self._sizes = list(map(len, self._dicts))
        self._parameters = [m._parameters for m in self._modules if m._parameters]
        self._trained = self._which_train()

    def _which_train(self) -> list[tuple[int, bool]]:
        return [
            (id(p), p is not None and p.requires_grad)
            for held in self._parameters
            for p in held.values()
        ]

    def sees_no_change(self) -> bool:
        """Whether all is as it was when the watch began."""
        return (
            list(map(len, self._dicts)) == self._sizes
            and [module.__class__ for module in self._modules] == self._types
            and all(list(held.values()) == parts for held, parts in self._parts)
            and self._which_train() == self._trained
        )
