"""A filter between a policy and the robots that lets through only what keeps its margins.

:class:`KinematicShield` certifies, :class:`ShieldWrapper` puts it between an agent and its
environment, and :class:`ShieldedInsertionVecEnv` is the task under its masks, in a batch.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from coop_env.env import CoopInsertionEnv, check_action
from coop_env.errors import ActionError, ArgumentError, ResetOptionError, as_dataclass, keep_number
from coop_env.shield import kernels
from coop_env.simulation.start_states import as_configuration
from coop_env.simulation.task import N_ACTIONS, N_AXES, EnvParams, pack
from coop_env.vector.vec_env import CoopInsertionVecEnv

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class ShieldMargin:
    """Distances that a shield keeps.

    Attributes:
        sigma: least signed sigma_min, dimensionless; the task's own margin where that is larger.
        joint: of the 3-RRS's actuated angles from their limits, rad.
        reach: least ``1 - |cosine|`` of each limb's triangle: 0 is a stretched or folded limb.
        clearance: between any part of the Delta and any of the 3-RRS, m; holes are entered only
            where their lead-in is as much wider. Less than a millimetre no longer covers what lies
            between two looks at a way.

    Raises:
        ArgumentError: a value is of the wrong kind or out of range.
    """

    sigma: float = 0.1
    joint: float = math.radians(0.5)
    reach: float = 0.002
    clearance: float = 0.003

    def __post_init__(self) -> None:
        for name, most in (("sigma", 1.0), ("joint", 0.5), ("reach", 0.5), ("clearance", 0.1)):
            keep_number(self, name, 0.0, most)

    def tighten(self, p: EnvParams) -> EnvParams:
        """The task's parameters with limits moved inwards and bodies grown by the clearance.

        Raises:
            ArgumentError: nothing would be left of the lead-in, or of the joints' range.
        """
        opening = p.task.chamfer + p.delta.peg_radius
        if not self.clearance < opening:
            raise ArgumentError(
                f"ShieldMargin.clearance = {self.clearance!r} closes the holes, whose lead-in is "
                f"{opening:g} m wide: choose less"
            )
        joint_min, joint_max = p.rrs.joint_min + self.joint, p.rrs.joint_max - self.joint
        if not joint_min < joint_max:
            raise ArgumentError(
                f"ShieldMargin.joint = {self.joint!r} leaves nothing of the joints' range of "
                f"{p.rrs.joint_max - p.rrs.joint_min:.3g} rad: choose less"
            )
        layout = p.layout.copy()
        layout["singular_margin"] = max(self.sigma, float(p.layout["singular_margin"]))
        layout["effector_radius"] += self.clearance
        layout["forearm_radius"] += self.clearance
        length, radius = p.delta.peg_length + self.clearance, p.delta.peg_radius + self.clearance
        return p._replace(
            rrs=p.rrs._replace(joint_min=joint_min, joint_max=joint_max),
            delta=p.delta._replace(peg_length=length, peg_radius=radius),
            layout=layout,
        )


_CHANGING = gym.ActionWrapper, getattr(gym.wrappers, "RepeatAction", gym.ActionWrapper)
"""Wrappers that change actions or make one several times; the second is new in Gymnasium 1.3."""


class KinematicShield:
    """Keeps both robots' distance from singularities, limits, the end of reach, and each other.

    An increment is certified if the straight way along it keeps all margins of the nominal machine.

    Args:
        env: a ``CoopInsertion-v0``, ``CoopInsertionContact-v0`` or ``CoopInsertionPhysics-v0``,
            wrapped or not. With contact touching is the task: all but the clearance is kept.
        margin: None, the default :class:`ShieldMargin`, one, or a mapping of its fields.

    Raises:
        ArgumentError: ``env`` is none of these, its moves come late, or the margins leave nothing.
    """

    def __init__(
        self, env: gym.Env[Any, Any], margin: ShieldMargin | Mapping[str, Any] | None = None
    ) -> None:
        self.margin = as_dataclass("margin", margin, ShieldMargin, {None: ShieldMargin()})
        inner: Any = getattr(env, "unwrapped", env)
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
            whether it differs from that. From within the margins it leads to within them.

        Raises:
            ArgumentError: ``state`` is not six finite numbers.
            ActionError: ``action`` is not.
        """
        c, a = _six("state", state), _six("action", action, ActionError)
        result = np.empty(N_AXES)
        changed = kernels.project(c, a, self.packed, *self.keeps, result)
        return result, bool(changed)

    def allowed_moves(self, state: ArrayLike) -> NDArray[np.bool_]:
        """(12,): which of the environment's moves keep all margins, on the way too."""
        mask = np.empty(N_ACTIONS, np.bool_)
        c = _six("state", state)
        kernels.allowed_moves(c, self.steps, self.packed, *self.keeps, mask)
        return mask

    @staticmethod
    def masks(own: NDArray[np.bool_], inner: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Masks (..., 12) of an environment's ``own`` and of the moves that keep all margins.

        Where no move is in both, the moves that keep the margins; without any, the environment's.
        """
        both = own & inner
        kept = np.where(inner.any(axis=-1, keepdims=True), inner, own)
        return np.where(both.any(axis=-1, keepdims=True), both, kept)

    def sigma_after(self, state: ArrayLike) -> Floats:
        """(12,): the signed sigma_min to which each of the environment's moves leads."""
        sigma = np.empty(N_ACTIONS)
        kernels.sigma_after(_six("state", state), self.steps, self.packed, sigma)
        return sigma


class ShieldWrapper(gym.Wrapper[Any, Any, Any, Any], gym.utils.RecordConstructorArgs):
    """Only certified actions reach the environment.

    An increment is cut to what :meth:`KinematicShield.certify` leaves of it. A move that
    :meth:`action_masks` forbids is replaced by the allowed one with the largest signed sigma_min.
    ``info["shielded"]`` says whether this step's action was changed, ``info["interventions"]`` how
    many of the episode's were. Arguments are :class:`KinematicShield`'s.

    Raises:
        ArgumentError: ``env`` is none of these, has other actions, or a wrapper that changes or
            repeats them.
    """

    def __init__(
        self, env: gym.Env[Any, Any], margin: ShieldMargin | Mapping[str, Any] | None = None
    ) -> None:
        plain = asdict(margin) if isinstance(margin, ShieldMargin) else margin
        gym.utils.RecordConstructorArgs.__init__(self, margin=plain)
        gym.Wrapper.__init__(self, env)
        layer = env
        while isinstance(layer, gym.Wrapper):
            if isinstance(layer, _CHANGING):
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
        """(12,): True where a move keeps all margins and the environment allows it.

        Where nothing is left, as at a start within the margin, the environment's own hold.
        """
        own = np.ones(N_ACTIONS, np.bool_)
        if self.env.has_wrapper_attr("action_masks"):
            own = np.asarray(self.env.get_wrapper_attr("action_masks")(), np.bool_)
        return self.shield.masks(own, self.shield.allowed_moves(self._inner.configuration))

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """As the environment's."""
        observation, info = self.env.reset(**kwargs)
        self.interventions = 0
        return observation, {**info, "shielded": False, "interventions": 0}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """As the environment's, with a certified action."""
        taken, changed = self._discretely(action) if self._discrete else self._certify(action)
        observation, reward, terminated, truncated, info = self.env.step(taken)
        self.interventions += changed
        info = {**info, "shielded": changed, "interventions": self.interventions}
        return observation, reward, terminated, truncated, info

    @property
    def _inner(self) -> Any:
        return self.env.unwrapped

    def _certify(self, action: Any) -> tuple[Any, bool]:
        wanted = self._inner.increments_of(action) * self.shield.steps
        result, changed = self.shield.certify(self._inner.configuration, wanted)
        return (result / self.shield.steps).astype(np.float32) if changed else action, changed

    def _discretely(self, action: Any) -> tuple[int, bool]:
        move, masks = check_action(action), self.action_masks()
        if masks[move]:
            return move, False
        sigma = self.shield.sigma_after(self._inner.configuration)
        return int(np.argmax(np.where(masks, sigma, -np.inf))), True


class ShieldedInsertionEnv(CoopInsertionEnv):
    """A ``CoopInsertion-v0`` with :class:`ShieldWrapper`'s masks; no action is replaced.

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

    def get_state(self) -> dict[str, Any]:
        """As the environment's, of these margins."""
        snapshot = super().get_state()
        return {**snapshot, "params": (*snapshot["params"], repr(self.shield.margin))}


class ShieldedInsertionVecEnv(CoopInsertionVecEnv):
    """Many :class:`ShieldedInsertionEnv` in one batch, as SB3's ``VecEnv``."""

    env_class = ShieldedInsertionEnv


def _six(name: str, value: ArrayLike, error: type[ValueError] = ArgumentError) -> Floats:
    try:
        result = np.array(as_configuration(value))
    except ResetOptionError:
        result = np.full(N_AXES, np.nan)
    if not np.isfinite(result).all():
        raise error(f"{name} = {value!r}: must be six finite numbers")
    return result
