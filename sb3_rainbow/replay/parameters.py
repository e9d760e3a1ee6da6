"""What a replay buffer can be asked for."""

import math


def check_replay_parameters(
    buffer_size: int,
    n_envs: int,
    n_steps: int,
    gamma: float,
    alpha: float,
    beta: float,
    epsilon: float | None = None,
) -> None:
    """
    :param epsilon: None where only the buffer knows it
    :raises ValueError: naming the first parameter that is out of range
    """
    if n_steps < 1:
        raise ValueError(f"n_steps must be at least 1, got {n_steps}")
    if n_steps != int(n_steps):
        raise ValueError(f"n_steps must be a whole number, got {n_steps}")
    if not 0.0 <= gamma <= 1.0:
        raise ValueError(f"gamma must lie in [0, 1], got {gamma}")
    if not 0.0 <= alpha <= 1.0:
        raise ValueError(f"alpha must lie in [0, 1] (0 is uniform replay), got {alpha}")
    if not 0.0 <= beta <= 1.0:
        raise ValueError(f"beta must lie in [0, 1], got {beta}")
    if epsilon is not None and not 0.0 < epsilon < math.inf:
        # Without it a transition whose loss is zero once would never be drawn again.
        raise ValueError(f"epsilon must be above 0 and finite, got {epsilon}")
    if buffer_size // n_envs <= n_steps:
        raise ValueError(
            f"buffer_size={buffer_size} is too small: {n_envs} envs with n_steps={n_steps} need "
            f"at least {n_envs * (n_steps + 1)}"
        )
