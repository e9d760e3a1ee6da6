"""A planner's answer; a planner is anything whose ``plan(env)`` gives one and leaves env alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Plan:
    """A planner's answer for the environment's current target.

    Attributes:
        status: ``"solved"``, or why there is no plan.
        moves: (n,) actions to execute in order, or None without a plan.
        seconds: wall-clock time of the planning call.
        detail: anything else a planner wants to say (iterations, nodes, causes).
    """

    status: str
    moves: NDArray[np.int64] | None
    seconds: float
    detail: dict[str, Any] = field(default_factory=dict)
