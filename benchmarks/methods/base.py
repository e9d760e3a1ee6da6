"""A planner's answer, and the box it searches; ``plan(env)`` gives the one and leaves env alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop_env.simulation.task import EnvParams


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


def workspace(p: EnvParams) -> NDArray[np.float64]:
    """Lower and upper bounds (2, 6) of the configuration space, SI units."""
    d, r = p.delta, p.rrs
    reach, drop = d.proximal_length + d.distal_length, abs(d.proximal_length - d.distal_length)
    low = [-d.planar_limit, -d.planar_limit, -reach, -r.max_tilt, -r.max_tilt, r.heave_min]
    high = [d.planar_limit, d.planar_limit, -drop, r.max_tilt, r.max_tilt, r.heave_max]
    return np.array([low, high])
