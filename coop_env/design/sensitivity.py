"""How much a design's workspace hangs on the threshold, on heave, and on the lengths as built."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from coop_env.design.optimize import optimize
from coop_env.design.problem import (
    PAPER_PROBLEM,
    DesignError,
    DesignProblem,
    Floats,
    workspace_area,
)
from coop_env.geometry import GeometryError, RRSGeometry

LENGTHS = ("base_radius", "proximal_length", "platform_radius", "distal_length")


def over_heaves(
    geometry: RRSGeometry, heaves: Sequence[float] | Floats, problem: DesignProblem = PAPER_PROBLEM
) -> Floats:
    """A_w ``(n,)`` in rad^2 at each heave; the sign of det A is still taken at the design's home.

    >>> from coop_env.geometry import OPTIMIZED
    >>> over_heaves(OPTIMIZED, [0.20, 0.21]).round(2).tolist()  # the cliff below home
    [0.57, 1.16]
    """
    each = (replace(problem, heaves=(float(heave),)) for heave in heaves)
    return np.array([workspace_area(geometry, at_heave) for at_heave in each])


@dataclass(frozen=True, slots=True)
class ThresholdSweep:
    """A_w by threshold ``(n,)``: of given designs ``(n, designs)``, and of the design that
    Nelder-Mead finds for that threshold, with its lambdas ``(n, 2)``.
    """

    thresholds: Floats
    given: Floats
    optimum: Floats
    lambdas: Floats


def over_thresholds(
    geometries: Sequence[RRSGeometry],
    thresholds: Sequence[float] | Floats,
    problem: DesignProblem = PAPER_PROBLEM,
) -> ThresholdSweep:
    """How the areas and the optimum itself move with the threshold on sigma_min.

    Raises:
        DesignError: the initial design has no workspace at one of the thresholds.
    """
    given, optimum, lambdas = [], [], []
    for threshold in thresholds:
        here = replace(problem, threshold=float(threshold))
        given.append([workspace_area(geometry, here) for geometry in geometries])
        result = optimize(here)
        optimum.append(result.value)
        lambdas.append([result.lambda1, result.lambda2])
    return ThresholdSweep(
        np.asarray(thresholds, dtype=float), np.array(given), np.array(optimum), np.array(lambdas)
    )


def slopes(
    geometry: RRSGeometry, problem: DesignProblem = PAPER_PROBLEM, step: float = 5e-4
) -> dict[str, float]:
    """Change of A_w, rad^2 per mm, by each length in turn (central difference of 0.5 mm)."""
    if not step > 0.0:
        raise DesignError(f"step = {step!r} m: must be above zero")

    def area(name: str, error: float) -> float:
        longer: dict[str, Any] = {name: getattr(geometry, name) + error}
        return workspace_area(replace(geometry, **longer), problem)

    return {name: (area(name, step) - area(name, -step)) / (2e3 * step) for name in LENGTHS}


def under_tolerances(
    geometry: RRSGeometry,
    tolerance: float,
    draws: int = 100,
    problem: DesignProblem = PAPER_PROBLEM,
) -> Floats:
    """A_w ``(draws,)`` with every length off by an independent uniform error of +-``tolerance`` m.

    The error of a length is the same on all three limbs, because the closed forms used here rest
    on their symmetry. Draws that break the paper's constraints count as zero.
    """
    if not tolerance >= 0.0:
        raise DesignError(f"tolerance = {tolerance!r} m: must not be negative")
    rng = np.random.default_rng(0)
    areas = np.zeros(draws)
    for i in range(draws):
        errors = rng.uniform(-tolerance, tolerance, len(LENGTHS))
        named = zip(LENGTHS, errors.tolist(), strict=True)
        try:
            built = replace(geometry, **{n: getattr(geometry, n) + error for n, error in named})
        except GeometryError:
            continue
        areas[i] = workspace_area(built, problem)
    return areas
