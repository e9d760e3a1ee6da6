"""The survey of a workspace."""

from __future__ import annotations

import math
from typing import Any

from coop_env.compilation import njit
from coop_env.kinematics import rrs_kernels as rrs


@njit(cache=True)
def survey(
    rolls: Any,
    pitches: Any,
    heave: float,
    threshold: float,
    p: rrs.RRSParams,
    whole: bool,
    sigma: Any,
    kappa: Any,
    admitted: Any,
) -> None:
    """Signed sigma_min and kappa of every cell, and which are admitted.

    A cell is admitted if its pose is reachable within tilt and joint limits (NaN is not) and its
    sigma_min is at least the threshold. All arrays are ``(n, n)``; NaN where a limb cannot reach,
    and unless ``whole``, which takes longer, beyond the limits too.
    """
    for i in range(rolls.shape[0]):
        for j in range(rolls.shape[1]):
            sigma[i, j] = kappa[i, j] = math.nan
            admitted[i, j] = False
            pose = rrs.platform_pose(rolls[i, j], pitches[i, j], heave, p)
            reachable, q = rrs.inverse(pose, p)
            tilted = abs(rolls[i, j]) <= p.max_tilt and abs(pitches[i, j]) <= p.max_tilt
            within = tilted and rrs.joints_within_limits(q, p)
            if reachable and (whole or within):
                _, _, sigma[i, j], kappa[i, j] = rrs.singular_state(pose, q, p)
                admitted[i, j] = within and sigma[i, j] >= threshold
