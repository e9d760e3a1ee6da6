"""Validation of the twin against the analytic kinematics: drive it to poses, measure the errors.

Poses are start states of the kinematic task. The servos are led there from home in a straight line
of configurations, so the twin has to find each pose by closing its loops.
"""

from typing import NamedTuple

import numpy as np

from coop_env.env import CoopInsertionEnv
from coop_env.physics.joints import Floats
from coop_env.physics.twin import Twin, last

RAMP_STEPS = 250
"""Timesteps of the way from home, 0.5 s, and as many again to come to rest."""


class Validation(NamedTuple):
    """Errors of each pose (n,): what is measured on the twin minus what the kinematics say.

    ``tip``, ``centre`` (the platform's) and ``loop`` (the farthest that a tied joint is apart) in
    m; ``platform`` (its angle) and ``joints`` (the worst of six) in rad.
    """

    tip: Floats
    centre: Floats
    platform: Floats
    joints: Floats
    loop: Floats


def draw_poses(twin: Twin, n: int, seed: int) -> Floats:
    """Start states (n, 6) of the kinematic task on the twin's machine.

    Raises:
        ResetOptionError: the machine has hardly any workspace.
    """
    m = twin.machine
    env = CoopInsertionEnv(geometry=m.rrs, delta=m.delta, task=m.task)
    env.reset(seed=seed)
    poses = []
    for _ in range(n):
        env.reset()
        poses.append(env.configuration)
    return np.array(poses)


def validate(twin: Twin, poses: Floats) -> Validation:
    """Drive each machine of the twin to poses (n, 6), as many at a time as the twin has machines.

    Raises:
        ArgumentError: a pose is out of reach.
    """
    home = twin.machine.home()
    fraction = np.clip(np.arange(1, 2 * RAMP_STEPS + 1) / RAMP_STEPS, 0.0, 1.0)[:, None]
    result = []
    for first in range(0, len(poses), twin.n):
        batch = poses[first : first + twin.n]
        goals = np.concatenate([batch, np.broadcast_to(home, (twin.n - len(batch), 6))])
        for row in range(twin.n):
            twin.joint_positions(goals[row])  # its error names what is out of reach
            twin.place(row, home)
        way = home + fraction * (goals[:, None] - home)
        readings = last(twin.advance(twin.servo_targets(way), len(fraction)))
        joints = np.abs(readings.joints - twin.servo_targets(goals)).max(axis=1)
        loops = [loop_residual(twin, row) for row in range(twin.n)]
        errors = np.array([*twin.errors(readings, goals), joints, loops])
        result.append(np.where(twin.diverged, np.inf, errors)[:, : len(batch)])
    return Validation(*np.concatenate(result, axis=1))


def loop_residual(twin: Twin, row: int) -> float:
    """The farthest that two ends tied by a loop are apart now, m."""
    model, data = twin.inspect(row)
    apart = data.site_xpos[model.eq_obj1id] - data.site_xpos[model.eq_obj2id]
    return float(np.linalg.norm(apart, axis=1).max())
