"""Co-design: the 3-RRS is chosen for what the team achieves, not for its workspace alone.

Two studies, of (lambda1, lambda2) and of (L2, home heave). The exact optimum with both robots
moving at once scores designs for Optuna's NSGA-II: success and mean ticks. Then a policy is trained
on each of the chosen designs, over seeds, and tested on test starts. Complete parts are kept in
``results/codesign/``: the same command goes on from there.
"""

import argparse
import json
import math
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import yaml
from rich.console import Console
from scipy.optimize import Bounds, differential_evolution

from benchmarks.errors import BenchmarkError
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.reporting.figures.style import save, style
from benchmarks.runs.backends import Backend
from benchmarks.runs.harness import Harness
from benchmarks.runs.machine import describe
from benchmarks.runs.store import RunFolder, Store, write_text
from benchmarks.studies import codesign_report as report
from benchmarks.studies.base import Part, Study, Tick, count
from benchmarks.studies.codesign_report import BASE, MOST, POLICIES, STUDIES, SearchResult
from benchmarks.studies.insertion import Insertion
from coop_env.design import DesignProblem, measure, workspace_area
from coop_env.errors import ResetOptionError
from coop_env.geometry import GEOMETRIES, OPTIMIZED, GeometryError, RRSGeometry
from coop_env.team.joint_env import CoopInsertionJointEnv

Values = dict[str, float]
EPISODES: Final = 100  # of each test and seed
POPULATION: Final = 50  # of the sampler
#: decimals of a design's values
DIGITS: Final = {"lambda1": 4, "lambda2": 4, "distal_length": 5, "home_heave": 5}
BOUNDS: Final[dict[str, tuple[float, float]]] = {
    "lambda1": (0.8, 2.0),
    "lambda2": (0.6, 2.8),
    **{
        name: (round(low * getattr(OPTIMIZED, name), 5), round(1.35 * getattr(OPTIMIZED, name), 5))
        for name, low in (("distal_length", 0.75), ("home_heave", 0.65))
    },
}


class Unbuilt(Exception):
    """A design without a score, because of its ``lengths``, its ``home`` pose or its ``starts``."""


def parameters(geometry: RRSGeometry) -> Values:
    """The values of a geometry that the studies vary."""
    lambda1, lambda2, _ = geometry.lambdas
    heights = {name: getattr(geometry, name) for name in STUDIES["heights"]}
    return {"lambda1": lambda1, "lambda2": lambda2, **heights}


def rounded(values: Mapping[str, float]) -> Values:
    """The values as they are stored and built, rounded."""
    return {name: round(float(value), DIGITS[name]) for name, value in values.items()}


