"""Generated blocks of pages: what stands between two markers is written by a command.

<!-- design-table:begin (written by: python -m benchmarks design) -->
<!-- design-table:end -->
"""

from __future__ import annotations

import re
from collections.abc import Callable


def pattern(name: str) -> re.Pattern[str]:
    """Matches each block of that name: its first marker, what the marker says, its second one."""
    return re.compile(
        rf"(<!-- {re.escape(name)}:begin ?(.*?) ?-->)\n.*?(<!-- {re.escape(name)}:end -->)",
        re.DOTALL,
    )


def fill(page: str, name: str, body: Callable[[str], str], begin: str = "") -> str:
    """A page with its blocks of that name written afresh.

    Args:
        page: the text.
        name: of the blocks.
        body: what belongs into a block, by what its first marker says beside the name.
        begin: stands in place of the first marker.
    """

    def write(match: re.Match[str]) -> str:
        return f"{begin or match[1]}\n\n{body(match[2]).strip()}\n\n{match[3]}"

    return pattern(name).sub(write, page)
