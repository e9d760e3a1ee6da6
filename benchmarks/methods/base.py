"""What methods share: policy types, a planner's answer, the box it searches, the peg's miss."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop_env.compilation import njit
from coop_env.kinematics.rrs_kernels import platform_pose
from coop_env.kinematics.singularity import Row
from coop_env.simulation.collision import hole, peg_tip
from coop_env.simulation.state import Configuration, alignment_angle
from coop_env.simulation.task import EnvParams

Observations = NDArray[np.float32]
Masks = NDArray[np.bool_]
#: actions (n,) for observations (n, size) and masks (n, actions)
Policy = Callable[[Observations, Masks], NDArray[Any]]
#: the same, with the indices (n,) of their episodes as a third argument
Chooser = Callable[[Observations, Masks, Sequence[int]], NDArray[Any]]


@dataclass(frozen=True)
class Plan:
    """A planner's answer for the current target; planning does not change the environment."""

    status: str  # "solved", or why there is no plan
    moves: NDArray[np.int64] | None  # (n,) actions to execute in order, or None without a plan
    seconds: float  # wall-clock time of the planning call


def modelled(p: EnvParams) -> EnvParams:
    """The parameters of the machine as its controller's model has it."""
    return p._replace(task=p.task._replace(imperfect=False))


def workspace(p: EnvParams) -> NDArray[np.float64]:
    """Lower and upper bounds (2, 6) of the configuration space, SI units."""
    d, r = p.delta, p.rrs
    reach, drop = d.proximal_length + d.distal_length, abs(d.proximal_length - d.distal_length)
    low = [-d.planar_limit, -d.planar_limit, -reach, -r.max_tilt, -r.max_tilt, r.heave_min]
    high = [d.planar_limit, d.planar_limit, -drop, r.max_tilt, r.max_tilt, r.heave_max]
    return np.array([low, high])


@njit(cache=True)
def tip_distance(effector: Row, mouth: Row, p: EnvParams) -> float:
    """Distance of the peg's tip from a hole's mouth, where the effector is at a point."""
    tip = peg_tip(effector[0], effector[1], effector[2], p.delta)
    dx, dy, dz = mouth[0] - tip[0], mouth[1] - tip[1], mouth[2] - tip[2]
    return math.sqrt(dx * dx + dy * dy + dz * dz)


@njit(cache=True)
def misses(c: Configuration, target: int, p: EnvParams) -> tuple[float, float]:
    """Distance and angle of the peg from the target at a configuration, as the model has it."""
    mouth, n = hole(platform_pose(c[3], c[4], c[5], p.rrs), target, p)
    distance = tip_distance((c[0], c[1], c[2]), mouth, p)
    return distance, alignment_angle(n[0], n[1], n[2])