def geometry_of(values: Mapping[str, float]) -> RRSGeometry:
    """The optimized machine with some parameters changed; the range of heave moves with home."""
    of = parameters(OPTIMIZED) | dict(values)
    rise = of["home_heave"] - OPTIMIZED.home_heave
    return RRSGeometry.from_lambdas(
        **of,
        eta=OPTIMIZED.characteristic_length,
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


def area(geometry: RRSGeometry) -> float:
    """The paper's objective A_w at the geometry's own home, rad^2."""
    return workspace_area(geometry, DesignProblem.of(geometry))


def starts_of(geometry: RRSGeometry, seeds: Iterable[int]) -> Iterator[CoopInsertionJointEnv]:
    """The team's task on a geometry, at the start of each seed's episode; may raise Unbuilt."""
    try:
        env = CoopInsertionJointEnv(geometry=geometry, reward="progress")
    except GeometryError as error:
        raise Unbuilt("home") from error
    for seed in seeds:
        try:
            env.reset(seed=seed)
        except ResetOptionError as error:
            raise Unbuilt("starts") from error
        yield env


def build(values: Mapping[str, float]) -> RRSGeometry:
    """The geometry of a design; raises Unbuilt if it cannot do the task."""
    try:
        geometry = geometry_of(values)
    except GeometryError as error:
        raise Unbuilt("lengths") from error
    next(starts_of(geometry, [0]))
    return geometry


def optimum(
    geometry: RRSGeometry, seed: int, starts: int, stream: str = "validate"
) -> dict[str, float]:
    """The exact optimum's results, both robots at once, from a stream's starts of a seed.

    Undecided searches count as not solved. Raises Unbuilt where no start pose is found.
    """
    oracle = LatticeOracle(at_once=True)
    seeds = episode_seeds(seed, starts, stream)
    plans = [oracle.plan(env) for env in starts_of(geometry, seeds)]
    lengths = [math.nan if plan.moves is None else float(len(plan.moves)) for plan in plans]
    return {**reach(lengths), "undecided": sum(plan.status == "node_limit" for plan in plans)}


def reach(lengths: Sequence[float]) -> dict[str, float]:
    """Success in %, mean ticks of successes, and of all, where NaN counts as a whole episode."""
    ticks = np.asarray(lengths, dtype=float)
    solved = np.isfinite(ticks)
    return {
        "success": 100.0 * float(solved.mean()),
        "ticks": float(ticks[solved].mean()) if solved.any() else math.nan,
        "ticks_all": float(np.where(solved, ticks, MOST).mean()),
    }


def score(name: str, study: str, geometry: RRSGeometry, starts: int) -> dict[str, Any]:
    """A design's row of designs.csv."""
    values = {**rounded(parameters(geometry)), "a_w": area(geometry)}
    return {"design": name, "study": study, **values, **optimum(geometry, 0, starts)}


def search(
    folder: Path, study: str, floor: float, designs: int, starts: int, tick: Tick
) -> tuple[list[dict[str, Any]], dict[str, int], float]:
    """Run NSGA-II until ``designs`` designs have a score.

    The journal is on disk: a killed call goes on as if it had not been killed. A design with
    success below ``floor``, %, ranks below all others: one that reaches only the nearest targets
    looks quick.

    Returns:
        Their rows; how many designs had none, by reason; and the CPU seconds of the scores.
    """
    import optuna
    from optuna.storages.journal import JournalFileBackend, JournalFileOpenLock
    from optuna.trial import TrialState

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    path = str(folder / "journal.log")
    backend = JournalFileBackend(path, lock_obj=JournalFileOpenLock(path))
    run = optuna.create_study(
        storage=optuna.storages.JournalStorage(backend),
        study_name=study,
        directions=["maximize", "minimize"],
        load_if_exists=True,
    )
    space: Any = {n: optuna.distributions.FloatDistribution(*BOUNDS[n]) for n in STUDIES[study]}
    for left in run.get_trials(states=(TrialState.RUNNING,)):
        run.tell(left.number, state=TrialState.FAIL)  # its design is proposed again
    while True:
        rows = [t.user_attrs["row"] for t in run.get_trials(states=(TrialState.COMPLETE,))]
        skipped = dict(Counter(run.user_attrs.values()))
        if len(rows) >= designs:
            seconds = sum(t.user_attrs.get("seconds", 0.0) for t in run.get_trials())
            return rows, skipped, seconds
        tick(len(rows) / designs)
        number = len(rows) + sum(skipped.values())
        # one sampler each, so that a proposal depends only on the designs before it
        run.sampler = optuna.samplers.NSGAIISampler(population_size=POPULATION, seed=number)
        trial, began = run.ask(space), time.process_time()
        try:
            row = score(f"{study}-{number}", study, build(rounded(trial.params)), starts)
        except Unbuilt as error:
            trial.set_user_attr("seconds", time.process_time() - began)
            run.set_user_attr(str(trial.number), str(error))
            run.tell(trial, state=TrialState.FAIL)
            continue
        trial.set_user_attr("seconds", time.process_time() - began)
        trial.set_user_attr("row", row)
        trial.set_constraint("floor", floor - row["success"])
        run.tell(trial, (row["success"], row["ticks"] if row["success"] > 0.0 else float(MOST)))


class Codesign(Study):
    """Designs by the optimum, and policies on the chosen ones."""

    name = "codesign"
    needs = ("optuna", "tune")
    options = {  # noqa: RUF012
        "--designs": count(300, "designs scored per study", 2),
        "--starts": count(200, "validation starts per design", 2),
        "--seeds": count(5, "trainings per chosen design", 2),
        "--policy-steps": count(None, "steps of each"),
        "--jobs": count(None, "processes"),
    }

    def __init__(self, given: argparse.Namespace) -> None:
        super().__init__(given)
        self.run_folder = RunFolder(self.folder)
        names = ("designs", "starts", "seeds", "policy_steps")
        self.asked: dict[str, Any] = {name: getattr(given, name) for name in names}
        self.held = ExitStack()  # of all: two would share the journal
        self.held.enter_context(self.run_folder.lock())
        self.run_folder.begin({"geometry": BASE, "bounds": [], **self.asked})
        self.rows: list[dict[str, Any]] = []
        self.studies: dict[str, Any] = {}
        self.seconds = 0.0  # of the searches over all calls, of the named designs in the last

    def parts(self) -> dict[str, Part]:
        if (self.folder / "codesign.json").is_file():
            return {}
        searches = {study: partial(self._search, study) for study in STUDIES}
        return {"named designs": self._score_named, **searches}

    def _score_named(self, tick: Tick) -> None:
        starts, began = self.asked["starts"], time.process_time()
        for name, geometry in GEOMETRIES.items():
            study = report.ALL if name == BASE else "lambdas"
            self.rows.append(score(name, study, geometry, starts))
        self.floor = min(row["success"] for row in self.rows)
        for study in STUDIES:
            best = geometry_of(area_best(study))
            self.rows.append(score(f"{study}-area", study, best, starts))
        self.seconds += time.process_time() - began

    def _search(self, study: str, tick: Tick) -> None:
        size = (self.asked["designs"], self.asked["starts"])
        rows, skipped, seconds = search(self.folder, study, self.floor, *size, tick)
        self.seconds += seconds
        self.rows += rows
        bounds = {name: BOUNDS[name] for name in STUDIES[study]}
        self.studies[study] = {"skipped": skipped, "bounds": bounds}

    def finish(self) -> None:
        if self.rows:
            self.run_folder.write_rows("designs", self.rows)
            record = {
                "command": self.given.command,
                "machine": describe(),
                "cpu_seconds": self.seconds,
                "floor": self.floor,
                "most": MOST,
                "base": BASE,
                "studies": self.studies,
            }
            write_text(self.folder / "codesign.json", json.dumps(record, indent=1) + "\n")
        with self.held:
            result = SearchResult(self.folder)
            self._test(result)
            self._train(self._write_preset(result))
        with style():
            for kind in ("png", "pdf"):
                figure = report.fronts(SearchResult(self.folder))
                save(figure, self.folder / "figures" / f"fronts.{kind}")

    def _test(self, result: SearchResult) -> None:
        """The optimum of the chosen designs on their test starts, unless it is there."""
        if self.run_folder.has_rows("chosen"):
            return
        rows: list[dict[str, Any]] = []
        for design, why in result.choose().items():
            geometry = of_row(result.row(design))
            # NaN where the cone is out of reach
            margin = measure(geometry, DesignProblem.of(geometry)).sigma_cone
            row = {"design": design, "chosen": why, "sigma_cone": margin}
            rows += [
                {**row, "seed": seed, **optimum(geometry, seed, EPISODES, "test")}
                for seed in range(self.asked["seeds"])
            ]
        self.run_folder.write_rows("chosen", rows)

    def _write_preset(self, result: SearchResult) -> Path:
        """The preset that trains a policy on each of the chosen designs."""
        steps, chosen = self.asked["policy_steps"], list(result.choose())
        own = {design: of_row(result.row(design)) for design in chosen if design not in GEOMETRIES}
        preset = {
            "description": "A policy on each of the designs that the co-design chose",
            "seeds": list(range(self.asked["seeds"])),
            "evaluation": {"episodes": EPISODES, "noise": [0.0], "stream": "test"},
            "tracks": {report.OF_ONE: {"timesteps": steps} if steps else None},
            "geometries": {design: asdict(geometry) for design, geometry in own.items()},
            "runs": [{"methods": ["rainbow"], "geometries": chosen, "tracks": [report.OF_ONE]}],
        }
        path = self.folder / f"{POLICIES}.yaml"
        write_text(path, yaml.safe_dump(preset, sort_keys=False))
        return path

    def _train(self, preset: Path) -> None:
        """Run the cells of the preset that are missing; if it is interrupted, the rest is kept."""
        experiment, console = Insertion(str(preset)), Console(soft_wrap=True, markup=False)
        store = experiment.open_store(self.folder, create=True)
        with store.lock():
            outcome = Harness(experiment, store, Backend(self.given.jobs), console).run()
            if outcome.interrupted:
                raise KeyboardInterrupt
            if outcome.close(store, console, lambda: None):
                raise BenchmarkError(f"{store.folder}: runs failed; the same command tries again")

    @classmethod
    def files(cls, results: Path) -> dict[Path, str]:
        folder = results / "codesign"
        if not (folder / "chosen.csv").is_file():
            return {}
        return {folder / "codesign.md": report.to_markdown(SearchResult(folder)) + "\n"}

    @classmethod
    def problems(cls, results: Path) -> list[str]:
        preset, result = results / "codesign" / f"{POLICIES}.yaml", super().problems(results)
        if preset.is_file():
            result += Insertion(str(preset)).problems(Store(preset.parent, POLICIES))
        return result
