"""Compiled inner loops of the replay buffer. A leaf is ``step * n_envs + env``."""

import numpy as np
from numpy.typing import NDArray

from sb3_rainbow.replay.compilation import njit

RUNNING, TERMINATED, TRUNCATED = 0, 1, 2


@njit(cache=True)
def complete_windows(
    pending: NDArray[np.int64],
    ended: NDArray[np.bool_],
    newest: int,
    n_rows: int,
    n_steps: int,
    leaves: NDArray[np.int64],
) -> int:
    """Write to ``leaves`` the transitions whose window is complete once row ``newest`` is stored,
    after n steps or where an episode ``ended``, and return their number.

    ``pending`` counts each env's stored transitions that still wait, ``newest`` included.
    """
    n_envs = pending.shape[0]
    count = 0
    for env in range(n_envs):
        oldest = (newest - pending[env] + 1) % n_rows
        if ended[env]:
            n_complete = pending[env]
        elif pending[env] >= n_steps:
            n_complete = pending[env] - n_steps + 1
        else:
            n_complete = 0
        for k in range(n_complete):
            leaves[count] = ((oldest + k) % n_rows) * n_envs + env
            count += 1
        pending[env] -= n_complete
    return count


@njit(cache=True)
def assemble_windows(
    leaves: NDArray[np.int64],
    rewards: NDArray[np.float32],
    ends: NDArray[np.uint8],
    slots: NDArray[np.int32],
    newest: int,
    n_steps: int,
    gamma: float,
    returns: NDArray[np.float32],
    discounts: NDArray[np.float32],
    dones: NDArray[np.float32],
    last_leaves: NDArray[np.int64],
    next_rows: NDArray[np.int64],
    next_slots: NDArray[np.int64],
) -> None:
    """Sum the rewards of each window, up to the end of its episode, and find its last observation.

    That is in the boundary store (``next_slots >= 0``) where the episode ended or the step is the
    newest of all, else in the following row. A discount is gamma to the number of rewards summed.
    """
    n_rows, n_envs = rewards.shape
    for i in range(leaves.shape[0]):
        row = leaves[i] // n_envs
        env = leaves[i] - row * n_envs
        total = 0.0
        discount = 1.0
        for _ in range(n_steps):
            last = row
            total += discount * rewards[row, env]
            discount *= gamma
            if ends[row, env] != RUNNING:
                break
            row = row + 1 if row + 1 < n_rows else 0
        returns[i] = total
        discounts[i] = discount
        dones[i] = 1.0 if ends[last, env] == TERMINATED else 0.0
        last_leaves[i] = last * n_envs + env
        following = last + 1 if last + 1 < n_rows else 0
        next_rows[i] = following * n_envs + env
        if ends[last, env] != RUNNING:
            next_slots[i] = slots[last, env]
        elif last == newest:
            next_slots[i] = env
        else:
            next_slots[i] = -1


@njit(cache=True)
def importance_weights(
    leaves: NDArray[np.int64],
    masses: NDArray[np.float64],
    beta: float,
    weights: NDArray[np.float32],
) -> None:
    """``(N P(i)) ** -beta`` over their maximum in the batch; N and the total mass cancel."""
    smallest = np.inf
    for i in range(leaves.shape[0]):
        smallest = min(smallest, masses[leaves[i]])
    for i in range(leaves.shape[0]):
        weights[i] = (smallest / masses[leaves[i]]) ** beta


@njit(cache=True)
def scale_priorities(
    leaves: NDArray[np.int64],
    losses: NDArray[np.float64],
    masses: NDArray[np.float64],
    alpha: float,
    epsilon: float,
    kept_leaves: NDArray[np.int64],
    kept_masses: NDArray[np.float64],
) -> tuple[int, float]:
    """``(loss + epsilon) ** alpha`` of the leaves that are still filled; returns their number and
    the largest priority, or -1 and the loss that is negative, infinite or NaN.
    """
    count = 0
    largest = 0.0
    for i in range(leaves.shape[0]):
        loss = losses[i]
        if not (0.0 <= loss < np.inf):
            return -1, loss
        # A leaf may have been overwritten since it was drawn: it must not come alive half-filled.
        if masses[leaves[i]] > 0.0:
            priority = loss + epsilon
            kept_leaves[count] = leaves[i]
            kept_masses[count] = priority**alpha
            largest = max(largest, priority)
            count += 1
    return count, largest
