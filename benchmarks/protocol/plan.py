"""Which cells a preset holds. One cell is one independent run: it trains or plans, then is tested.

A cell is (method, ablation, geometry, track, seed). Learners have a track; planners have none and
see the same test episodes. The geometric optimization is one cell of its own.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Final

from benchmarks.errors import BenchmarkError, known
from benchmarks.protocol.presets import Preset, RunGroup, Track, as_dict

LEARNERS: Final = ("rainbow", "dqn", "maskable_ppo")
PLANNERS: Final = ("rrt_connect", "rrt_lattice", "optimum")
DESIGN: Final = "design"
METHODS: Final = (*LEARNERS, *PLANNERS)
TRANSITION_BYTES: Final = 200
GEOMETRIES: Final = ("initial", "optimized")

# ablation -> the Rainbow constructor arguments that switch one component off
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
}


@dataclass(frozen=True, order=True)
class Cell:
    """One run of the experiment; ``track`` is empty for planners."""

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
    if "track" in config:
        return int(config["track"]["timesteps"])
    if "design" in config:
        return 1_500 * int(config["design"]["runs"])
    return 150 * int(config["evaluation"]["episodes"])


def checkpoint_bytes(track: Track) -> int:
    """Size of a checkpoint of a learner, which is that of its replay buffer, generously."""
    return TRANSITION_BYTES * track.hyperparameters.buffer_size


def settings(preset: Preset, cell: Cell) -> dict[str, Any]:
    """Everything that decides the cell's result, as plain YAML types: the run's config.yaml."""
    config: dict[str, Any] = {"cell": asdict(cell)}
    if cell.method == DESIGN:
        config["design"] = as_dict(preset.design)
        return config
    config["evaluation"] = as_dict(preset.evaluation)
    if cell.geometry in preset.geometries:
        config["dimensions"] = dict(preset.geometries[cell.geometry])
    if cell.learns:
        config["track"] = as_dict(preset.tracks[cell.track])
        if cell.method != "maskable_ppo":
            del config["track"]["ppo"]  # so that its settings can change without the others' runs
        config["switches"] = dict(ABLATIONS[cell.ablation])
    else:
        config["planner"] = as_dict(preset.planner)
    return config


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
    for method in group.methods:
        if method in LEARNERS and not group.tracks:
            raise BenchmarkError(f"{where}: method '{method}' learns and needs a track")
        if method in PLANNERS and group.tracks:
            raise BenchmarkError(f"{where}: method '{method}' plans and takes no track")
        if method != "rainbow" and group.ablations != ["full"]:
            raise BenchmarkError(f"{where}: only rainbow has ablations, not '{method}'")
