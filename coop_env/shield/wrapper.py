"""The shield between an agent and its environment, and the task under its masks, in a batch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv, check_action
from coop_env.errors import ArgumentError
from coop_env.shield.shield import KinematicShield, ShieldMargin
from coop_env.simulation.task import N_ACTIONS
from coop_env.vector.vec_env import CoopInsertionVecEnv


class ShieldWrapper(gym.Wrapper[Any, Any, Any, Any]):
    """Only certified actions reach the environment.

    An increment is cut to what :meth:`KinematicShield.certify` leaves of it. Of the twelve moves
    :meth:`action_masks` allows those that keep all margins, among those that the environment
    itself allows; another is replaced by the allowed one with the largest signed sigma_min. Where
    nothing is allowed, as at a start nearer to a limit than the margin, the environment's own masks
    hold until something is.

    ``info["shielded"]`` says whether this step's action was changed, ``info["interventions"]`` how
    many of the episode's were.

    Args:
        env: as :class:`KinematicShield` takes it.
        margin: likewise.

    Raises:
        ArgumentError: ``env`` is none of these, has other actions, or a wrapper that changes them.
    """

    def __init__(
        self, env: gym.Env[Any, Any], margin: ShieldMargin | Mapping[str, Any] | None = None
    ) -> None:
        super().__init__(env)
        layer = env
        while isinstance(layer, gym.Wrapper):
            if isinstance(layer, gym.ActionWrapper):
                raise ArgumentError(
                    f"{type(layer).__name__} changes what the shield has certified: put it around "
                    "the shield instead"
                )
            layer = layer.env
        self.shield = KinematicShield(env, margin)
        space = env.action_space
        self._discrete = isinstance(space, spaces.Discrete)
        if isinstance(space, spaces.Discrete) and space.n != N_ACTIONS:
            raise ArgumentError(f"a shield knows twelve moves, and not {space}")
        self.interventions = 0

    def action_masks(self) -> NDArray[np.bool_]:
        """(12,): True where a move keeps all margins and the environment allows it."""
        inner = self.shield.allowed_moves(self._configuration())
        return self.shield.masks(self._own_masks(), inner)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """As the environment's."""
        observation, info = self.env.reset(**kwargs)
        self.interventions = 0
        return observation, {**info, "shielded": False, "interventions": 0}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As the environment's, with a certified action.

        Raises:
            ActionError: as the environment.
        """
        taken, changed = self._discretely(action) if self._discrete else self._certify(action)
        observation, reward, terminated, truncated, info = self.env.step(taken)
        self.interventions += changed
        info = {**info, "shielded": changed, "interventions": self.interventions}
        return observation, reward, terminated, truncated, info

    def _configuration(self) -> NDArray[np.float64]:
        inner: Any = self.env.unwrapped
        result: NDArray[np.float64] = inner.configuration
        return result

    def _own_masks(self) -> NDArray[np.bool_]:
        try:
            masks = self.env.get_wrapper_attr("action_masks")
        except AttributeError:
            return np.ones(N_ACTIONS, np.bool_)
        return np.asarray(masks(), np.bool_)

    def _certify(self, action: Any) -> tuple[Any, bool]:
        inner: Any = self.env.unwrapped
        wanted = inner.increments_of(action) * self.shield.steps
        result, changed = self.shield.certify(self._configuration(), wanted)
        return (result / self.shield.steps).astype(np.float32) if changed else action, changed

    def _discretely(self, action: Any) -> tuple[int, bool]:
        move, masks = check_action(action), self.action_masks()
        if masks[move]:
            return move, False
        sigma = self.shield.sigma_after(self._configuration())
        return int(np.argmax(np.where(masks, sigma, -np.inf))), True


class ShieldedInsertionEnv(CoopInsertionEnv):
    """A ``CoopInsertion-v0`` whose masks are the ones that :class:`ShieldWrapper` gives it.

    What an agent does against its masks is the environment's own business here, and no
    intervention.

    Args:
        shield: None, the default :class:`ShieldMargin`, one, or a mapping of its fields.
        kwargs: as for :class:`~coop_env.env.CoopInsertionEnv`.

    Raises:
        ArgumentError: an argument is wrong, or the margins leave nothing.
    """

    def __init__(
        self, shield: ShieldMargin | Mapping[str, Any] | None = None, **kwargs: Any
    ) -> None:
        super().__init__(**kwargs)
        self.shield = KinematicShield(self, shield)

    def _masks_of(self, states: NDArray[np.void]) -> NDArray[np.bool_]:
        inner = [self.shield.allowed_moves(c) for c in states["configuration"]]
        return self.shield.masks(super()._masks_of(states), np.array(inner))


class ShieldedInsertionVecEnv(CoopInsertionVecEnv):
    """Many :class:`ShieldedInsertionEnv` in one batch, as SB3's ``VecEnv``."""

    env_class = ShieldedInsertionEnv
