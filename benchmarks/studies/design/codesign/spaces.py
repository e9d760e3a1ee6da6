"""What a study of the co-design varies of a 3-RRS, and what can be said of one design of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.optimize import Bounds, differential_evolution

from benchmarks.errors import BenchmarkError, known
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.protocol.presets import read_yaml
from benchmarks.protocol.seeding import episode_seeds
from coop_env.design import DesignProblem, measure, workspace_area
from coop_env.errors import ArgumentError, ResetOptionError
from coop_env.geometry import GEOMETRIES, GeometryError, RRSGeometry, resolve_rrs
from coop_env.team.joint_env import CoopInsertionJointEnv

Values = dict[str, float]
Ranges = dict[str, tuple[float, float]]

#: the studies and what each varies; a parameter's digits are those that designs are made with
STUDIES: Final = {
    "lambdas": ("lambda1", "lambda2"),
    "heights": ("distal_length", "home_heave"),
}
POPULATION: Final = 50  # of the sampler; the first is drawn at random
ALL: Final = "all"  # the study of the design that all begin from
DIGITS: Final = {"lambda1": 4, "lambda2": 4, "distal_length": 5, "home_heave": 5}
LENGTHS: Final[Ranges] = {"lambda1": (0.8, 2.0), "lambda2": (0.6, 2.8)}
#: of the other two, as shares of the given machine's
SHARES: Final[Ranges] = {"distal_length": (0.75, 1.35), "home_heave": (0.65, 1.35)}
STREAM: Final = "validate"
#: whose reward, masks and hyperparameters the policy for all designs is trained with, and the track
#: of those that are trained on one design; all move both robots at once
TRACK, OF_ONE = "safe", "central"
UNBUILT: Final = {
    "lengths": "break the paper's constraints on the lengths",
    "home": "cannot take their home pose within the joint limits",
    "starts": "have too little workspace for a start state",
}


class Unbuilt(Exception):
    """A design without a score, by one of the reasons of :data:`UNBUILT`."""


@dataclass(frozen=True)
class Machine:
    """The 3-RRS that is varied, and within which bounds.

    Of a design that moves home, the range of heave moves with it.

    Attributes:
        named: the designs that are there before any search; the one that is varied is the last.
        bounds: of each parameter.
        most: ticks of an episode.
    """

    named: dict[str, RRSGeometry]
    bounds: Ranges
    most: int

    @property
    def base(self) -> RRSGeometry:
        """The one that is varied."""
        return self.named[self.base_name]

    @property
    def base_name(self) -> str:
        return list(self.named)[-1]

    def of(self, row: Mapping[Any, Any]) -> RRSGeometry:
        """The geometry of a row of designs.csv."""
        if row["design"] in self.named:
            return self.named[row["design"]]
        return self.geometry({name: row[name] for name in STUDIES[row["study"]]})

    def geometry(self, values: Mapping[str, float]) -> RRSGeometry:
        """The given machine with some of its parameters changed.

        Raises:
            GeometryError: there is no such machine.
        """
        of = parameters(self.base) | dict(values)
        rise = of["home_heave"] - self.base.home_heave
        return RRSGeometry.from_lambdas(
            of["lambda1"],
            of["lambda2"],
            eta=self.base.characteristic_length,
            distal_length=of["distal_length"],
            home_heave=of["home_heave"],
            heave_min=self.base.heave_min + rise,
            heave_max=self.base.heave_max + rise,
            **{name: getattr(self.base, name) for name in ("joint_min", "joint_max", "max_tilt")},
        )

    def features(self, geometry: RRSGeometry) -> np.ndarray:
        """A geometry's parameters (4,) as shares of the bounds, for a policy to see."""
        found = parameters(geometry)
        shares = [(found[name] - low) / (high - low) for name, (low, high) in self.bounds.items()]
        return np.clip(np.array(shares, np.float32), 0.0, 1.0)

    def draw(self, study: str, rng: np.random.Generator) -> Values:
        """Values of a study's parameters, uniform within the bounds."""
        return rounded({name: rng.uniform(*self.bounds[name]) for name in STUDIES[study]})

    def area_best(self, study: str) -> Values:
        """The values with the largest workspace at home, by differential evolution.

        Raises:
            BenchmarkError: no design within the bounds has any.
        """
        names = STUDIES[study]

        def lost(x: np.ndarray, /) -> float:
            try:
                return -area(self.geometry(dict(zip(names, x, strict=True))))
            except GeometryError:
                return 0.0

        bounds = [self.bounds[name] for name in names]
        low, high = np.array(bounds).T
        found = differential_evolution(
            lost,
            Bounds(low, high),
            rng=np.random.default_rng(0),
            popsize=20,
            tol=1e-4,
            polish=False,
        )
        if found.fun == 0.0:
            ranges = ", ".join(f"{name} {low:g}:{high:g}" for name, (low, high) in zip(
                names, bounds, strict=True))  # fmt: skip
            raise BenchmarkError(
                f"no 3-RRS within {ranges} was found to have a workspace about its home: choose "
                "other --bounds or another --geometry"
            )
        return rounded(dict(zip(names, map(float, found.x), strict=True)))


