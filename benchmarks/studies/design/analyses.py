"""The computations of the design study: each returns rows of plain numbers; and its files."""

import io
import math
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.methods.geometric_design import Row
from benchmarks.runs.store import RunFolder, write_atomic
from coop_env import design
from coop_env.design import DesignProblem
from coop_env.geometry import GEOMETRIES, INITIAL, OPTIMIZED, RRSGeometry
from coop_env.kinematics import rrs
from coop_env.kinematics.rotations import angle_between, roll_pitch
from coop_env.simulation.insertion_task import PAPER_TASK

BANDS: Final = {
    "0.20-0.22": (0.20, 0.205, 0.21, 0.215, 0.22),
    "0.20-0.25": (0.20, 0.205, 0.21, 0.22, 0.23, 0.24, 0.25),
    "0.21-0.25": (0.21, 0.22, 0.23, 0.24, 0.25),
}
ROBUST: Final = "0.20-0.25"
STEP: Final = 0.02  # of lambda, in the atlas
MAP_HEAVES: Final = (0.21, 0.22, 0.23, 0.24, 0.25)
_outcome: Final = attrgetter("geometry", "evaluations")  # of an optimum
Designs = Mapping[str, RRSGeometry]


def atlas_rows(progress: Callable[[float], None]) -> list[Row]:
    """A_w in steps of lambda over the designs that meet the constraints."""
    result = design.atlas(
        lambda1=np.arange(0.5, 2.0 - 1e-9, STEP),
        lambda2=np.arange(0.10, 3.40 + 1e-9, STEP),
        progress=lambda done, of: progress(done / of),
    )
    return [
        {"lambda1": float(a), "lambda2": float(b), "a_w": float(result.value[i, j])}
        for i, a in enumerate(result.lambda1)
        for j, b in enumerate(result.lambda2)
        if np.isfinite(result.value[i, j])
    ]


def optima(
    atlas: Sequence[Row], progress: Callable[[float], None]
) -> dict[str, tuple[RRSGeometry, int]]:
    """The best designs, with evaluations: by method at home's heave, and for each heave band."""
    problem = DesignProblem()
    cell = max(atlas, key=lambda row: float(str(row["a_w"])))
    lambdas = float(str(cell["lambda1"])), float(str(cell["lambda2"]))
    result = {
        "nelder_mead": _outcome(design.optimize(problem)),
        "differential_evolution": _outcome(design.optimize_globally(problem, generations=20)),
        "atlas": (problem.geometry(*lambdas), 0),
    }
    progress(0.4)
    for k, (name, heaves) in enumerate(BANDS.items()):
        band = design.at_heaves(problem, heaves)
        rough = design.optimize_globally(band, generations=8, population=8)
        best = max((rough, design.optimize(band)), key=attrgetter("value"))
        result[f"band {name}"] = _outcome(best)
        progress(0.4 + 0.2 * (k + 1))
    return result


def optimum_rows(result: dict[str, tuple[RRSGeometry, int]]) -> list[Row]:
    """For each of :func:`optima`: lambdas, lengths, A_w at home and the least over each band."""
    rows: list[Row] = []
    given = {"initial": (INITIAL, 0), "printed optimum (fit)": (OPTIMIZED, 0)}
    for name, (g, evaluations) in {**given, **result}.items():
        row: Row = {"design": name}
        row |= {f"lambda{i}": value for i, value in enumerate(g.lambdas, start=1)}
        for length in ("base_radius", "proximal_length", "platform_radius"):
            row[length] = getattr(g, length)
        row |= {"evaluations": evaluations, "a_w_home": design.workspace_area(g)}
        for band, heaves in BANDS.items():
            row[f"a_w {band}"] = float(design.over_heaves(g, heaves).min())
        rows.append(row)
    return rows


def heave_rows(designs: Designs) -> list[Row]:
    """A_w by heave of each design."""
    heaves = np.round(np.arange(0.190, 0.2601, 0.0025), 4)
    areas = (design.over_heaves(g, heaves).tolist() for g in designs.values())
    rows = zip(heaves.tolist(), *areas, strict=True)
    return [dict(zip(("heave", *designs), row, strict=True)) for row in rows]


def threshold_rows() -> list[Row]:
    """A_w by threshold on sigma_min, and the optimum for each."""
    rows: list[Row] = []
    for threshold in (0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.40):
        problem = DesignProblem(threshold=threshold)
        row: Row = {"threshold": threshold}
        row |= {name: design.workspace_area(g, problem) for name, g in GEOMETRIES.items()}
        best = design.optimize(problem)
        row |= {"reoptimized": best.value, "lambda1": best.lambda1, "lambda2": best.lambda2}
        rows.append(row)
    return rows


def tolerance_rows(designs: Designs) -> tuple[list[Row], list[Row]]:
    """Slopes of A_w by length, and its distribution under tolerances."""
    slopes: list[Row] = [{"design": name, **design.slopes(g)} for name, g in designs.items()]
    rows: list[Row] = []
    for name, g in designs.items():
        for tolerance in (1e-4, 5e-4, 1e-3, 2e-3):
            areas = design.under_tolerances(g, tolerance, 100)
            rows.append({
                "design": name, "tolerance_mm": 1e3 * tolerance, "mean": float(areas.mean()),
                "std": float(areas.std(ddof=1)), "least": float(areas.min()),
            })  # fmt: skip
    return slopes, rows


