"""Which cells a preset holds. One cell is one independent run: it trains or plans, then is tested.

A cell is (method, ablation, geometry, track, seed). Learners and controls have a track; planners
have none, but on an imperfect machine, and see the same test episodes. The geometric optimization
is one cell of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol.presets import Preset, RunGroup, Track, as_dict

LEARNERS: Final = ("rainbow", "dqn", "maskable_ppo")
CONTROLS: Final = ("random", "greedy", "lookahead", "greedy_observed", "lookahead_observed")
PERFECT_PLANNERS: Final = ("rrt_connect", "rrt_lattice", "optimum")  # without a track
OPTIMUM_AT_ONCE: Final = "optimum_at_once"  # without one, too: both robots in the same tick
IMPERFECT_PLANNERS: Final = ("nominal_plan", "plan_search", "rrt_connect", "optimum")
OF_TEAMS: Final = ("rainbow", "random", "greedy")  # methods of a track with a team
PLANNERS: Final = tuple(dict.fromkeys((*PERFECT_PLANNERS, *IMPERFECT_PLANNERS, OPTIMUM_AT_ONCE)))
DESIGN: Final = "design"
METHODS: Final = (*LEARNERS, *CONTROLS, *PLANNERS)
TRANSITION_BYTES: Final = 200
GEOMETRIES: Final = ("initial", "optimized")

# hyperparameters that are left out of a run's settings where they are 0
_LATER: Final = ("advantage_learning",)

# ablation -> the Rainbow constructor arguments that switch components off
ABLATIONS: Final[dict[str, dict[str, Any]]] = {
    "full": {},
    "no_prioritized": {"prioritized": False},
    "no_dueling": {"dueling": False},
    "no_n_steps": {"n_steps": 1},
    "no_noisy": {"noisy": False},
    "no_distributional": {"distributional": False},
    "no_double_q": {"double_q": False},
    "none": {
        "prioritized": False,
        "dueling": False,
        "n_steps": 1,
        "noisy": False,
        "distributional": False,
        "double_q": False,
    },
    "double_dueling": {
        "prioritized": False,
        "n_steps": 1,
        "noisy": False,
        "distributional": False,
    },
}


@dataclass(frozen=True, order=True)
class Cell:
    """One run of the experiment; ``track`` is empty for planners of a perfect machine."""

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
        parts = [self.method]
        if self.ablation != "full":
            parts.append(self.ablation)
        parts.append(self.geometry)
        if self.track:
            parts.append(self.track)
        return "-".join([*parts, f"s{self.seed}"])

    @property
    def learns(self) -> bool:
        """Whether the cell trains a network."""
        return self.method in LEARNERS

    @property
    def plans(self) -> bool:
        """Whether the cell plays plans."""
        return self.method in PLANNERS


def expand(preset: Preset) -> list[Cell]:
    """All cells of ``preset``, each once, the longest runs first.

    Raises:
        BenchmarkError: a method, ablation, geometry or track is unknown or cannot be combined, or
            there is no cell.
    """
    cells: dict[Cell, None] = {}
    for group in preset.runs:
        _check_group(preset, group)
        for seed in preset.seeds:
            for method in group.methods:
                for ablation in group.ablations:
                    for geometry in group.geometries:
                        for track in group.tracks or [""]:
                            cells[Cell(method, ablation, geometry, track, seed)] = None
    if preset.design is not None:
        cells[Cell(DESIGN, "full", "optimized", "", 0)] = None
    if not cells:
        raise BenchmarkError(
            f"preset '{preset.name}' holds no run: runs and design are empty, or a group's methods"
        )
    return sorted(cells, key=lambda cell: (-units_of(settings(preset, cell)), cell.seed))


def units_of(config: dict[str, Any]) -> int:
    """A rough cost of a run by its settings, in environment steps; decides the order of runs."""
    track = config.get("track", {})
    if "timesteps" in track:
        return int(track["timesteps"])
    if "design" in config:
        return 1_500 * int(config["design"]["runs"])
    levels = len(config["evaluation"].get("errors", [0.0]))
    return 150 * levels * int(config["evaluation"]["episodes"])


def checkpoint_bytes(track: Track) -> int:
    """Size of a checkpoint of a learner, which is that of its replay buffer, generously."""
    return TRANSITION_BYTES * track.hyperparameters.buffer_size


def settings(preset: Preset, cell: Cell) -> dict[str, Any]:
    """Everything that decides the cell's result, as plain YAML types: the run's config.yaml.

    What has no bearing on it is left out, so that it can change without the run, and so are keys at
    values that runs from before there were these keys had.
    """
    config: dict[str, Any] = {"cell": asdict(cell)}
    if cell.method == DESIGN:
        config["design"] = as_dict(preset.design)
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
        config["planner"] = as_dict(preset.planner)
    return config


def _evaluation(preset: Preset, track: Track | None) -> dict[str, Any]:
    config = as_dict(preset.evaluation)
    if track is None or track.sim_to_real is None:
        del config["errors"]
    if config["stream"] == "test":
        del config["stream"]
    if not config["exploring"]:
        del config["exploring"]
    return config


def _track(track: Track, method: str) -> dict[str, Any]:
    config = as_dict(track)
    settings_of = {"ppo": ("maskable_ppo",), "controls": CONTROLS}
    unused = [key for key, methods in settings_of.items() if method not in methods]
    if method not in LEARNERS:
        unused += ["description", "timesteps", "hyperparameters", "curriculum", "train_nominal"]
    later = ("sim_to_real", "train_nominal", "mask_refused", "team", "sight", "task")
    unused += [key for key in later if not config[key]]
    unused += ["shield"] if config["shield"] is None else []
    unused += ["collision"] if config["collision"] == "refuse" else []
    h = config["hyperparameters"]
    config["hyperparameters"] = {k: v for k, v in h.items() if v or k not in _LATER}
    return {key: value for key, value in config.items() if key not in unused}


def _check_group(preset: Preset, group: RunGroup) -> None:
    where = f"preset '{preset.name}'"
    geometries = (*GEOMETRIES, *preset.geometries)
    for kind, names, allowed in (
        ("method", group.methods, METHODS),
        ("ablation", group.ablations, tuple(ABLATIONS)),
        ("geometry", group.geometries, geometries),
        ("track", group.tracks, tuple(preset.tracks)),
    ):
        for name in names:
            if name not in allowed:
                raise BenchmarkError(f"{where}: unknown {kind} '{name}'; known: {known(allowed)}")
    for name in group.tracks:
        _check_errors(preset, name)
        _check_team(preset, name, group.methods)
    for method in group.methods:
        if method in (*LEARNERS, *CONTROLS) and not group.tracks:
            raise BenchmarkError(f"{where}: method '{method}' needs a track")
        if method in PLANNERS:
            _check_planner(preset, method, group.tracks)
        if method != "rainbow" and group.ablations != ["full"]:
            raise BenchmarkError(f"{where}: only rainbow has ablations, not '{method}'")


def own_error(machine: Mapping[str, Any]) -> float:
    """Bound of the base's displacement of a track's ``sim_to_real``, mm."""
    return round(1000.0 * float(machine["base_position_error"]), 6)


def _check_errors(preset: Preset, track: str) -> None:
    machine = preset.tracks[track].sim_to_real
    if machine is not None:
        own = own_error(machine)
        if not any(math.isclose(own, level) for level in preset.evaluation.errors):
            raise BenchmarkError(
                f"preset '{preset.name}': evaluation: errors lack {own:g} mm, track '{track}'s own"
            )


def _check_team(preset: Preset, name: str, methods: list[str]) -> None:
    where, track = f"preset '{preset.name}': track '{name}'", preset.tracks[name]
    if track.team is None:
        if track.sight:
            raise BenchmarkError(f"{where}: sight = true is of a team: name it, or leave it out")
        return
    team = f"{where}: team = '{track.team}'"
    for key in ("mask_visited", "mask_refused", "sim_to_real", "shield", "collision"):
        if (value := getattr(track, key)) not in (0, False, None, "refuse"):
            raise BenchmarkError(
                f"{team}: {key} = {value!r} is of robots that move one at a time: leave it out"
            )
    if track.team == "central" and track.sight:
        raise BenchmarkError(f"{team} sees both robots: leave out sight = true")
    if track.hyperparameters.n_envs % track.rows:
        raise BenchmarkError(
            f"{team}: n_envs = {track.hyperparameters.n_envs} is odd, but each team has two rows"
        )
    for method in methods:
        if method not in OF_TEAMS:
            raise BenchmarkError(
                f"{team}: method '{method}' has no form for a team; known: {known(OF_TEAMS)}"
            )


def _check_planner(preset: Preset, method: str, tracks: list[str]) -> None:
    where = f"preset '{preset.name}'"
    if not tracks and method not in (*PERFECT_PLANNERS, OPTIMUM_AT_ONCE):
        raise BenchmarkError(f"{where}: method '{method}' needs a track with sim_to_real")
    for name in tracks:
        track = preset.tracks[name]
        known_machine = PERFECT_PLANNERS if track.task else ()
        allowed = known_machine if track.sim_to_real is None else IMPERFECT_PLANNERS
        if method not in allowed:
            raise BenchmarkError(
                f"{where}: method '{method}' plans and takes no track '{name}'; with a track of "
                f"task plan: {known(PERFECT_PLANNERS)}; of sim_to_real: {known(IMPERFECT_PLANNERS)}"
            )
