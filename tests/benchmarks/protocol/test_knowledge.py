"""Each method's masks and memory, in words, as tables print them."""

from __future__ import annotations

from typing import Any

import pytest

from benchmarks.protocol.knowledge import knowledge
from benchmarks.protocol.plan import METHODS, expand, settings
from benchmarks.protocol.presets import load_preset

SAFE = {"mask_singularities": True}
VISITED = {**SAFE, "mask_visited": 64}


@pytest.mark.parametrize(
    ("method", "track", "masks", "memory"),
    [
        ("rainbow", {}, "paper's", "none"),
        ("rainbow", SAFE, "safe", "none"),
        ("greedy", VISITED, "safe", "64 configurations"),
        ("maskable_ppo", {**VISITED, "mask_refused": True}, "safe",
         "64 configurations, refused moves"),
        ("random", {"mask_refused": True}, "paper's", "refused moves"),
        ("dqn", VISITED, "none", "none"),
        ("dqn", {"observation": "markov"}, "none", "filled holes and time"),
        ("optimum", None, "none", "its plan"),
        ("plan_search", VISITED, "none", "its plan"),
    ],
)  # fmt: skip
def test_who_has_a_memory_says_so(
    method: str, track: dict[str, Any] | None, masks: str, memory: str
) -> None:
    found = knowledge(method, track)
    assert (found.masks, found.memory) == (masks, memory)


def test_only_what_remembers_nothing_claims_so() -> None:
    """The settings of every cell are enough to say it; safe and printed have no memory at all."""
    preset = load_preset("cut")
    for cell in expand(preset):
        if cell.method not in METHODS:
            continue
        memory = knowledge(cell.method, settings(preset, cell).get("track")).memory
        forgetful = cell.track in ("printed", "reward", "safe") or cell.method == "dqn"
        assert (memory == "none") == forgetful, cell.id
