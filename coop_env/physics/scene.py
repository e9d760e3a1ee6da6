"""What there is to see of the twin: where things really are, for the renderers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from coop_env.kinematics import rrs
from coop_env.kinematics.rotations import roll_pitch_yaw_matrix
from coop_env.physics.joints import Floats
from coop_env.physics.twin import Twin, closed_at
from coop_env.rendering.scene import RRS_JOINTS, Scene, posed


def twin_scene(
    twin: Twin, row: int, command: Floats, hole: int, time: float, status: str,
    trace: Sequence[Floats],
) -> Scene:  # fmt: skip
    """The scene of one machine: links as the measured joints close them, on the real base.

    Platform, dome, holes and tip are the simulation's own. ``command`` is the configuration (6,)
    that the machine was given, ``hole`` its target.
    """
    machine = twin.machine
    readings, p = twin.readings(), machine.kernel_params()
    closed = closed_at(readings.joints[row], command, machine)
    configuration = np.where(np.isfinite(closed), closed, command)
    fields = posed(configuration, p, trace)
    turn = roll_pitch_yaw_matrix([*twin.base[row, 3:], 0.0])
    for name in RRS_JOINTS:
        fields[name] = fields[name] @ turn.T + twin.base[row, :3]
    rotation, centre = readings.rotation[row], readings.platform[row]
    normals = np.array(machine.task.hole_normals) @ rotation.T
    mouths = centre + machine.task.dome_radius * normals
    target = np.arange(len(normals)) == hole
    tip = readings.tip[row]
    fields |= {"platform_centre": centre.copy(), "platform_rotation": rotation.copy()}
    return Scene(
        **fields,
        tip=tip.copy(),
        hole_mouths=mouths,
        hole_normals=normals,
        active=target,
        filled=target & (status == "success"),
        target=hole,
        distance=float(np.linalg.norm(mouths[hole] - tip)),
        alignment_error=float(np.arccos(np.clip(normals[hole, 2], -1.0, 1.0))),
        sigma_min=float(rrs.signed_sigma_min(configuration[3:], machine.rrs)),
        time=time,
        status=status,
    )
