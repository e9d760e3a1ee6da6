"""The named errors of the environment, and the checks of single values that raise them.

Each is a ``ValueError`` whose message names the value and the fix.
"""

import math
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from numbers import Real
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from gymnasium.error import DependencyNotInstalled

T = TypeVar("T")
LARGEST = 2**31 - 1
_NONE: Mapping[Any, Any] = MappingProxyType({})


class ArgumentError(ValueError):
    """A constructor argument of the environment is unknown, out of range or of the wrong kind."""


class RewardError(ArgumentError):
    """An unknown reward, an unknown key of ``reward_kwargs``, or a scale that makes no sense."""


class ActionError(ValueError):
    """An action outside the action space, of an unknown agent, or of an agent that is done."""


class ResetOptionError(ValueError):
    """A reset option that is unknown, malformed, or names a state that cannot be taken."""


class StateError(ValueError):
    """A snapshot that does not fit the environment it is loaded into."""


@contextmanager
def imports(why: str, extra: str, kind: type[Exception] = DependencyNotInstalled) -> Iterator[None]:
    """Turn a failed import into an error that says why, and names the extra to install."""
    try:
        yield
    except ImportError as error:
        raise kind(f"{why} pip install 'sb3-rainbow-coop[{extra}]': {error}") from error


def check_number(
    name: str,
    value: Any,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    above: bool = False,
    error: type[ValueError] = ArgumentError,
) -> float:
    """The value as a finite float within ``low`` to ``high``; ``above``: without ``low`` itself."""
    if isinstance(value, bool) or not isinstance(value, Real):
        raise error(f"{name} = {value!r}: must be a number")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not (math.isfinite(number) and low <= number <= high) or (above and number == low):
        if math.isinf(low) and math.isinf(high):
            raise error(f"{name} = {value!r}: must be finite")
        least = f"above {low:g}" if above else f"at least {low:g}"
        most = "finite" if math.isinf(high) else f"at most {high:g}"
        raise error(f"{name} = {value!r}: must be {least} and {most}")
    return number


def keep_number(
    owner: object, name: str, low: float = -math.inf, high: float = math.inf, **options: Any
) -> None:
    """Check a frozen dataclass's field as :func:`check_number` does, and keep it as a float."""
    where = f"{type(owner).__name__}.{name}"
    number = check_number(where, getattr(owner, name), low, high, **options)
    object.__setattr__(owner, name, number)


def check_integer(
    name: str,
    value: Any,
    low: int,
    high: int = LARGEST,
    *,
    hint: str = "",
    error: type[ValueError] = ArgumentError,
) -> int:
    """The value as an int within ``low`` to ``high``; ``hint`` says what the numbers mean."""
    number = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not (number and low <= value <= high):
        raise error(f"{name} = {value!r}: must be an integer from {low} to {high}{hint}")
    return int(value)


def check_list(
    name: str, value: Any, of: str, n: int | None = None, error: type[ValueError] = ArgumentError
) -> list[Any]:
    """The entries (``n`` of them, if given) of a collection; texts and mappings are refused."""
    one = isinstance(value, (str, bytes, Mapping)) or getattr(value, "ndim", 1) == 0
    if one or not isinstance(value, Collection) or n not in (None, len(value)):
        raise error(f"{name} = {value!r}: must be {of}")
    return list(value)


def check_keys(
    name: str, given: Iterable[Any], known: Sequence[str], error: type[ValueError] = ArgumentError
) -> None:
    """Refuse keys that are not among the known ones."""
    if unknown := sorted({str(key) for key in given if key not in known}):
        raise error(f"{name} has unknown keys {unknown}; known: {[*known]}")


def check_flag(name: str, value: Any) -> bool:
    """The value, if it is True or False; 0 and 1 are not."""
    if not isinstance(value, bool | np.bool_):
        raise ArgumentError(f"{name} = {value!r}: must be True or False")
    return bool(value)


def as_dataclass(name: str, value: Any, kind: type[T], presets: Mapping[Any, T] = _NONE) -> T:
    """A dataclass of ``kind``, from itself, a preset's name (or None), or a mapping of fields."""
    if isinstance(value, kind):
        return value
    if isinstance(value, str | None) and value in presets:
        return presets[value]
    if not isinstance(value, Mapping):
        names = "".join(f"{preset!r}, " for preset in presets)
        kinds = f"{names}a {kind.__name__} or a mapping of its fields"
        raise ArgumentError(f"{name} = {value!r}: must be {kinds}")
    check_keys(name, value, [f.name for f in fields(kind)])  # type: ignore[arg-type]
    try:
        return kind(**value)
    except TypeError as missing:
        raise ArgumentError(f"{name} = {dict(value)!r}: {missing}") from missing
