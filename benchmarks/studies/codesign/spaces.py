"""What the co-design varies of the optimized 3-RRS, and what can be said of one design of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from scipy.optimize import Bounds, differential_evolution

from benchmarks.methods.oracle import LatticeOracle
from benchmarks.protocol.seeding import episode_seeds
from coop_env.design import DesignProblem, measure, workspace_area
from coop_env.errors import ResetOptionError
from coop_env.geometry import GEOMETRIES, OPTIMIZED, GeometryError, RRSGeometry
from coop_env.team.joint_env import CoopInsertionJointEnv

Values = dict[str, float]

#: the studies and what each varies
STUDIES: Final = {
    "lambdas": ("lambda1", "lambda2"),
    "heights": ("distal_length", "home_heave"),
}
POPULATION: Final = 50  # of the sampler; the first is drawn at random
BASE: Final = "optimized"  # which all studies begin from
ALL: Final = "all"  # its study
#: digits that designs are made with
DIGITS: Final = {"lambda1": 4, "lambda2": 4, "distal_length": 5, "home_heave": 5}
STREAM: Final = "validate"
OF_ONE: Final = "central"  # the track of the policies on chosen designs: both robots at once
MOST: Final = 300  # ticks of an episode, the task's default
UNBUILT: Final = {
    "lengths": "break the paper's constraints on the lengths",
    "home": "cannot take their home pose within the joint limits",
    "starts": "have too little workspace for a start state",
}


class Unbuilt(Exception):
    """A design without a score, by one of the reasons of :data:`UNBUILT`."""


def parameters(geometry: RRSGeometry) -> Values:
    """What the studies vary, of a geometry."""
    lambda1, lambda2, _ = geometry.lambdas
    heights = {name: getattr(geometry, name) for name in STUDIES["heights"]}
    return {"lambda1": lambda1, "lambda2": lambda2, **heights}


def rounded(values: Mapping[str, float]) -> Values:
    """The values as they are stored, and built."""
    return {name: round(float(value), DIGITS[name]) for name, value in values.items()}


def _shares(low: float, high: float, name: str) -> tuple[float, float]:
    own = parameters(OPTIMIZED)[name]
    return round(low * own, 5), round(high * own, 5)


BOUNDS: Final[dict[str, tuple[float, float]]] = {
    "lambda1": (0.8, 2.0),
    "lambda2": (0.6, 2.8),
    "distal_length": _shares(0.75, 1.35, "distal_length"),
    "home_heave": _shares(0.65, 1.35, "home_heave"),
}


def geometry_of(values: Mapping[str, float]) -> RRSGeometry:
    """The optimized machine with some parameters changed; the range of heave moves with home.

    Raises:
        GeometryError: there is no such machine.
    """
    of = parameters(OPTIMIZED) | dict(values)
    rise = of["home_heave"] - OPTIMIZED.home_heave
    return RRSGeometry.from_lambdas(
        of["lambda1"],
        of["lambda2"],
        eta=OPTIMIZED.characteristic_length,
        distal_length=of["distal_length"],
        home_heave=of["home_heave"],
        heave_min=OPTIMIZED.heave_min + rise,
        heave_max=OPTIMIZED.heave_max + rise,
        **{name: getattr(OPTIMIZED, name) for name in ("joint_min", "joint_max", "max_tilt")},
    )


def of_row(row: Mapping[Any, Any]) -> RRSGeometry:
    """The geometry of a row of designs.csv."""
    if row["design"] in GEOMETRIES:
        return GEOMETRIES[row["design"]]
    return geometry_of({name: row[name] for name in STUDIES[row["study"]]})


def area_best(study: str) -> Values:
    """The values with the largest workspace at home, by differential evolution."""
    names = STUDIES[study]

    def lost(x: np.ndarray, /) -> float:
        try:
            return -area(geometry_of(dict(zip(names, x, strict=True))))
        except GeometryError:
            return 0.0

    low, high = np.array([BOUNDS[name] for name in names]).T
    result = differential_evolution(
        lost, Bounds(low, high), rng=np.random.default_rng(0), popsize=20, tol=1e-4, polish=False
    )
    return rounded(dict(zip(names, map(float, result.x), strict=True)))


def _problem(geometry: RRSGeometry) -> DesignProblem:
    return DesignProblem(
        eta=geometry.characteristic_length,
        distal_length=geometry.distal_length,
        heaves=(geometry.home_heave,),
        joint_min=geometry.joint_min,
        joint_max=geometry.joint_max,
    )


def area(geometry: RRSGeometry) -> float:
    """The paper's objective A_w at the geometry's own home, rad^2."""
    return workspace_area(geometry, _problem(geometry))


def margin(geometry: RRSGeometry) -> float:
    """Least signed sigma_min over the cone of 28 degrees about home; NaN if it is out of reach."""
    return measure(geometry, _problem(geometry)).sigma_cone


def assemble(geometry: RRSGeometry) -> CoopInsertionJointEnv:
    """The team's task on a geometry.

    Raises:
        Unbuilt: it has no home pose, or no start state.
    """
    try:
        env = CoopInsertionJointEnv(geometry=geometry, reward="progress")
    except GeometryError as error:
        raise Unbuilt("home") from error
    begin(env, 0)
    return env


def begin(env: CoopInsertionJointEnv, seed: int) -> np.ndarray:
    """Start an episode; its observation.

    Raises:
        Unbuilt: no start state was found.
    """
    try:
        observation: np.ndarray = env.reset(seed=seed)[0]
    except ResetOptionError as error:
        raise Unbuilt("starts") from error
    return observation


def build(values: Mapping[str, float]) -> RRSGeometry:
    """The geometry of a design that can do the task.

    Raises:
        Unbuilt: there is none.
    """
    try:
        geometry = geometry_of(values)
    except GeometryError as error:
        raise Unbuilt("lengths") from error
    assemble(geometry)
    return geometry


@dataclass(frozen=True)
class Reach:
    """What the exact optimum achieves from so many starts.

    Attributes:
        success: share of the starts from which the target can be reached, %.
        ticks: mean over those.
        ticks_all: mean over all, a start that was not solved at the episode's length.
        undecided: starts at which the search gave up; they count as not solved.
    """

    success: float
    ticks: float
    ticks_all: float
    undecided: int


def optimum(geometry: RRSGeometry, seed: int, starts: int, stream: str = STREAM) -> Reach:
    """Both robots moving at once, from the fixed starts of a stream's seed.

    A start is drawn, by its fixed seed, among the poses that this geometry can take.

    Raises:
        Unbuilt: a start found no pose.
    """
    env, oracle = assemble(geometry), LatticeOracle(at_once=True)
    lengths, undecided = [], 0
    for start in episode_seeds(seed, starts, stream):
        begin(env, start)
        plan = oracle.plan(env)
        lengths.append(math.nan if plan.moves is None else float(len(plan.moves)))
        undecided += plan.status == "node_limit"
    return Reach(*summary(lengths), undecided)


def summary(lengths: Sequence[float]) -> tuple[float, float, float]:
    """Success in %, mean ticks of those that succeed, and of all, NaN counting a whole episode."""
    ticks = np.asarray(lengths, dtype=float)
    solved = np.isfinite(ticks)
    mean = float(ticks[solved].mean()) if solved.any() else math.nan
    return 100.0 * float(solved.mean()), mean, float(np.where(solved, ticks, MOST).mean())
