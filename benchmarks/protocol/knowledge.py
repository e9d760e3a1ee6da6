"""What a method knows beside the observation: its masks, and what it remembers of the episode.

A memory is any dependence of an action on what happened earlier in the episode, be it in the masks,
the policy or the observation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from benchmarks.protocol.learners import LEARNERS
from benchmarks.protocol.plan import CONTROLS, PLANNERS


@dataclass(frozen=True)
class Knowledge:
    """Masks and memory of a row of a table, in words."""

    masks: str
    memory: str


def knowledge(method: str, track: Mapping[str, Any] | None) -> Knowledge:
    """What a method knows on a track.

    Args:
        method: of :data:`benchmarks.protocol.plan.METHODS`; any other is taken to plan.
        track: ``config["track"]`` of a run, where keys at their defaults may be missing; None for
            planners that have no track.
    """
    if method in PLANNERS or track is None:
        return Knowledge("none", "its plan")
    remembered = []
    masks = "none"
    if method not in LEARNERS or LEARNERS[method].masks:
        masks = "safe" if track.get("mask_singularities") else "paper's"
        if visited := track.get("mask_visited"):
            remembered.append(f"{visited} configurations")
        if track.get("mask_refused"):
            remembered.append("refused moves")
    if method in LEARNERS and track.get("observation") == "markov":
        remembered.append("filled holes and time")
    return Knowledge(masks, ", ".join(remembered) or "none")


def explores(method: str) -> bool:
    """Whether a method has another way of acting: as it was trained, or with random moves."""
    return method in LEARNERS or (method in CONTROLS and method != "random")
