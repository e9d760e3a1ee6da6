"""What is optimized: the singularity-free orientation workspace A_w of a 3-RRS.

The paper's equation (constraints) reduces the lengths to (lambda1, lambda2) at fixed scale eta, and
its objective integrates over the orientations with ``sigma_min(J) >= 0.15``. Two things it leaves
open are settled here. sigma_min carries the sign of det A, and only the connected component of home
counts: beyond a parallel singularity sigma rises again, in an assembly mode that the platform
cannot enter without crossing it. And a cell counts only if all limbs reach it within their joint
limits. The tilt limit is the grid's +-60 degrees; on the paper's two designs the environment's 45
degrees would change nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label

from coop_env.compilation import njit
from coop_env.errors import check_integer, check_list, check_number, keep_number
from coop_env.geometry import INITIAL, OPTIMIZED, RRSGeometry
from coop_env.kinematics import rrs_kernels as rrs
from coop_env.kinematics.singularity import is_manipulable, manipulability

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

#: eta of the fitted designs in m, the mean of the two, which differ by rounding of their lengths.
ETA: Final = round(0.5 * (INITIAL.characteristic_length + OPTIMIZED.characteristic_length), 4)


class DesignError(ValueError):
    """A design problem that cannot be solved as posed; the message names the value and the fix."""


@dataclass(frozen=True, slots=True)
class DesignProblem:
    """The setting in which designs (lambda1, lambda2) are compared. Lengths in m, angles in rad.

    Attributes:
        eta: scale ``(Rb + 2 L1 + Rp) / 4``; every design has it.
        distal_length: L2; every design has it.
        heaves: heights at which A_w is measured. The first is the home of designs that are sought.
        threshold: least sigma_min that counts; the paper's 0.15.
        joint_min: lower limit of the actuated angles.
        joint_max: upper limit.
        extent: the grid covers roll and pitch within +- this.
        max_tilt: limit on \\|roll\\| and \\|pitch\\| within the grid.
        cells: cells along an axis of the grid.
        pose_model: ``"exact"``, or ``"paper"`` to see what its error does to the design.

    Raises:
        DesignError: a value out of range.
    """

    eta: float = ETA
    distal_length: float = INITIAL.distal_length
    heaves: tuple[float, ...] = (INITIAL.home_heave,)
    threshold: float = 0.15
    joint_min: float = INITIAL.joint_min
    joint_max: float = INITIAL.joint_max
    extent: float = math.pi / 3
    max_tilt: float = math.pi / 3
    cells: int = 120
    pose_model: str = "exact"

    def __post_init__(self) -> None:
        of = "a list of heights, the home heave first"
        heaves = check_list("heaves", self.heaves, of, error=DesignError)
        if not heaves:
            raise DesignError("heaves is empty: it has the home heave at least")
        above = [
            check_number(f"heaves[{i}]", heave, 0.0, above=True, error=DesignError)
            for i, heave in enumerate(heaves)
        ]
        object.__setattr__(self, "heaves", tuple(above))
        for name in ("eta", "distal_length", "threshold", "extent", "max_tilt"):
            keep_number(self, name, 0.0, above=True, error=DesignError)
        for name in ("joint_min", "joint_max"):
            keep_number(self, name, error=DesignError)
        if not self.extent < math.pi / 2:
            raise DesignError(f"extent = {self.extent!r} rad: must be below pi/2")
        if not self.joint_min < self.joint_max:
            raise DesignError(
                f"joint_min = {self.joint_min!r} must be below joint_max = {self.joint_max!r}"
            )
        check_integer("cells", self.cells, 2, error=DesignError)
        if self.pose_model not in ("exact", "paper"):
            raise DesignError(f"pose_model = {self.pose_model!r}: must be 'exact' or 'paper'")

    @classmethod
    def of(cls, geometry: RRSGeometry, **others: Any) -> DesignProblem:
        """The problem of a machine's own scale, distal length, joint limits and home."""
        alike = {n: getattr(geometry, n) for n in ("distal_length", "joint_min", "joint_max")}
        own = {"eta": geometry.characteristic_length, "heaves": (geometry.home_heave,), **alike}
        return cls(**own | others)

    @property
    def home_heave(self) -> float:
        """Height of the home of designs that are sought, m; det A has its sign there."""
        return self.heaves[0]

    @property
    def cell_area(self) -> float:
        """Area of a cell, rad^2."""
        return (2.0 * self.extent / self.cells) ** 2

    def geometry(self, lambda1: float, lambda2: float) -> RRSGeometry:
        """The machine of a design vector, with this problem's scale, distal length, joint limits.

        It can heave as the paper's designs do, and to all of this problem's heaves. ``max_tilt``
        and the drives are the class's defaults: ``dataclasses.replace`` them.

        Raises:
            GeometryError: the paper's constraints are broken.
        """
        return RRSGeometry.from_lambdas(
            lambda1,
            lambda2,
            eta=self.eta,
            distal_length=self.distal_length,
            joint_min=self.joint_min,
            joint_max=self.joint_max,
            heave_min=min(INITIAL.heave_min, *self.heaves),
            heave_max=max(INITIAL.heave_max, *self.heaves),
            home_heave=self.home_heave,
        )

    def params(self, geometry: RRSGeometry) -> rrs.RRSParams:
        """A machine as the kernels take it, under this problem's limits."""
        limits = {n: getattr(self, n) for n in ("joint_min", "joint_max", "max_tilt")}
        return rrs.make_params(geometry, self.pose_model)._replace(**limits)

    def centres(self) -> Floats:
        """Cell centres along an axis ``(cells,)``, rad."""
        step = 2.0 * self.extent / self.cells
        return np.arange(0.5, self.cells) * step - self.extent


