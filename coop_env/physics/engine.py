"""MuJoCo, or one clear error where it is not installed."""

from __future__ import annotations

from gymnasium.error import DependencyNotInstalled

try:
    import mujoco
    import mujoco.rollout
except ImportError as error:
    raise DependencyNotInstalled(
        f"the physics twin needs pip install 'sb3-rainbow-coop[physics]': {error}"
    ) from error

__all__ = ["mujoco"]
