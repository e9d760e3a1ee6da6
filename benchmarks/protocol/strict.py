"""Mappings to frozen dataclasses, strictly, by pydantic: what a file gets wrong is one line.

A dataclass to be read is a :class:`Strict`. Values are of their own type, with one
exception: YAML 1.1 reads 1e-4 as text, and a scientist means a :data:`Number`.
"""

from __future__ import annotations

import dataclasses
import json
import typing
from collections.abc import Mapping
from contextlib import suppress
from typing import Annotated, Any, ClassVar, Final, TypeVar

from pydantic import (
    AfterValidator,
    BeforeValidator,
    ConfigDict,
    Field,
    TypeAdapter,
    ValidationError,
)
from pydantic_core import ErrorDetails

from benchmarks.errors import BenchmarkError, known

T = TypeVar("T")

# pydantic's kinds of error -> what it had expected
_TYPES: Final = {
    **{"int_type": "int", "float_type": "float", "bool_type": "bool", "string_type": "str"},
    **{"list_type": "a list", "dict_type": "a mapping", "dataclass_type": "a mapping"},
}
_RANGES: Final = {
    "greater_than": "must be above {gt}",
    "greater_than_equal": "must be {ge} or above",
    "less_than_equal": "must be {le} or below",
    "literal_error": "is unknown; known: {expected}",
}


class Strict:
    """A dataclass that a file is read into: no other key, no value of another type."""

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid", strict=True)


def _from_text(value: object) -> object:
    if isinstance(value, str):
        with suppress(ValueError):
            return float(value)
    return value


def _numbers(value: Any) -> Any:
    """As :data:`Number`, of each value in mappings and lists."""
    if isinstance(value, dict):
        return {key: _numbers(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_numbers(each) for each in value]
    return _from_text(value)


def differ(values: list[Any]) -> list[Any]:
    """The values, if there are some and no two are equal."""
    if not values or len(set(values)) != len(values):
        raise ValueError("must be some, and differ")
    return values


Number = Annotated[float, BeforeValidator(_from_text)]
Positive = Annotated[Number, Field(gt=0.0)]
AtLeast0 = Annotated[Number, Field(ge=0.0)]
Share = Annotated[Number, Field(ge=0.0, le=1.0)]
Arguments = Annotated[dict[str, Any], AfterValidator(_numbers)]  # of a constructor
Count = Annotated[int, Field(gt=0)]
Names = Annotated[list[str], AfterValidator(differ)]
Seeds = Annotated[list[Annotated[int, Field(ge=0)]], AfterValidator(differ)]


def build(cls: type[T], data: object, where: str) -> T:
    """Build the dataclass ``cls`` from ``data``, checking every key and every value.

    Args:
        cls: a dataclass; nested dataclasses, ``dict[str, dataclass]`` and lists of them are built.
        data: what YAML gave.
        where: the place in words (the file) that an error names.

    Raises:
        BenchmarkError: a key is unknown or missing, or a value has the wrong type or range.
    """
    try:
        # as JSON: of Python's own objects pydantic's strict mode takes no mapping for a dataclass
        text = json.dumps(data, default=str)
        return TypeAdapter(cls).validate_json(text)
    except ValidationError as error:
        # a key that is misspelt is missing, too
        first = min(error.errors(), key=lambda e: e["type"] != "unexpected_keyword_argument")
        raise BenchmarkError(f"{where}: {_in_words(cls, first)}") from None


def _in_words(cls: type, error: ErrorDetails) -> str:
    *above, key = error["loc"] or ("",)
    if isinstance(key, int) and above:
        key = f"{above.pop()}[{key}]"
    path = "".join(f"[{step}]: " if isinstance(step, int) else f"{step}: " for step in above)
    path = path.replace(": [", "[")
    kind, value = error["type"], error["input"]
    if kind == "unexpected_keyword_argument":
        fields = dataclasses.fields(_type_at(cls, error["loc"][:-1]))
        return f"{path}unknown key '{key}'; known keys: {known(f.name for f in fields)}"
    if kind.startswith("missing"):
        return f"{path}key '{key}' is missing"
    if kind in _RANGES:
        return f"{path}{key} = {value!r} {_RANGES[kind].format(**error['ctx'])}"
    what = f"expected {_TYPES[kind]}" if kind in _TYPES else error["msg"]
    return f"{path}{key}: {what.removeprefix('Value error, ')}, found {value!r}".removeprefix(": ")


def _type_at(cls: Any, loc: tuple[int | str, ...]) -> Any:
    """The dataclass that lies at a place of another."""
    for step in loc:
        if dataclasses.is_dataclass(cls):
            cls = typing.get_type_hints(cls)[str(step)]
            # of "X | None" and the like, what is not None
            options = [a for a in typing.get_args(cls) if dataclasses.is_dataclass(a)]
            if typing.get_origin(cls) not in (list, dict) and options:
                cls = options[0]
        else:  # a list or a mapping
            cls = typing.get_args(cls)[-1]
    return cls


def merge(base: Mapping[str, Any], override: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with ``override`` laid over it, mapping by mapping."""
    merged = dict(base)
    for key, value in override.items():
        old = merged.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            merged[key] = merge(old, value)
        else:
            merged[key] = value
    return merged
