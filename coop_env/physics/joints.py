"""All joint angles of the twin's tree at a configuration, from the analytic kinematics.

The tree hangs the platform on the 3-RRS's limb 0 by a ball joint and the Delta's effector on three
slides; the other limbs' ends are tied to them. A rod of the Delta is one link on a universal joint,
the middle line of its parallelogram.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from coop_env.geometry import DeltaGeometry, RRSGeometry
from coop_env.kinematics import delta, rrs
from coop_env.kinematics.rrs_kernels import LIMB_COS, LIMB_SIN

Floats = NDArray[np.float64]

RADIAL: Floats = np.column_stack([LIMB_COS, LIMB_SIN, np.zeros(3)])
TANGENTIAL: Floats = np.column_stack([-RADIAL[:, 1], RADIAL[:, 0], np.zeros(3)])
"""u_i and t_i of the limbs by rows, (3, 3)."""
UP: Floats = np.array([0.0, 0.0, 1.0])


class TreeAngles(NamedTuple):
    """Joint angles of both robots, (3,) by limb, rad, and the platform's rotation (3, 3)."""

    q: Floats
    elbow: Floats  # of the distal link from the proximal one
    rotation: Floats
    theta: Floats
    swing: Floats  # of a rod in the plane of its limb
    sway: Floats  # and out of it


def tree_angles(
    configuration: Sequence[float] | Floats, rrs_geometry: RRSGeometry, robot: DeltaGeometry
) -> TreeAngles:
    """Angles of all joints at (x, y, z, roll, pitch, heave); NaN where a robot cannot reach."""
    position, pose = np.split(np.asarray(configuration, np.float64), 2)
    q = rrs.inverse(pose, rrs_geometry).q
    _, elbow, ball = np.moveaxis(rrs.limb_points(pose, rrs_geometry), 1, 0)
    distal = ball - elbow
    rise = np.arctan2(distal[:, 2], np.sum(distal * RADIAL, axis=1))
    theta = delta.inverse(position, robot).theta
    _, knee, end = np.moveaxis(delta.limb_points(position, robot), 1, 0)
    rod = (end - knee) / robot.distal_length
    cos, sin = np.cos(theta)[:, None], np.sin(theta)[:, None]
    along = np.sum(rod * (cos * RADIAL - sin * UP), axis=1)  # in the proximal link's own frame
    across = np.sum(rod * TANGENTIAL, axis=1)
    above = np.sum(rod * (sin * RADIAL + cos * UP), axis=1)
    rotation = rrs.platform_pose(pose, rrs_geometry).rotation
    sway = np.arcsin(np.clip(across, -1.0, 1.0))
    return TreeAngles(q, rise - q, rotation, theta, np.arctan2(-above, along), sway)


def platform_mount(angles: TreeAngles) -> Floats:
    """Rotation (3, 3) of limb 0's distal link in the 3-RRS's base frame."""
    rise = angles.q[0] + angles.elbow[0]
    c, s = float(np.cos(rise)), float(np.sin(rise))
    return np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
