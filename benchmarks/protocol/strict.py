"""Mappings to frozen dataclasses, strictly, by pydantic; each mistake in a file is one line."""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

from pydantic import ConfigDict, TypeAdapter, ValidationError, model_validator
from pydantic_core import ErrorDetails

from benchmarks.errors import BenchmarkError, known

T = TypeVar("T")


class Strict:
    """A dataclass read from a file: unknown keys and values of other types are errors."""

    __pydantic_config__: ClassVar = ConfigDict(extra="forbid", strict=True)

    @model_validator(mode="before")
    @classmethod
    def _no_other_key(cls: Any, data: Any) -> Any:
        names = [field.name for field in dataclasses.fields(cls)]
        if isinstance(data, dict) and (unknown := data.keys() - names):
            own = [name for name in names if name != "name"]  # a preset has its file's
            raise ValueError(f"unknown key '{min(unknown)}'; known keys: {known(own)}")
        return data


def build(cls: type[T], data: object, where: str) -> T:
    """Build the dataclass ``cls``, and those in it, from what YAML gave; errors name ``where``.

    Raises:
        BenchmarkError: a key is unknown or missing, or a value has the wrong type or range.
    """
    try:
        # as JSON: of Python's own objects pydantic's strict mode takes no mapping for a dataclass
        text = json.dumps(data, default=str)
    except (ValueError, RecursionError) as error:  # an anchor that holds itself
        raise BenchmarkError(f"{where}: {error}") from None
    try:
        return TypeAdapter(cls).validate_json(text)
    except ValidationError as error:
        raise BenchmarkError(f"{where}{_to_line(error.errors()[0])}") from None


def _to_line(error: ErrorDetails) -> str:
    """``: key: key[0]: what is wrong, found value``; of a mapping, the keys alone."""
    path = "".join(f"[{key}]" if isinstance(key, int) else f": {key}" for key in error["loc"])
    found = "" if isinstance(error["input"], dict) else f", found {error['input']!r}"
    return f"{path}: {error['msg'].removeprefix('Value error, ')}{found}"


def merge(base: Mapping[str, Any], override: Mapping[str, Any]) -> dict[str, Any]:
    """``base`` with ``override`` laid over it, mapping by mapping."""
    merged = {**base, **override}
    for key in base.keys() & override.keys():
        if isinstance(base[key], Mapping) and isinstance(override[key], Mapping):
            merged[key] = merge(base[key], override[key])
    return merged
