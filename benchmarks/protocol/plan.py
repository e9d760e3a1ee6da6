"""The cells of a preset. A cell is one independent run: it trains or plans, then it is tested.

A cell is (method, ablation, geometry, track, seed). Learners and controls have a track, planners
only on an imperfect machine; all see the same test episodes. The geometric optimization is one
cell. On public tasks a cell's track is the task, and it has no geometry.
"""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from itertools import product
from typing import Any, Final

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol.learners import LEARNERS, algorithm_of, learner_of
from benchmarks.protocol.presets import Guide, Preset, RunGroup, SuitePreset, Track
from coop_env.errors import ArgumentError
from coop_env.simulation.sim_to_real import SimToReal

CONTROLS: Final = ("random", "greedy", "lookahead", "greedy_observed", "lookahead_observed")
PERFECT_PLANNERS: Final = ("rrt_connect", "rrt_lattice", "optimum")  # without a track
OPTIMUM_AT_ONCE: Final = "optimum_at_once"  # without one, too: both robots in the same tick
IMPERFECT_PLANNERS: Final = ("nominal_plan", "plan_search", "rrt_connect", "optimum")
#: methods of a track with a team
OF_TEAMS: Final = (*(name for name, each in LEARNERS.items() if each.teams), "random", "greedy")
PLANNERS: Final = tuple(dict.fromkeys((*PERFECT_PLANNERS, *IMPERFECT_PLANNERS, OPTIMUM_AT_ONCE)))
DESIGN: Final = "design"
#: of the insertion task
METHODS: Final = (
    *(name for name, each in LEARNERS.items() if each.discrete), *CONTROLS, *PLANNERS
)  # fmt: skip
GEOMETRIES: Final = ("initial", "optimized")
ATARI: Final = "ALE/"
#: public tasks for which there is a script
SCRIPTED: Final = (
    *("CartPole-v1", "Acrobot-v1", "MountainCar-v0", "LunarLander-v3"),
    *("MinAtar/asterix", "MinAtar/breakout", "MinAtar/freeway", "MinAtar/seaquest"),
    "MinAtar/space_invaders",
)
# bytes of a transition in a checkpointed replay buffer: of the insertion task; two images of
# 10 x 10 x 7; a stack of frames
TRANSITION_BYTES: Final = (200, 1_600, 60_000)
#: what a cell's folder may be called
_FOLDER: Final = re.compile(r"[\w.+-]+")
# roughly the seconds of an environment step relative to others, for progress bars alone
ATARI_COST: Final = 10.0
CONTROL_COST: Final = 20.0  # of an episode that is tested

# of Rainbow's six components: the constructor argument that switches each off
OFF: Final[dict[str, Any]] = {
    "prioritized": False,
    "dueling": False,
    "n_steps": 1,
    "noisy": False,
    "distributional": False,
    "double_q": False,
}
# ablation -> what it switches off
ABLATIONS: Final[dict[str, dict[str, Any]]] = {
    "full": {},
    **{f"no_{name}": {name: off} for name, off in OFF.items()},
    "none": dict(OFF),
    "double_dueling": {n: off for n, off in OFF.items() if n not in ("double_q", "dueling")},
}


@dataclass(frozen=True, order=True)
class Cell:
    """One run; on public tasks a method may be ``<learner>_<variant>``."""

    method: str
    ablation: str
    geometry: str
    track: str
    seed: int

    @property
    def id(self) -> str:
        """The run's folder name, unique within a preset."""
        if self.method == DESIGN:
            return DESIGN
        if not self.geometry:
            return f"{self.track}-{self.method}-s{self.seed}"
        ablation = "" if self.ablation == "full" else self.ablation
        parts = (self.method, ablation, self.geometry, self.track, f"s{self.seed}")
        return "-".join(filter(None, parts))

    @property
    def learns(self) -> bool:
        """Whether the cell trains a network."""
        return learner_of(self.method) is not None

    @property
    def plans(self) -> bool:
        return self.method in PLANNERS


def explores(method: str) -> bool:
    """Whether a method has another way of acting: as it was trained, or with random moves."""
    return method in LEARNERS or (method in CONTROLS and method != "random")


def of_task(method: str, task: str, seed: int) -> Cell:
    """A cell of a public task."""
    return Cell(method, "full", "", task, seed)


def _of_suite(preset: SuitePreset) -> Iterator[Cell]:
    for key, task in preset.tasks.items():
        methods = [method for method in preset.methods if method not in task.skip]
        controls = [c for c in preset.controls if c != "script" or task.env in SCRIPTED]
        for method in [*methods, *controls]:
            shared = preset.seeds if task.seeds is None else task.seeds
            for seed in preset.method_seeds.get(method, shared):
                yield of_task(method, key, seed)