def trajectory_rows(designs: Designs) -> tuple[list[Row], list[Row]]:
    """The test trajectory's poses and joint angles, and the report of each design."""
    path = design.cone_trajectory()
    reports = {name: design.validate(g, path) for name, g in designs.items()}
    rows: list[Row] = []
    for i in range(0, len(path.time), 4):
        roll, pitch, heave = path.poses[i].tolist()
        row: Row = {"time": float(path.time[i]), "roll": roll, "pitch": pitch, "heave": heave}
        for name in GEOMETRIES:
            row.update({f"q{k} {name}": float(reports[name].q[i, k]) for k in range(3)})
        rows.append(row)
    angles = ("joint_low", "joint_high", "excursion", "peak_rate", "peak_acceleration")
    others = ("log_jerk", "sigma_min", "kappa_max", "forward_error")
    summary: list[Row] = [
        {"design": name, "valid": report.valid}
        | {key: math.degrees(getattr(report, key)) for key in angles}
        | {key: getattr(report, key) for key in others}
        for name, report in reports.items()
    ]
    return rows, summary


def pose_model_rows() -> list[Row]:
    """The error of the paper's pose on the optimized design, worst over azimuth, by tilt.

    ``reached``: the pose to which the paper's angles bring the real machine, by forward kinematics.
    """
    azimuth = np.radians(np.arange(0.0, 360.0, 2.0))
    rows: list[Row] = []
    for tilt in (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0):
        lean = math.radians(tilt)
        level = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=-1)
        n = np.insert(math.sin(lean) * level, 2, math.cos(lean), axis=-1)
        poses = np.concatenate([roll_pitch(n), np.full((len(azimuth), 1), 0.21)], axis=-1)
        exact, paper = rrs.platform_pose(poses), rrs.platform_pose(poses, pose_model="paper")
        reached = rrs.forward(rrs.inverse(poses, pose_model="paper").q, poses)
        there = rrs.platform_pose(reached.pose)
        off = np.linalg.norm(exact.position - paper.position, axis=-1)
        rows.append({
            "tilt": tilt,
            "plane_mm": 1e3 * _worst(rrs.plane_offset(poses, pose_model="paper")),
            "centre_mm": 1e3 * _worst(off),
            "yaw_deg": math.degrees(_worst(rrs.parasitic(poses)[:, 2])),
            **_hole_errors("", exact, paper),
            "lost": int((~reached.converged).sum()),
            **_hole_errors("reached_", there, paper),
        })  # fmt: skip
    return rows


def pose_model_design_rows() -> list[Row]:
    """The table's figures of both designs, with the mechanism's pose and with the paper's."""
    rows: list[Row] = []
    for model in ("exact", "paper"):
        for name, g in GEOMETRIES.items():
            result = design.measure(g, DesignProblem(pose_model=model))
            rows.append({
                "pose_model": model, "design": name, "a_w": result.area,
                "sigma_cone": result.sigma_cone, "max_angle": math.degrees(result.max_angle),
                "kappa_variation": 100.0 * result.kappa_variation,
                "joint_low": math.degrees(result.joint_low),
                "joint_high": math.degrees(result.joint_high),
            })  # fmt: skip
    return rows


def _worst(values: np.ndarray) -> float:
    return float(np.nanmax(np.abs(values)))


def _hole_errors(prefix: str, a: rrs.PlatformPose, b: rrs.PlatformPose) -> Row:
    """Largest distance (mm) and angle (degrees) between one hole of the dome in two poses."""
    directions = np.array(PAPER_TASK.hole_normals)
    normals = [np.einsum("nij,hj->nhi", pose.rotation, directions) for pose in (a, b)]
    holes = [
        pose.position[:, None] + PAPER_TASK.dome_radius * normal
        for pose, normal in zip((a, b), normals, strict=True)
    ]
    apart = np.linalg.norm(holes[0] - holes[1], axis=-1)
    angle = _worst(angle_between(normals[0], normals[1]))
    return {f"{prefix}hole_mm": 1e3 * _worst(apart), f"{prefix}hole_deg": math.degrees(angle)}


def map_arrays() -> dict[str, np.ndarray]:
    """sigma_min, 1 / kappa and the component, of both designs over (heave, roll, pitch)."""
    problem = DesignProblem()
    arrays: dict[str, np.ndarray] = {
        "angles_deg": np.degrees(problem.centres()).astype(np.float32),
        "heaves": np.array(MAP_HEAVES),
    }
    for name, g in GEOMETRIES.items():
        maps = [design.workspace_map(g, problem, heave=heave) for heave in MAP_HEAVES]
        arrays[f"sigma_{name}"] = np.stack([m.sigma for m in maps]).astype(np.float16)
        kappa = np.stack([m.kappa for m in maps])
        arrays[f"manipulability_{name}"] = (1.0 / kappa).astype(np.float16)
        arrays[f"inside_{name}"] = np.stack([m.inside for m in maps])
    return arrays


class DesignStore(RunFolder):
    """The files of the study: like a run's, with arrays and figures beside them."""

    def __init__(self, results: Path) -> None:
        super().__init__(Path(results) / "design")
        self.figures = self.path / "figures"

    def write_maps(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Write ``maps.npz``."""
        stored = io.BytesIO()
        np.savez_compressed(stored, allow_pickle=False, **arrays)
        write_atomic(self.path / "maps.npz", lambda path: path.write_bytes(stored.getvalue()))

    def maps(self) -> dict[str, np.ndarray]:
        """Read ``maps.npz``."""
        with np.load(self.path / "maps.npz") as stored:
            return dict(stored)
