"""How far a shielded machine stays from what must not happen."""

from __future__ import annotations

import math
from dataclasses import dataclass

from coop_env.errors import ArgumentError, check_number
from coop_env.simulation.task import EnvParams


@dataclass(frozen=True, slots=True)
class ShieldMargin:
    """Distances that a shield keeps.

    Attributes:
        sigma: least signed sigma_min, dimensionless; the task's own margin where that is larger.
        joint: of the 3-RRS's actuated angles from their limits, rad.
        reach: least ``1 - |cosine|`` of each limb's triangle: 0 is a stretched or folded limb.
        clearance: between any part of the Delta and any of the 3-RRS, m. Holes are entered only
            where their lead-in is as much wider. Below a millimetre or so it no longer covers
            what lies between two looks at a way.

    Raises:
        ArgumentError: a value is of the wrong kind or out of range.
    """

    sigma: float = 0.1
    joint: float = math.radians(0.5)
    reach: float = 0.002
    clearance: float = 0.003

    def __post_init__(self) -> None:
        for name, most in (("sigma", 1.0), ("joint", 0.5), ("reach", 0.5), ("clearance", 0.1)):
            number = check_number(f"ShieldMargin.{name}", getattr(self, name), 0.0, most)
            object.__setattr__(self, name, number)

    def tighten(self, p: EnvParams) -> EnvParams:
        """The task's parameters with limits moved inwards and the Delta's bodies grown.

        A body grown by the clearance touches where the true one is nearer than that.

        Raises:
            ArgumentError: nothing would be left of the lead-in, or of the joints' range.
        """
        opening = p.task.chamfer + p.delta.peg_radius
        if not self.clearance < opening:
            raise ArgumentError(
                f"ShieldMargin.clearance = {self.clearance!r} closes the holes, whose lead-in is "
                f"{opening:g} m wide: choose less"
            )
        if not p.rrs.joint_min + self.joint < p.rrs.joint_max - self.joint:
            raise ArgumentError(
                f"ShieldMargin.joint = {self.joint!r} leaves nothing of the joints' range of "
                f"{p.rrs.joint_max - p.rrs.joint_min:.3g} rad: choose less"
            )
        layout = p.layout.copy()
        layout["singular_margin"] = max(self.sigma, float(p.layout["singular_margin"]))
        layout["effector_radius"] += self.clearance
        layout["forearm_radius"] += self.clearance
        return p._replace(
            rrs=p.rrs._replace(
                joint_min=p.rrs.joint_min + self.joint, joint_max=p.rrs.joint_max - self.joint
            ),
            delta=p.delta._replace(
                peg_length=p.delta.peg_length + self.clearance,
                peg_radius=p.delta.peg_radius + self.clearance,
            ),
            layout=layout,
        )
