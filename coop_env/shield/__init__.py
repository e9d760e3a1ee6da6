"""A run-time shield: it lets no action through that breaks a robot's margins."""

from coop_env.shield.shield import KinematicShield as KinematicShield
from coop_env.shield.shield import ShieldedInsertionEnv as ShieldedInsertionEnv
from coop_env.shield.shield import ShieldedInsertionVecEnv as ShieldedInsertionVecEnv
from coop_env.shield.shield import ShieldMargin as ShieldMargin
from coop_env.shield.shield import ShieldWrapper as ShieldWrapper
