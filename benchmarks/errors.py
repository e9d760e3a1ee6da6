"""The one exception that a user's mistake raises; the command line turns it into exit code 2."""

from __future__ import annotations

from collections.abc import Iterable


class BenchmarkError(ValueError):
    """Bad input: the message names the value and the mend, and nothing has been written."""


def known(names: Iterable[str]) -> str:
    """``a, b, c`` in a stable order, for the tail of a message."""
    return ", ".join(sorted(names))
