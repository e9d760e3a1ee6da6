"""Which settings can work, and what a replay buffer must be told of them."""

from typing import TYPE_CHECKING, Any

from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer

from sb3_rainbow.policies import RainbowPolicy

if TYPE_CHECKING:
    from sb3_rainbow.rainbow import Rainbow

# Constructor arguments that Rainbow hands to its policy
NETWORK_ARGUMENTS = frozenset(
    ("dueling", "noisy", "sigma0", "distributional", "n_atoms", "v_min", "v_max")
)


def check_replay_parameters(
    buffer_size: int, n_envs: int, n_steps: int, gamma: float, alpha: float, beta: float
) -> None:
    """
    :raises ValueError: naming the first parameter that is out of range
    """
    if n_steps < 1:
        raise ValueError(f"n_steps must be at least 1, got {n_steps}")
    if not 0.0 <= gamma <= 1.0:
        raise ValueError(f"gamma must lie in [0, 1], got {gamma}")
    if not 0.0 <= alpha <= 1.0:
        raise ValueError(f"alpha must lie in [0, 1] (0 is uniform replay), got {alpha}")
    if not 0.0 <= beta <= 1.0:
        raise ValueError(f"beta must lie in [0, 1], got {beta}")
    if buffer_size // n_envs <= n_steps:
        raise ValueError(
            f"buffer_size={buffer_size} is too small: {n_envs} envs with n_steps={n_steps} need "
            f"at least {n_envs * (n_steps + 1)}"
        )


def sb3_buffer_kwargs(
    buffer_class: type[ReplayBuffer], prioritized: bool, n_steps: int, gamma: float
) -> dict[str, Any]:
    """
    Arguments by which one of SB3's own buffers learns of the algorithm's settings.

    :raises ValueError: if it cannot serve them
    """
    if prioritized:
        raise ValueError(f"{buffer_class.__name__} keeps no priorities: pass prioritized=False")
    if issubclass(buffer_class, NStepReplayBuffer):
        return {"n_steps": n_steps, "gamma": gamma}
    if n_steps > 1:
        raise ValueError(
            f"{buffer_class.__name__} has no n-step returns: pass n_steps=1 "
            f"instead of n_steps={n_steps}"
        )
    return {}


def check_settings(model: "Rainbow") -> None:
    """
    :raises ValueError: naming the first setting of the model that cannot work
    """
    check_replay_parameters(
        model.buffer_size, model.n_envs, model.n_steps, model.gamma, model.alpha, model.beta_start
    )
    if not 0.0 <= model.beta_end <= 1.0:
        raise ValueError(f"beta_end must lie in [0, 1], got {model.beta_end}")
    if model.use_masking not in ("auto", True, False):
        raise ValueError(f"use_masking must be 'auto', True or False, got {model.use_masking!r}")
    if not issubclass(model.policy_class, RainbowPolicy):
        raise ValueError(
            f"Rainbow needs a policy derived from RainbowPolicy, got {model.policy_class}; was "
            "the file saved by another algorithm?"
        )
    if model.mixed_precision and model.device.type != "cuda":
        raise ValueError(f"mixed_precision needs a CUDA device, got {model.device}")
    clashing = NETWORK_ARGUMENTS & set(model.policy_kwargs)
    if clashing:
        raise ValueError(
            f"Pass {', '.join(sorted(clashing))} to Rainbow itself, not in policy_kwargs"
        )
    start = int(model.action_space.start)
    if start != 0:
        raise ValueError(f"Rainbow needs Discrete actions that start at 0, got start={start}")