def _of_groups(preset: Preset) -> Iterator[Cell]:
    for group in preset.runs:
        for problem in _problems(preset, group):
            raise BenchmarkError(f"preset '{preset.name}': {problem}")
        for seed in preset.seeds if group.seeds is None else group.seeds:
            tracks = group.tracks or [""]
            kinds = product(group.methods, group.ablations, group.geometries, tracks)
            yield from (Cell(*kind, seed) for kind in kinds)
    if preset.design is not None:
        yield Cell(DESIGN, "full", "optimized", "", 0)


def expand(preset: Preset | SuitePreset) -> list[Cell]:
    """All cells of ``preset``, each once, the longest runs first; of public tasks seed by seed.

    Raises:
        BenchmarkError: a method, ablation, geometry or track is unknown or cannot be combined, or
            there is no cell.
    """
    expanded = _of_suite(preset) if isinstance(preset, SuitePreset) else _of_groups(preset)
    cells = dict.fromkeys(expanded)
    if not cells:
        raise BenchmarkError(
            f"preset '{preset.name}' holds no run: runs and design are empty, a group lists no "
            "methods, or every task skips them all"
        )
    seen: dict[str, Cell] = {}
    for cell in cells:
        other = seen.setdefault(cell.id, cell)
        if other != cell or not _FOLDER.fullmatch(cell.id):
            raise BenchmarkError(
                f"preset '{preset.name}': cell '{cell.id}' "
                + ("stands for two" if other != cell else "is no name of a folder")
                + ": name tracks, tasks and geometries by letters, digits and . _ +"
            )

    @cache
    def units_but_for_seed(cell: Cell) -> int:
        return units_of(settings(preset, cell))

    def order(cell: Cell) -> tuple[int, int]:
        units = -units_but_for_seed(replace(cell, seed=0))
        # a suite goes seed by seed; else the longest runs come first, equals seed by seed
        return (cell.seed, units) if isinstance(preset, SuitePreset) else (units, cell.seed)

    return sorted(cells, key=order)


def units_of(config: dict[str, Any]) -> int:
    """A rough cost of a run by its settings, in environment steps; decides the order of runs."""
    if "task" in config:
        cost = ATARI_COST if config["task"]["env"].startswith(ATARI) else 1.0
        if "arguments" not in config:
            return round(cost * CONTROL_COST * config["final_episodes"])
        cost *= LEARNERS[algorithm_of(config["cell"]["method"])].cost
        return max(1, round(config["task"]["timesteps"] * cost))
    track = config.get("track", {})
    if "timesteps" in track:
        return int(track["timesteps"])
    if "design" in config:
        return 1_500 * int(config["design"]["runs"])
    levels = len(config["evaluation"].get("errors", [0.0]))
    return 150 * levels * int(config["evaluation"]["episodes"])


def checkpoint_bytes(preset: Preset | SuitePreset, cell: Cell) -> int:
    """Size of a checkpoint, which is that of a learner's replay buffer, generously."""
    if not cell.learns:
        return 0
    small, large, atari = TRANSITION_BYTES
    if isinstance(preset, Preset):
        return small * preset.tracks[cell.track].hyperparameters.buffer_size
    task = preset.tasks[cell.track]
    size = int(task.arguments_of(cell.method).get("buffer_size", 1_000_000))
    return size * (atari if task.env.startswith(ATARI) else large)


def settings(preset: Preset | SuitePreset, cell: Cell) -> dict[str, Any]:
    """Everything that decides the cell's result, as plain YAML types: the run's config.yaml.

    What does not decide it is left out. So is a key that was added later, at the value that older
    runs had: they still match.
    """
    if isinstance(preset, SuitePreset):
        return _of_task(preset, cell)
    config: dict[str, Any] = {"cell": asdict(cell)}
    if cell.method == DESIGN:
        assert preset.design is not None
        config["design"] = asdict(preset.design)
        return config
    track = preset.tracks[cell.track] if cell.track else None
    config["evaluation"] = _evaluation(preset, track)
    if cell.geometry in preset.geometries:
        config["dimensions"] = dict(preset.geometries[cell.geometry])
    if track is not None:
        config["track"] = _track(track, cell.method)
    if cell.learns:
        config["switches"] = dict(ABLATIONS[cell.ablation])
    elif cell.method in PLANNERS:
        config["planner"] = asdict(preset.planner)
    return config


def _of_task(preset: SuitePreset, cell: Cell) -> dict[str, Any]:
    task, kind = preset.tasks[cell.track], "learn" if cell.learns else "control"
    keys = ["env", "env_kwargs", "eval_episodes"]
    if cell.learns:
        keys = ["env", "timesteps", "eval_every", "eval_episodes", "env_kwargs", "policy", "n_envs"]
        keys += [rare for rare in ("guide", "bare") if getattr(task, rare)]
    values = {key: getattr(task, key) for key in keys}  # asdict copies all methods' arguments too
    return {
        "cell": {"kind": kind, "task": cell.track, "method": cell.method, "number": cell.seed},
        "task": {k: asdict(v) if isinstance(v, Guide) else v for k, v in values.items()},
        **({"arguments": task.arguments_of(cell.method)} if cell.learns else {}),
        "final_episodes": preset.final_episodes,
    }


