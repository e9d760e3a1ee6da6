"""How far apart the two robots' bodies are, all pairs of them: a slow reference."""

import numpy as np
from numpy.typing import NDArray

from coop_env import CoopInsertionEnv
from coop_env.simulation.collision import point_segment_distance, segment_distance

Points = NDArray[np.float64]


def gap(
    env: CoopInsertionEnv, at: Points, arms: Points, centre: Points, limbs: Points,
    mouths: Points, chamfer: float,
) -> float:  # fmt: skip
    """Least gap between the two robots' bodies, all with all, with the chamfer's exemption.

    Of the effector ``at``, a dome's ``centre``, and the points (3, 3, 3) of arms and limbs.
    """
    peg, task = env.params.delta, env.task
    tip = at - [0.0, 0.0, peg.peg_length]
    upper = [((np.add(tip, [0.0, 0.0, peg.peg_radius]), at), peg.peg_radius)]
    upper += [((at, at), task.effector_radius)]
    upper += [((knee, joint), task.forearm_radius) for _, knee, joint in arms]
    lower = [((centre, joint), task.spoke_radius) for _, _, joint in limbs]
    lower += [((elbow, joint), task.limb_radius) for _, elbow, joint in limbs]
    lower += [((base, elbow), task.limb_radius) for base, elbow, _ in limbs]
    exempt = np.linalg.norm(mouths - tip, axis=1).min() < chamfer + peg.peg_radius
    gaps = [segment_distance(*a, *b) - ra - rb for a, ra in upper for b, rb in lower]
    for a, ra in upper[1:] if exempt else upper:
        gaps.append(point_segment_distance(centre, *a) - ra - task.dome_radius)
    return min(gaps)
