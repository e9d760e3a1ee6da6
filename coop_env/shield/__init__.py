"""A run-time shield: no action gets through that takes a robot's margins away."""

from coop_env.shield.shield import (
    KinematicShield,
    ShieldedInsertionEnv,
    ShieldedInsertionVecEnv,
    ShieldMargin,
    ShieldWrapper,
)

__all__ = [
    "KinematicShield",
    "ShieldMargin",
    "ShieldWrapper",
    "ShieldedInsertionEnv",
    "ShieldedInsertionVecEnv",
]