def given(text: str) -> str | dict[str, Any]:
    """What ``--geometry`` names: one of the two designs, or the fields that a YAML file holds.

    Raises:
        BenchmarkError: it is neither.
    """
    if text in GEOMETRIES:
        return text
    if not Path(text).is_file():
        raise BenchmarkError(
            f"--geometry {text}: neither {known(GEOMETRIES)} nor a YAML file with fields of "
            "RRSGeometry"
        )
    return read_yaml(Path(text))


def machine_of(geometry: str | Mapping[str, Any], bounds: Sequence[str]) -> Machine:
    """The machine that the command line speaks of.

    Args:
        geometry: of :func:`given`.
        bounds: texts ``name=low:high`` in place of the defaults.

    Raises:
        BenchmarkError: one of them makes no sense.
    """
    try:
        base = resolve_rrs(geometry)
    except (ArgumentError, GeometryError) as error:
        raise BenchmarkError(f"--geometry: {error}") from error
    own = parameters(base)
    found = LENGTHS | {
        name: (round(low * own[name], 5), round(high * own[name], 5))
        for name, (low, high) in SHARES.items()
    }
    for text in bounds:
        name, low, high = _bound(text, found)
        found[name] = (low, high)
    try:
        env = assemble(base)
    except Unbuilt as error:
        raise BenchmarkError(
            f"--geometry: such machines {UNBUILT[str(error)]}; choose other lengths or another home"
        ) from error
    named = {geometry if isinstance(geometry, str) else "given": base}
    if geometry == "optimized":
        named = dict(GEOMETRIES)
    return Machine(named, found, int(env.params.task.max_moves))


def _bound(text: str, names: Mapping[str, Any]) -> tuple[str, float, float]:
    name, _, span = text.partition("=")
    try:
        low, high = (float(end) for end in span.split(":"))
    except ValueError:
        low, high = math.nan, math.nan
    if name not in names or not 0.0 < low < high < math.inf:
        raise BenchmarkError(
            f"--bounds {text}: must be name=low:high with 0 < low < high (lengths in m); names: "
            f"{known(names)}"
        )
    return name, low, high


def parameters(geometry: RRSGeometry) -> Values:
    """What the studies vary, of a geometry."""
    lambda1, lambda2, _ = geometry.lambdas
    heights = {name: getattr(geometry, name) for name in STUDIES["heights"]}
    return {"lambda1": lambda1, "lambda2": lambda2, **heights}


def rounded(values: Mapping[str, float]) -> Values:
    """The values as they are stored, and built."""
    return {name: round(float(value), DIGITS[name]) for name, value in values.items()}


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


def assemble(geometry: RRSGeometry, **arguments: Any) -> CoopInsertionJointEnv:
    """The team's task on a geometry.

    Raises:
        Unbuilt: it has no home pose, or no start state.
    """
    try:
        env = CoopInsertionJointEnv(geometry=geometry, **{"reward": "progress", **arguments})
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


def build(machine: Machine, values: Mapping[str, float]) -> RRSGeometry:
    """The geometry of a design that can do the task.

    Raises:
        Unbuilt: there is none.
    """
    try:
        geometry = machine.geometry(values)
    except GeometryError as error:
        raise Unbuilt("lengths") from error
    assemble(geometry)
    return geometry


@dataclass(frozen=True)
class Optimum:
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


def optimum(geometry: RRSGeometry, seed: int, starts: int, stream: str = STREAM) -> Optimum:
    """Both robots moving at once, from the fixed starts of a stream's seed.

    A start is drawn, by its fixed seed, among the poses that this geometry can take.

    Raises:
        Unbuilt: a start found no pose.
    """
    env = assemble(geometry)
    oracle = LatticeOracle(at_once=True)
    lengths, undecided = [], 0
    for start in episode_seeds(seed, starts, stream):
        begin(env, start)
        plan = oracle.plan(env)
        lengths.append(math.nan if plan.moves is None else float(len(plan.moves)))
        undecided += plan.status == "node_limit"
    return Optimum(*summary(lengths, env.params.task.max_moves), undecided)


def summary(lengths: Sequence[float], most: int) -> tuple[float, float, float]:
    """Success in %, mean ticks of those that succeed, and of all, NaN counting ``most``."""
    ticks = np.asarray(lengths, dtype=float)
    solved = np.isfinite(ticks)
    mean = float(ticks[solved].mean()) if solved.any() else math.nan
    return 100.0 * float(solved.mean()), mean, float(np.where(solved, ticks, most).mean())
