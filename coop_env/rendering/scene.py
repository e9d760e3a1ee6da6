"""What there is to see: every body of the scene as plain numbers, for renderers and figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coop_env.kinematics.rrs_kernels import Pose, limb_points
from coop_env.simulation.collision import arm_points
from coop_env.simulation.state import joint_angles
from coop_env.simulation.task import EnvParams

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scene:
    """One instant. World frame (the 3-RRS's base), m, rad, s; limbs at 0, 120 and 240 degrees.

    ``status`` is ``"running"``, ``"success"`` (all active holes filled), ``"singular"`` or
    ``"timeout"``. With sim-to-real knobs tip and holes are the real ones, links the model's.
    """

    delta_base_joints: Points  # (3, 3)
    knees: Points  # (3, 3)
    effector_joints: Points  # (3, 3)
    effector: Points  # (3,)
    tip: Points  # (3,)
    peg_radius: float
    rrs_base_joints: Points  # (3, 3)
    elbows: Points  # (3, 3)
    platform_joints: Points  # (3, 3)
    platform_centre: Points  # (3,)
    platform_rotation: Points  # (3, 3)
    dome_radius: float
    hole_mouths: Points  # (holes, 3)
    hole_normals: Points  # (holes, 3), outward unit vectors
    chamfer: float
    active: NDArray[np.bool_]  # (holes,)
    filled: NDArray[np.bool_]  # (holes,)
    target: int
    distance: float
    alignment_error: float
    sigma_min: float
    singular_margin: float
    configuration: Points  # (6,)
    time: float
    status: str
    trace: Points  # (k, 3): where the tip has been this episode, if the environment kept it

    def describe(self) -> str:
        """The instant as a few lines of text (render mode ``"ansi"``)."""
        x, y, z, roll, pitch, heave = self.configuration
        holes = " ".join(
            f"{i}{'*' if i == self.target else ''}{'#' if f else 'o' if a else '.'}"
            for i, (a, f) in enumerate(zip(self.active, self.filled, strict=True))
        )
        return (
            f"t {self.time:5.1f} s  {self.status}\n"
            f"delta  x {x:+.3f} y {y:+.3f} z {z:+.3f} m\n"
            f"3-RRS  roll {roll:+.3f} pitch {pitch:+.3f} rad, heave {heave:.3f} m, "
            f"sigma_min {self.sigma_min:+.3f}\n"
            f"target {self.target}: {1e3 * self.distance:.1f} mm, "
            f"{np.degrees(self.alignment_error):.1f} deg\n"
            f"holes  {holes}  (# filled, o open, . inactive, * target)\n"
        )


def _status(state: np.void, sigma: float, margin: float) -> str:
    if not state["over"]:
        return "running"
    if not np.any((state["active"] == 1) & (state["filled"] == 0)):
        return "success"
    return "timeout" if sigma >= margin else "singular"


def link_points(configuration: Points, p: EnvParams) -> tuple[Points, Points, Pose]:
    """Where a configuration (6,) puts the links of both robots, world frame, m.

    Returns:
        base joint, knee and effector joint of each Delta limb, (3, 3, 3); base joint, elbow and
        platform joint of each 3-RRS limb, (3, 3, 3); the platform's pose.
    """
    x, y, z, roll, pitch, heave = configuration.tolist()
    _, theta, pose, q = joint_angles((x, y, z, roll, pitch, heave), p)
    arms = np.array([arm_points(x, y, z, theta, i, p.delta) for i in range(3)])
    limbs = np.array([limb_points(pose, q[i], i, p.rrs) for i in range(3)])
    return arms, limbs, pose


def make_scene(state: np.void, p: EnvParams, trace: Sequence[Points] = ()) -> Scene:
    """The scene of a row of state; ``trace``: the tip's path."""
    arms, limbs, pose = link_points(state["configuration"], p)
    sigma, margin = float(state["sigma"]), float(p.layout["singular_margin"])
    return Scene(
        delta_base_joints=arms[:, 0],
        knees=arms[:, 1],
        effector_joints=arms[:, 2],
        effector=state["configuration"][:3] + np.array([0.0, 0.0, p.delta.base_height]),
        tip=state["tip"].copy(),
        peg_radius=p.delta.peg_radius,
        rrs_base_joints=limbs[:, 0],
        elbows=limbs[:, 1],
        platform_joints=limbs[:, 2],
        platform_centre=np.array(pose[:3]),
        platform_rotation=np.array(pose[3:]).reshape(3, 3),
        dome_radius=float(p.layout["dome_radius"]),
        hole_mouths=state["mouths"].copy(),
        hole_normals=state["normals"].copy(),
        chamfer=p.task.chamfer,
        active=state["active"].astype(bool),
        filled=state["filled"].astype(bool),
        target=int(state["target"]),
        distance=float(state["distance"]),
        alignment_error=float(state["angle"]),
        sigma_min=sigma,
        singular_margin=margin,
        configuration=state["configuration"].copy(),
        time=float(state["moves"]) * float(p.layout["dt"]),
        status=_status(state, sigma, margin),
        trace=np.array(trace, np.float64).reshape(-1, 3),
    )