def _evaluation(preset: Preset, track: Track | None) -> dict[str, Any]:
    config = asdict(preset.evaluation)
    if track is None or track.sim_to_real is None:
        del config["errors"]
    unsaid = (("stream", "test"), ("exploring", False))
    return {key: value for key, value in config.items() if (key, value) not in unsaid}


def _track(track: Track, method: str) -> dict[str, Any]:
    config = asdict(track)
    learner = LEARNERS.get(method)
    config["methods"] = {key: given for key, given in track.methods.items() if key == method}
    unused = [] if learner and learner.on_policy else ["ppo"]
    unused += [] if method in CONTROLS else ["controls"]
    if learner is None:
        unused += ["description", "timesteps", "hyperparameters", "curriculum", "train_nominal"]
    later = ("sim_to_real", "train_nominal", "mask_refused", "team", "sight", "task", "methods")
    unused += [key for key in later if not config[key]]
    defaults = {"shield": None, "collision": "refuse"}
    unused += [key for key, default in defaults.items() if config[key] == default]
    return {key: value for key, value in config.items() if key not in unused}


def own_error(machine: Mapping[str, Any]) -> float:
    """Bound of the base's displacement of a track's ``sim_to_real``, mm."""
    return round(1000.0 * float(machine["base_position_error"]), 6)


def displaced(machine: Mapping[str, Any], error: float) -> SimToReal:
    """A track's machine with its base displaced by up to ``error`` mm, and tilted in proportion."""
    real = SimToReal(**machine)
    share = 1e-3 * error / real.base_position_error
    tilt = share * real.base_tilt_error
    return replace(real, base_position_error=1e-3 * error, base_tilt_error=tilt)


def _problems(preset: Preset, group: RunGroup) -> Iterator[str]:
    for kind, names, allowed in (
        ("method", group.methods, METHODS),
        ("ablation", group.ablations, tuple(ABLATIONS)),
        ("geometry", group.geometries, (*GEOMETRIES, *preset.geometries)),
        ("track", group.tracks, tuple(preset.tracks)),
    ):
        for name in names:
            if name not in allowed:
                yield f"unknown {kind} '{name}'; known: {known(allowed)}"
    for name in group.tracks:
        track = preset.tracks[name]
        if track.sim_to_real:
            own = own_error(track.sim_to_real)
            if not any(math.isclose(own, level) for level in preset.evaluation.errors):
                yield f"evaluation: errors lack {own:g} mm, track '{name}'s own"
            for level in preset.evaluation.errors:
                try:
                    displaced(track.sim_to_real, level)
                except ArgumentError as error:
                    yield f"evaluation: errors: {level:g} mm on track '{name}': {error}"
        for problem in _of_team(track, group.methods):
            yield f"track '{name}': {problem}"
    for method in group.methods:
        if method in (*LEARNERS, *CONTROLS) and not group.tracks:
            yield f"method '{method}' needs a track"
        if method in PLANNERS:
            yield from _of_planner(preset, method, group.tracks)
        if method != "rainbow" and group.ablations != ["full"]:
            yield f"only rainbow has ablations, not '{method}'"


def _of_team(track: Track, methods: list[str]) -> Iterator[str]:
    if track.team is None:
        if track.sight:
            yield "sight = true is of a team: name it, or leave it out"
        return
    team = f"team = '{track.team}'"
    for key in ("mask_visited", "mask_refused", "sim_to_real", "shield", "collision"):
        if (value := getattr(track, key)) not in (0, False, None, "refuse"):
            yield f"{team}: {key} = {value!r} is of robots that move one at a time: leave it out"
    if track.team == "central" and track.sight:
        yield f"{team} sees both robots: leave out sight = true"
    if (envs := track.hyperparameters.n_envs) % track.rows:
        yield f"{team}: n_envs = {envs} is odd, but each team has two rows"
    for method in methods:
        if method not in OF_TEAMS:
            yield f"{team}: method '{method}' has no form for a team; known: {known(OF_TEAMS)}"
        elif method in LEARNERS and method != "rainbow" and track.team != "central":
            yield f"{team}: its networks are Rainbow's, not of '{method}'; take team = 'central'"


def _of_planner(preset: Preset, method: str, tracks: list[str]) -> Iterator[str]:
    if not tracks and method not in (*PERFECT_PLANNERS, OPTIMUM_AT_ONCE):
        yield f"method '{method}' needs a track with sim_to_real"
    for name in tracks:
        track = preset.tracks[name]
        known_machine = PERFECT_PLANNERS if track.task else ()
        if method not in (known_machine if track.sim_to_real is None else IMPERFECT_PLANNERS):
            yield (
                f"method '{method}' plans and takes no track '{name}'; with a track of task plan: "
                f"{known(PERFECT_PLANNERS)}; of sim_to_real: {known(IMPERFECT_PLANNERS)}"
            )
