"""Whether a number that the paper prints can be ours: its rounding against our interval."""

from __future__ import annotations

import math
import re
from typing import Final

from benchmarks.reporting.stats import Value

_NUMBER: Final = re.compile(r"-?\d+(?:\.(\d+))?")


def printed_range(text: str) -> tuple[float, float] | None:
    """The numbers that round to what is printed: half a unit of the last digit to either side.

    >>> printed_range("1.16 ± 0.05")
    (1.155, 1.165)

    Returns:
        Lower and upper end, or None where nothing is printed.
    """
    match = _NUMBER.match(text)
    if match is None:
        return None
    digits = len(match.group(1) or "")
    half = 0.5 * 10.0**-digits
    number = float(match.group(0))
    return round(number - half, digits + 1), round(number + half, digits + 1)


def outside(value: Value, paper: str) -> bool:
    """Whether no number that rounds to the printed one lies in our interval."""
    printed = printed_range(paper)
    if printed is None or math.isnan(value.low):
        return False
    return printed[1] < value.low or printed[0] > value.high


def printed_spread(text: str) -> float:
    """The spread behind the ±, or 0 where none is printed.

    >>> printed_spread("95 ± 2")
    2.0
    """
    _, sign, spread = text.partition(" ± ")
    return float(spread) if sign else 0.0
