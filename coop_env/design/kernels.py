"""The flood fill that measures a workspace, and the survey that maps it."""

from __future__ import annotations

import math
from typing import Any

from coop_env.compilation import njit
from coop_env.kinematics import rrs_kernels as rrs
from coop_env.kinematics.singularity import Row


@njit(cache=True)
def _within(roll: float, pitch: float, q: Row, p: rrs.RRSParams) -> bool:
    """Whether tilt and joints are within their limits (NaN is not)."""
    tilted = abs(roll) <= p.max_tilt and abs(pitch) <= p.max_tilt
    return tilted and rrs.joints_within_limits(q, p)


@njit(cache=True)
def admits(roll: float, pitch: float, heave: float, threshold: float, p: rrs.RRSParams) -> bool:
    """Whether a pose is reachable within tilt and joint limits with sigma_min at the threshold."""
    pose = rrs.platform_pose(roll, pitch, heave, p)
    reachable, q = rrs.inverse(pose, p)
    if not (reachable and _within(roll, pitch, q, p)):
        return False
    return rrs.signed_sigma_min(pose, q, p) >= threshold


@njit(cache=True)
def survey(
    rolls: Any,
    pitches: Any,
    heave: float,
    threshold: float,
    p: rrs.RRSParams,
    sigma: Any,
    kappa: Any,
    mask: Any,
) -> None:
    """Signed sigma_min and kappa of every cell, and -1 in ``mask`` where :func:`admits` is False.

    All arrays are ``(n, n)``; NaN where a limb cannot reach.
    """
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            sigma[i, j] = kappa[i, j] = math.nan
            mask[i, j] = -1
            pose = rrs.platform_pose(rolls[i, j], pitches[i, j], heave, p)
            reachable, q = rrs.inverse(pose, p)
            if reachable:
                _, _, sigma[i, j], kappa[i, j] = rrs.singular_state(pose, q, p)
                if sigma[i, j] >= threshold and _within(rolls[i, j], pitches[i, j], q, p):
                    mask[i, j] = 0


@njit(cache=True)
def flood(
    rolls: Any,
    pitches: Any,
    heave: float,
    threshold: float,
    p: rrs.RRSParams,
    mask: Any,
    surveyed: bool,
) -> int:
    """Mark in ``mask`` the component of the cells about the centre, edge to edge; their number.

    ``rolls`` and ``pitches`` are each cell's sample, ``(n, n)``. ``mask`` is int8 ``(n, n)``: 1
    marks a cell of the component, -1 one that is not admitted. Entered all zero, only the
    component and its rim are evaluated; if ``surveyed``, it holds what :func:`survey` left.
    """
    n = mask.shape[0]
    stack = [0] * 0  # typed empty list of int
    count = 0
    for i in range((n - 1) // 2, n // 2 + 1):
        for j in range((n - 1) // 2, n // 2 + 1):
            stack.append(i * n + j)
    while len(stack) > 0:
        cell = stack.pop()
        i, j = cell // n, cell % n
        if mask[i, j] != 0:
            continue
        if not surveyed and not admits(rolls[i, j], pitches[i, j], heave, threshold, p):
            mask[i, j] = -1
            continue
        mask[i, j] = 1
        count += 1
        if i > 0 and mask[i - 1, j] == 0:
            stack.append(cell - n)
        if i < n - 1 and mask[i + 1, j] == 0:
            stack.append(cell + n)
        if j > 0 and mask[i, j - 1] == 0:
            stack.append(cell - 1)
        if j < n - 1 and mask[i, j + 1] == 0:
            stack.append(cell + 1)
    return count
