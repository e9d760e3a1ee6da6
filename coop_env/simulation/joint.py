"""Both robots moving in one tick: joint actions, the batch's step and the masks of a team.

An agent's choices 0 to 5 are the moves of its robot's three axes in the order of the single agent's
actions, and 6 holds. A joint action is ``7 delta + rrs``.
"""

from typing import Final

import numpy as np

from coop_env.compilation import njit
from coop_env.kinematics import delta_kernels, rrs_kernels
from coop_env.simulation import dynamics, observation, state
from coop_env.simulation.collision import below_ceiling, collides
from coop_env.simulation.state import HOLD, Record
from coop_env.simulation.task import N_ACTIONS, EnvParams, unpack

N_CHOICES: Final = 7
N_JOINT: Final = N_CHOICES * N_CHOICES
HOLD_CHOICE: Final = 6
DELTA: Final = 0
RRS: Final = 1


@njit(cache=True)
def move_of(agent: int, choice: int) -> int:
    """The single agent's action of a choice of the agent DELTA or RRS, or HOLD."""
    return HOLD if choice == HOLD_CHOICE else 6 * agent + choice


def as_joint(action: int) -> int:
    """The joint action of a single agent's action, while the other robot holds."""
    rrs, choice = divmod(action, 6)
    return N_CHOICES * HOLD_CHOICE + choice if rrs else N_CHOICES * choice + HOLD_CHOICE


@njit(cache=True)
def step(s: Record, action: int, p: EnvParams, out: Record) -> None:
    """:func:`coop_env.simulation.dynamics.step` with a joint action, 0 to 48."""
    delta = move_of(DELTA, action // N_CHOICES)
    dynamics.tick(s, delta, move_of(RRS, action % N_CHOICES), p, out)


@njit(cache=True)
def step_batch(
    states: np.ndarray, actions: np.ndarray, packed: np.ndarray, o: np.ndarray,
    outcomes: np.ndarray, rows: np.ndarray,
) -> None:  # fmt: skip
    """:func:`coop_env.simulation.batch.step_batch` with joint actions (n,), 0 to 48."""
    p = unpack(packed)
    for i in range(states.shape[0]):
        step(states[i], actions[i], p, outcomes[i])
        observation.observe(states[i], p, o, rows[i])


@njit(cache=True)
def _own_limits(s: Record, move: int, p: EnvParams) -> bool:
    """Whether a robot can make a move, as far as it knows without sight of the other."""
    c = state.neighbour(s, move, p)
    if move < 6:
        return state.delta_valid(c, p)
    if not state.rrs_valid(c, p):
        return False
    return not p.task.mask_singularities or not state.is_singular(
        rrs_kernels.sigma_at(c[3], c[4], c[5], p.rrs), p
    )


@njit(cache=True)
def agent_masks(states: np.ndarray, packed: np.ndarray, sight: bool, masks: np.ndarray) -> None:
    """Write ``masks (n, 2, 7)``: True where a choice keeps the robot's limits, as far as it knows.

    With ``p.task.mask_singularities`` these include the 3-RRS's singularities, and with ``sight``
    also collisions with the other robot where it stands. Holding is always allowed.
    """
    p = unpack(packed)
    coupled = p.task.mask_singularities
    for i in range(states.shape[0]):
        s = states[i]
        # The single agent's mask holds for each robot, unless full: then perhaps nothing is valid.
        informed = s.mask.sum() < N_ACTIONS
        for move in range(N_ACTIONS):
            if informed and (s.mask[move] == 1 or sight or not coupled):
                allowed = s.mask[move] == 1
            elif sight and coupled:
                allowed = state.is_safe(s, move, p)
            else:
                allowed = _own_limits(s, move, p)
            masks[i, move // 6, move % 6] = allowed
        masks[i, :, HOLD_CHOICE] = True


@njit(cache=True)
def joint_masks(states: np.ndarray, packed: np.ndarray, masks: np.ndarray) -> None:
    """Write ``masks (n, 49)``: True where both robots' limits allow a joint action.

    With ``p.task.mask_singularities`` True means that the tick ends in a configuration of status
    VALID: no collision of both moves made at once, and no singular pose.
    """
    p = unpack(packed)
    own = np.empty((1, 2, N_CHOICES), np.bool_)
    for i in range(states.shape[0]):
        agent_masks(states[i : i + 1], packed, False, own)
        for action in range(N_JOINT):
            delta, rrs = action // N_CHOICES, action % N_CHOICES
            masks[i, action] = own[0, DELTA, delta] and own[0, RRS, rrs]
        if p.task.mask_singularities:
            _forbid_collisions(states[i], p, masks[i])
            agent_masks(states[i : i + 1], packed, True, own)  # beside a robot that holds
            masks[i, HOLD_CHOICE::N_CHOICES] = own[0, DELTA]
            masks[i, N_CHOICES * HOLD_CHOICE :] = own[0, RRS]


@njit(cache=True)
def _forbid_collisions(s: Record, p: EnvParams, mask: np.ndarray) -> None:
    """Remove from ``mask (49,)`` the joint actions in which both move and then touch."""
    thetas = np.empty((N_CHOICES, 3))  # found once for each move, not for each pair
    for delta in range(HOLD_CHOICE):
        d = state.neighbour(s, move_of(DELTA, delta), p)
        _, theta = delta_kernels.inverse(d[0], d[1], d[2], p.delta)
        for k in range(3):
            thetas[delta, k] = theta[k]
    for rrs in range(HOLD_CHOICE):
        r = state.neighbour(s, move_of(RRS, rrs), p)
        pose = rrs_kernels.platform_pose(r[3], r[4], r[5], p.rrs)
        _, q = rrs_kernels.inverse(pose, p.rrs)
        for delta in range(HOLD_CHOICE):
            action = N_CHOICES * delta + rrs
            d = state.neighbour(s, move_of(DELTA, delta), p)
            if mask[action] and below_ceiling((d[0], d[1], d[2], r[3], r[4], r[5]), p):
                theta = (thetas[delta, 0], thetas[delta, 1], thetas[delta, 2])
                mask[action] = not collides(d[0], d[1], d[2], theta, pose, q, p)
