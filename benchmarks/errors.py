"""The one exception that a user's mistake raises; the command line turns it into exit code 2."""

import argparse
import pkgutil
import sys
from collections.abc import Callable, Iterable
from typing import Any

TRUSTED = "load a --model that SB3 saved, which runs its author's code"  # of --trust


class BenchmarkError(ValueError):
    """Bad input: the message names the value and the fix, and nothing has been written."""


def known(names: Iterable[str]) -> str:
    """``a, b, c`` in a stable order, for the tail of a message."""
    return ", ".join(sorted(names))


def resolve(name: str, what: str) -> Any:
    """What ``module:name`` names, or BenchmarkError; the current folder is searched too."""
    if "" not in sys.path:
        sys.path.insert(0, "")  # a console script does not look into the current folder
    try:
        return pkgutil.resolve_name(name)
    except (ImportError, AttributeError, ValueError) as error:
        raise BenchmarkError(f"{what} '{name}' cannot be imported: {error}") from error


def at_least(least: int) -> Callable[[str], int]:
    """The type of a command's argument: a whole number from ``least``."""

    def parse(text: str) -> int:
        if (number := int(text)) < least:
            raise argparse.ArgumentTypeError(f"{number} is below {least}")
        return number

    parse.__name__ = "int"  # what argparse calls it in a message
    return parse
