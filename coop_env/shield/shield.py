"""A filter between a policy and the robots: what it lets through keeps its margins."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium as gym
import numpy as np
from numpy.typing import ArrayLike, NDArray

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ActionError, ArgumentError, ResetOptionError, as_dataclass
from coop_env.shield import kernels
from coop_env.shield.margin import ShieldMargin
from coop_env.simulation.start_states import as_configuration
from coop_env.simulation.task import N_ACTIONS, N_AXES, pack

Floats = NDArray[np.float64]


class KinematicShield:
    """Keeps both robots' distance from singularities, limits, the end of reach, and each other.

    It knows the nominal kinematics alone; the margins are there for what these do not know. An
    increment is certified if the straight way of configurations along it keeps them all.

    Args:
        env: a ``CoopInsertion-v0``, ``CoopInsertionContact-v0`` or ``CoopInsertionPhysics-v0``,
            wrapped or not, whose robots and dome are taken. With contact touching is the task: the
            shield then keeps all but the clearance.
        margin: None, the default :class:`ShieldMargin`, one, or a mapping of its fields.

    Raises:
        ArgumentError: ``env`` is none of these, its moves come late, or the margins leave nothing.
    """

    def __init__(
        self, env: gym.Env[Any, Any], margin: ShieldMargin | Mapping[str, Any] | None = None
    ) -> None:
        self.margin = (
            ShieldMargin() if margin is None else as_dataclass("margin", margin, ShieldMargin)
        )
        inner: Any = env.unwrapped if isinstance(env, gym.Env) else env
        if not (hasattr(inner, "params") and hasattr(inner, "task")):
            raise ArgumentError(f"env = {inner!r}: must be an environment of coop_env")
        contact = not isinstance(inner, CoopInsertionEnv)
        if not contact and inner.sim_to_real.latency:
            raise ArgumentError(
                "sim_to_real has latency: what comes a move late starts elsewhere than where it "
                "was certified; a shield needs latency = 0"
            )
        self.steps = np.array(inner.increments if contact else inner.task.steps)
        self.keeps = self.margin.reach, -1.0 if contact else self.margin.clearance
        self.packed = pack(self.margin.tighten(inner.params))

    def is_certified(self, configuration: ArrayLike) -> bool:
        """Whether a configuration (6,) keeps all margins."""
        c = _six("configuration", configuration)
        return bool(kernels.certified(c, self.packed, *self.keeps))

    def certify(self, state: ArrayLike, action: ArrayLike) -> tuple[Floats, bool]:
        """The part of an increment that keeps all margins.

        Args:
            state: configuration (6,): x, y, z, m; roll, pitch, rad; heave, m.
            action: increment (6,) of it, in the same units.

        Returns:
            The increment to take (6,), each component between 0 and what was asked for, and
            whether it differs from that. From a configuration that keeps its margins it leads to
            one that does. From another it is what leads back on the straight way, or zero.

        Raises:
            ArgumentError: ``state`` is not six finite numbers.
            ActionError: ``action`` is not.
        """
        c = _six("state", state)
        try:
            a = _six("action", action)
        except ArgumentError as error:
            raise ActionError(str(error)) from error
        result = np.empty(N_AXES)
        changed = kernels.project(c, a, self.packed, *self.keeps, result)
        return result, bool(changed)

    def allowed_moves(self, state: ArrayLike) -> NDArray[np.bool_]:
        """(12,): which of the environment's moves keep all margins, on the way too.

        Where a move with all margins led, at least the one back does.
        """
        mask = np.empty(N_ACTIONS, np.bool_)
        c = _six("state", state)
        kernels.allowed_moves(c, self.steps, self.packed, *self.keeps, mask)
        return mask

    @staticmethod
    def masks(own: NDArray[np.bool_], inner: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Masks (..., 12) of an environment's ``own`` and of the moves that keep all margins.

        Where none is in both, those that keep the margins; where none does, the environment's.
        """
        both = own & inner
        kept = np.where(inner.any(axis=-1, keepdims=True), inner, own)
        return np.where(both.any(axis=-1, keepdims=True), both, kept)

    def sigma_after(self, state: ArrayLike) -> Floats:
        """(12,): the signed sigma_min to which each of the environment's moves leads."""
        sigma = np.empty(N_ACTIONS)
        kernels.sigma_after(_six("state", state), self.steps, self.packed, sigma)
        return sigma


def _six(name: str, value: ArrayLike) -> Floats:
    """Six finite numbers.

    Raises:
        ArgumentError: they are not.
    """
    try:
        result = np.array(as_configuration(value))
    except ResetOptionError:
        result = np.full(N_AXES, np.nan)
    if not np.isfinite(result).all():
        raise ArgumentError(f"{name} = {value!r}: must be six finite numbers")
    return result
