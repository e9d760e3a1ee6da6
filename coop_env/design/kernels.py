"""The flood fill that measures a workspace: visits only the cells it counts, and their rim."""

from __future__ import annotations

from typing import Any

from numba import njit

from coop_env.kinematics import rrs_kernels as rrs


@njit(cache=True)
def admits(roll: float, pitch: float, heave: float, threshold: float, p: rrs.RRSParams) -> bool:
    """Whether a pose is reachable within tilt and joint limits with sigma_min at the threshold."""
    if not (abs(roll) <= p.max_tilt and abs(pitch) <= p.max_tilt):
        return False
    pose = rrs.platform_pose(roll, pitch, heave, p)
    reachable, q = rrs.inverse(pose, p)
    if not (reachable and rrs.joints_within_limits(q, p)):
        return False
    return rrs.signed_sigma_min(pose, q, p) >= threshold


@njit(cache=True)
def flood(
    rolls: Any, pitches: Any, heave: float, threshold: float, p: rrs.RRSParams, mask: Any
) -> int:
    """Mark in ``mask`` the component of the cells about the centre, edge to edge; their number.

    ``rolls`` and ``pitches`` are each cell's sample, ``(n, n)``; ``mask`` is int8 ``(n, n)``, zero
    on entry: 1 marks a cell of the component, -1 one that was tried and is not.
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
        if not admits(rolls[i, j], pitches[i, j], heave, threshold, p):
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
