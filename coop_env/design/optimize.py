"""Optimizers over (lambda1, lambda2): the paper's Nelder-Mead, a global search, and the atlas."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from scipy.optimize import OptimizeResult, differential_evolution, minimize

from coop_env.design.problem import (
    PAPER_PROBLEM,
    DesignError,
    DesignProblem,
    Floats,
    Objective,
    Samples,
    sample_points,
    workspace_area,
)
from coop_env.errors import check_integer, check_list, check_number
from coop_env.geometry import INITIAL, GeometryError, RRSGeometry

Constraint = Callable[[RRSGeometry], float]  # satisfied where it is not negative

#: Where the paper's constraints leave designs with a workspace; beyond, lambda2 would exceed 3.4.
FEASIBLE_BOX: Final = ((0.5, 2.0), (0.1, 3.4))


@dataclass(frozen=True, slots=True)
class Optimum:
    """Where an optimizer ended.

    ``converged`` says that it ended by its tolerance, before its limit. ``path`` holds every design
    it evaluated ``(n, 3)``: lambda1, lambda2 and the objective, NaN where a constraint is broken.
    """

    lambda1: float
    lambda2: float
    value: float
    start_value: float
    evaluations: int
    converged: bool
    message: str
    geometry: RRSGeometry
    path: Floats

    @property
    def lambda3(self) -> float:
        """Rp / eta, which the sum of 4 fixes."""
        return 4.0 - self.lambda1 - self.lambda2


@dataclass
class _Cost:
    """The negated objective with the constraints as a penalty, and a record of every call."""

    problem: DesignProblem
    objective: Objective
    samples: Samples
    constraints: Sequence[Constraint]
    path: list[tuple[float, float, float]] = field(default_factory=list)

    def value(self, lambda1: float, lambda2: float) -> float:
        """The objective, or minus the amount by which the constraints are broken, as a penalty."""
        lambda3 = 4.0 - lambda1 - lambda2
        broken = _excess(-lambda2, -lambda3, lambda3 - lambda1, lambda1 - 2.0)
        if broken > 0.0:
            return -broken
        try:
            geometry = self.problem.geometry(lambda1, lambda2)
        except GeometryError:
            return -1e-9  # on a bound itself
        margins = [constraint(geometry) for constraint in self.constraints]
        if any(margin is None for margin in margins):
            raise DesignError("a constraint returns None: it must return its margin, a number")
        broken = _excess(*(-margin for margin in margins))
        if broken > 0.0:
            return -broken
        value = self.objective(geometry, self.problem, self.samples)
        if value is None or not 0.0 <= value < math.inf:
            raise DesignError(
                f"the objective is {value!r} at lambda1 = {lambda1:.4f}, lambda2 = {lambda2:.4f}: "
                "it must be finite and not negative on every design that meets the constraints"
            )
        return value

    def __call__(self, x: Floats) -> float:
        lambda1, lambda2 = float(x[0]), float(x[1])
        value = self.value(lambda1, lambda2)
        self.path.append((lambda1, lambda2, value if value >= 0.0 else math.nan))
        # A broken constraint costs more than any feasible design, and more the further it is off.
        return -value if value >= 0.0 else 1.0 - 10.0 * value


def _excess(*amounts: float) -> float:
    return sum(1.0 if math.isnan(amount) else max(0.0, amount) for amount in amounts)


def _optimum(cost: _Cost, result: OptimizeResult, start_value: float) -> Optimum:
    lambda1, lambda2 = (float(v) for v in result.x)
    return Optimum(
        lambda1,
        lambda2,
        -float(result.fun),
        start_value,
        int(result.nfev),
        bool(result.success),
        str(result.message),
        cost.problem.geometry(lambda1, lambda2),
        np.array(cost.path),
    )


def optimize(
    problem: DesignProblem = PAPER_PROBLEM,
    start: tuple[float, float] = INITIAL.lambdas[:2],
    *,
    objective: Objective = workspace_area,
    constraints: Sequence[Constraint] = (),
    simplex: float = 0.15,
    seed: int | None = None,
    max_evaluations: int = 400,
) -> Optimum:
    """Maximize an objective over (lambda1, lambda2) by Nelder-Mead, as the paper does.

    Args:
        problem: scale, limits, heaves, threshold and grid.
        start: (lambda1, lambda2) of the first vertex.
        objective: ``objective(geometry, problem, samples)``, not negative; A_w by default.
        constraints: functions of a geometry, each satisfied where not negative, and broken where
            NaN; they and the paper's own act as a penalty.
        simplex: edge of the initial simplex, along each axis. One of a few thousandths stalls at
            once, and is converged: the area changes in steps of a cell.
        seed: of the jitter, one draw per cell that is kept for the whole run; None for the
            cells' centres.
        max_evaluations: limit on evaluations of the objective; the search ends earlier once the
            simplex is smaller than 1e-4 in lambda and in value.

    Raises:
        GeometryError: the start breaks the paper's constraints.
        DesignError: the start has no workspace, or breaks a constraint; a value is not finite; or
            an argument is out of range.

    >>> optimum = optimize()
    >>> optimum.converged, round(optimum.value, 1), optimum.value > optimum.start_value
    (True, 1.2, True)
    """
    check_number("simplex", simplex, 0.0, above=True, error=DesignError)
    check_integer("max_evaluations", max_evaluations, 1, error=DesignError)
    check_list("constraints", constraints, "a list of functions of a geometry", error=DesignError)
    check_list("start", start, "a list of lambda1 and lambda2", 2, DesignError)
    for i, number in enumerate(start):
        check_number(f"lambda{i + 1} of start", number, error=GeometryError)
    if seed is not None:
        check_integer("seed", seed, 0, error=DesignError)
    rng = None if seed is None else np.random.default_rng(seed)
    cost = _Cost(problem, objective, sample_points(problem, rng), constraints)
    problem.geometry(*start)  # its error names the constraint that a start breaks
    start_value = cost.value(*start)
    if start_value < 0.0:
        raise DesignError(
            f"start = {start} breaks a constraint by {-start_value:.3g}: start within them"
        )
    if start_value == 0.0:
        raise DesignError(
            f"start = {start} has objective 0 at heave {problem.home_heave:.4g} m: its home is out "
            f"of reach, of the joint limits, or below sigma_min = {problem.threshold:.3g}, and all "
            "about it is as flat; start from a design with some workspace (see atlas)"
        )
    first = np.array(start)
    result = minimize(
        cost,
        first,
        method="Nelder-Mead",
        options={
            "initial_simplex": first + np.array([[0.0, 0.0], [simplex, 0.0], [0.0, simplex]]),
            "xatol": 1e-4,
            "fatol": 1e-4,
            "maxfev": max_evaluations,
        },
    )
    return _optimum(cost, result, start_value)


def optimize_globally(
    problem: DesignProblem = PAPER_PROBLEM,
    *,
    objective: Objective = workspace_area,
    constraints: Sequence[Constraint] = (),
    seed: int = 0,
    population: int = 12,
    generations: int = 30,
) -> Optimum:
    """Maximize over the feasible box by differential evolution, as a check of Nelder-Mead.

    The initial design joins the first generation if it has a workspace. The end is polished by
    Nelder-Mead with a small simplex. The cells' centres are sampled. Problem, objective and
    constraints are as in :func:`optimize`.

    Args:
        seed: of the search.
        population: half the designs of a generation.
        generations: at most so many follow the first.

    Raises:
        DesignError: no design that was tried has a workspace within the constraints, a value is not
            finite, or an argument is out of range.
    """
    for name, number in (("population", population), ("generations", generations)):
        check_integer(name, number, 1, error=DesignError)
    check_integer("seed", seed, 0, error=DesignError)
    check_list("constraints", constraints, "a list of functions of a geometry", error=DesignError)
    cost = _Cost(problem, objective, sample_points(problem), constraints)
    start = INITIAL.lambdas[:2]
    start_value = max(cost.value(*start), 0.0)
    result = differential_evolution(
        cost,
        FEASIBLE_BOX,
        x0=np.array(start) if start_value > 0.0 else None,
        rng=np.random.default_rng(seed),
        popsize=population,
        maxiter=generations,
        tol=1e-3,
        polish=False,
    )
    if not result.fun < 0.0:
        raise DesignError(
            f"all {result.nfev} designs tried have objective 0 at heave {problem.home_heave:.4g} "
            "m, or break a constraint: homes are out of reach, of the joint limits, or below "
            f"sigma_min = {problem.threshold:.3g}"
        )
    coarse = _optimum(cost, result, start_value)
    fine = optimize(
        problem,
        (coarse.lambda1, coarse.lambda2),
        objective=objective,
        constraints=constraints,
        simplex=0.02,
    )
    return replace(
        fine,
        start_value=start_value,
        evaluations=coarse.evaluations + fine.evaluations,
        converged=coarse.converged and fine.converged,
        message=f"global search: {coarse.message} polish: {fine.message}",
        path=np.concatenate([coarse.path, fine.path]),
    )


@dataclass(frozen=True, slots=True)
class Atlas:
    """The objective over designs: ``value[i, j]`` at ``lambda1[i]``, ``lambda2[j]``; NaN where
    the constraints are broken.
    """

    lambda1: Floats
    lambda2: Floats
    value: Floats


def atlas(
    problem: DesignProblem = PAPER_PROBLEM,
    lambda1: Sequence[float] | Floats | None = None,
    lambda2: Sequence[float] | Floats | None = None,
    *,
    objective: Objective = workspace_area,
    constraints: Sequence[Constraint] = (),
    progress: Callable[[int, int], None] | None = None,
) -> Atlas:
    """The objective on a grid of designs, by default in steps of 0.04 over the feasible box.

    Problem, objective and constraints are as in :func:`optimize`; ``progress`` is called with the
    rows done and the rows in all.
    """
    axes = []
    for name, given, (low, high) in zip(
        ("lambda1", "lambda2"), (lambda1, lambda2), FEASIBLE_BOX, strict=True
    ):
        values = np.arange(low, high, 0.04) if given is None else given
        check_list(name, values, "a list of numbers", error=DesignError)
        numbers = (check_number(f"{name}[{i}]", v, error=DesignError) for i, v in enumerate(values))
        axes.append(np.array([*numbers]))
    rows, columns = axes
    cost = _Cost(problem, objective, sample_points(problem), constraints)
    value = np.empty((len(rows), len(columns)))
    for i, a in enumerate(rows):
        for j, b in enumerate(columns):
            attained = cost.value(float(a), float(b))
            value[i, j] = attained if attained >= 0.0 else math.nan
        if progress is not None:
            progress(i + 1, len(rows))
    return Atlas(rows, columns, value)


def at_heaves(problem: DesignProblem, heaves: Sequence[float]) -> DesignProblem:
    """The same problem measured over a band of heaves; home stays where it was, and counts.

    >>> at_heaves(DesignProblem(), [0.20, 0.22]).heaves
    (0.21, 0.2, 0.22)
    """
    check_list("heaves", heaves, "a list of heights", error=DesignError)
    others = (heave for heave in heaves if heave != problem.home_heave)
    return replace(problem, heaves=(problem.home_heave, *others))