PAPER_PROBLEM: Final = DesignProblem()


class Samples(NamedTuple):
    """Where each cell is sampled: roll and pitch ``(cells, cells)``, rad."""

    roll: Floats
    pitch: Floats


class WorkspaceMap(NamedTuple):
    """A workspace at one heave; each array ``(cells, cells)``, axis 0 roll, axis 1 pitch."""

    samples: Samples
    sigma: Floats
    kappa: Floats
    inside: Bools
    area: float


Objective = Callable[[RRSGeometry, DesignProblem, Samples], float]


def sample_points(problem: DesignProblem, rng: np.random.Generator | None = None) -> Samples:
    """Cell centres, or one uniform draw within each cell if a generator is given.

    The paper integrates over jittered samples. Draw them once for a run of an optimizer: redrawn
    at every evaluation they make the objective noise, on which a simplex never converges.
    """
    roll, pitch = np.meshgrid(problem.centres(), problem.centres(), indexing="ij")
    if rng is None:
        return Samples(roll, pitch)
    half = problem.extent / problem.cells
    return Samples(
        roll + rng.uniform(-half, half, roll.shape), pitch + rng.uniform(-half, half, pitch.shape)
    )


def _samples(samples: Samples | None, problem: DesignProblem) -> Samples:
    """The given samples, checked to lie in their cells, or the cells' centres."""
    centres = sample_points(problem)
    if samples is None:
        return centres
    half = problem.extent / problem.cells * (1.0 + 1e-9)
    for name, given, middle in zip(Samples._fields, samples, centres, strict=True):
        if np.shape(given) != middle.shape or not (np.abs(given - middle) <= half).all():
            raise DesignError(
                f"samples.{name}: must be a point in each of the problem's {problem.cells} x "
                f"{problem.cells} cells up to {problem.extent:.3g} rad: sample_points(problem)"
            )
    return samples


def workspace_area(
    geometry: RRSGeometry, problem: DesignProblem = PAPER_PROBLEM, samples: Samples | None = None
) -> float:
    """A_w in rad^2: area of the connected component of home; zero if home itself is not in it.

    With several heaves, the least over them.

    >>> from coop_env.geometry import INITIAL, OPTIMIZED
    >>> round(workspace_area(INITIAL), 2), round(workspace_area(OPTIMIZED), 2)
    (0.82, 1.16)
    """
    samples = _samples(samples, problem)
    inside = (_survey(geometry, problem, samples, heave, False)[2] for heave in problem.heaves)
    return problem.cell_area * min(int(cells.sum()) for cells in inside)


def workspace_map(
    geometry: RRSGeometry,
    problem: DesignProblem = PAPER_PROBLEM,
    samples: Samples | None = None,
    heave: float | None = None,
) -> WorkspaceMap:
    """Signed sigma_min and kappa over the whole grid, NaN out of reach, and the home component."""
    samples = _samples(samples, problem)
    height = problem.home_heave if heave is None else heave
    height = check_number("heave", height, 0.0, above=True, error=DesignError)
    sigma, kappa, inside = _survey(geometry, problem, samples, height, True)
    return WorkspaceMap(samples, sigma, kappa, inside, problem.cell_area * int(inside.sum()))


def _survey(
    geometry: RRSGeometry, problem: DesignProblem, samples: Samples, heave: float, whole: bool
) -> tuple[Floats, Floats, Bools]:
    """sigma, kappa, and the admitted cells connected by edges with those about the centre."""
    p = problem.params(geometry)
    sigma, kappa, admitted = _survey_cells(*samples, heave, problem.threshold, p, whole)
    parts, _ = label(admitted)
    about = slice((problem.cells - 1) // 2, problem.cells // 2 + 1)
    home = parts[about, about]
    return sigma, kappa, np.isin(parts, home[home > 0])


@njit(cache=True)
def _survey_cells(
    roll: Any, pitch: Any, heave: float, threshold: float, p: rrs.RRSParams, whole: bool
) -> tuple[Any, Any, Any]:
    """Signed sigma_min and kappa of each cell, NaN out of reach, and the admitted cells.

    Unless ``whole``, which takes longer, only the admitted cells are computed.
    """
    sigma, kappa = np.full(roll.shape, np.nan), np.full(roll.shape, np.nan)
    admitted = np.zeros(roll.shape, np.bool_)
    for i in range(roll.shape[0]):
        for j in range(roll.shape[1]):
            pose = rrs.platform_pose(roll[i, j], pitch[i, j], heave, p)
            reachable, q = rrs.inverse(pose, p)
            tilted = abs(roll[i, j]) <= p.max_tilt and abs(pitch[i, j]) <= p.max_tilt
            within = tilted and rrs.joints_within_limits(q, p)
            if reachable and (whole or within):
                a, b = rrs.jacobian_parts(pose, q, p)
                admitted[i, j] = within and is_manipulable(a, b, p.home_sign, threshold)
                if whole:
                    _, sigma[i, j], kappa[i, j] = manipulability(a, b, p.home_sign)
    return sigma, kappa, admitted
