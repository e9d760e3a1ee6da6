"""The scene: every body as plain numbers, for renderers and figures."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from coop_env.kinematics.rrs_kernels import limb_points
from coop_env.simulation.collision import arm_points
from coop_env.simulation.state import joint_angles
from coop_env.simulation.task import EnvParams

Points = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Scene:
    """One instant. World frame (the 3-RRS's base), m, rad, s; limbs at 0, 120 and 240 degrees.

    ``status`` is ``"running"``, ``"success"`` (all active holes filled), ``"singular"``,
    ``"collision"``, ``"timeout"`` or a failure of the twin's. With sim-to-real knobs tip and holes
    are the real ones, links the model's.
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


def _status(state: np.void, sigma: float, p: EnvParams, collided: bool) -> str:
    if not state["over"]:
        return "running"
    if not np.any((state["active"] == 1) & (state["filled"] == 0)):
        return "success"
    if sigma < p.layout["singular_margin"]:
        return "singular"
    in_time = state["moves"] < p.task.max_moves or (collided and p.task.fatal)
    return "collision" if in_time else "timeout"


RRS_JOINTS: Final = ("rrs_base_joints", "elbows", "platform_joints")
"""Fields of a scene that hold the points of the 3-RRS's limbs."""


def posed(configuration: Points, p: EnvParams, trace: Sequence[Points]) -> dict[str, Any]:
    """The fields of a :class:`Scene` that follow from where a model has its configuration (6,)."""
    x, y, z, roll, pitch, heave = configuration.tolist()
    _, theta, pose, q = joint_angles((x, y, z, roll, pitch, heave), p)
    arms = np.array([arm_points(x, y, z, theta, i, p.delta) for i in range(3)])
    limbs = np.array([limb_points(pose, q[i], i, p.rrs) for i in range(3)])
    names = ("delta_base_joints", "knees", "effector_joints", *RRS_JOINTS)
    return {
        **dict(zip(names, np.swapaxes(np.concatenate([arms, limbs], axis=1), 0, 1), strict=True)),
        "configuration": configuration.copy(),
        "effector": configuration[:3] + np.array([0.0, 0.0, p.delta.base_height]),
        "peg_radius": p.delta.peg_radius,
        "platform_centre": np.array(pose[:3]),
        "platform_rotation": np.array(pose[3:]).reshape(3, 3),
        "dome_radius": float(p.layout["dome_radius"]),
        "chamfer": p.task.chamfer,
        "singular_margin": float(p.layout["singular_margin"]),
        "trace": np.array(trace, np.float64).reshape(-1, 3),
    }


def make_scene(
    state: np.void, p: EnvParams, trace: Sequence[Points] = (), collided: bool = False
) -> Scene:
    """The scene of a row of state; ``trace``: the tip's path, ``collided``: in the last move."""
    fields, sigma = posed(state["configuration"], p, trace), float(state["sigma"])
    return Scene(
        **fields,
        tip=state["tip"].copy(),
        hole_mouths=state["mouths"].copy(),
        hole_normals=state["normals"].copy(),
        active=state["active"].astype(bool),
        filled=state["filled"].astype(bool),
        target=int(state["target"]),
        distance=float(state["distance"]),
        alignment_error=float(state["angle"]),
        sigma_min=sigma,
        time=float(state["moves"]) * float(p.layout["dt"]),
        status=_status(state, sigma, p, collided),
    )
