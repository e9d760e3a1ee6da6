"""A run-time shield: no action gets through that takes a robot's margins away.

:class:`KinematicShield` certifies increments and moves, :class:`ShieldWrapper` puts it between an
agent and its environment, :class:`ShieldedInsertionVecEnv` is a batch under its masks,
:class:`ShieldMargin` says how much distance is kept.
"""

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
