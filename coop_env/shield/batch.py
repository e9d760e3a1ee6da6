"""The task under the shield's masks, alone and in a batch, for agents that keep to masks."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop_env.env import CoopInsertionEnv
from coop_env.shield.margin import ShieldMargin
from coop_env.shield.shield import KinematicShield
from coop_env.vector.vec_env import CoopInsertionVecEnv


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
