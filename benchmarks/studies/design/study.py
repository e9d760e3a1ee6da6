"""The computations behind ``python -m benchmarks design``: each returns rows of plain numbers."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from benchmarks.studies.design import reference as design_reference
from benchmarks.studies.design.store import Row
from coop_env import design
from coop_env.design import DesignProblem, Optimum
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
MAP_HEAVES: Final = (0.21, 0.22, 0.23, 0.24, 0.25)


def atlas_rows(step: float, progress: Callable[[float], None]) -> list[Row]:
    """A_w in steps of lambda over the designs that meet the constraints."""
    found = design.atlas(
        lambda1=np.arange(0.5, 2.0 - 1e-9, step),
        lambda2=np.arange(0.10, 3.40 + 1e-9, step),
        progress=lambda done, of: progress(done / of),
    )
    return [
        {"lambda1": float(a), "lambda2": float(b), "a_w": float(found.value[i, j])}
        for i, a in enumerate(found.lambda1)
        for j, b in enumerate(found.lambda2)
        if np.isfinite(found.value[i, j])
    ]


def optima(atlas: Sequence[Row], progress: Callable[[float], None]) -> dict[str, Optimum | Row]:
    """The best designs by method at home's heave, and the best for each band of heave."""
    problem = DesignProblem()
    found: dict[str, Optimum | Row] = {
        "nelder_mead": design.optimize(problem),
        "differential_evolution": design.optimize_globally(problem, generations=20),
        "atlas": max(atlas, key=lambda row: float(str(row["a_w"]))),
    }
    progress(0.4)
    for k, (name, heaves) in enumerate(BANDS.items()):
        band = design.at_heaves(problem, heaves)
        rough = design.optimize_globally(band, generations=8, population=8)
        local = design.optimize(band)
        found[f"band {name}"] = max((rough, local), key=lambda best: best.value)
        progress(0.4 + 0.2 * (k + 1))
    return found


def optimum_rows(found: dict[str, Optimum | Row]) -> list[Row]:
    """For each of :func:`optima`: lambdas, lengths, A_w at home and the least over each band."""
    problem = DesignProblem()
    designs: dict[str, tuple[RRSGeometry, int]] = {
        "initial": (INITIAL, 0),
        "printed optimum (fit)": (OPTIMIZED, 0),
    }
    for name, best in found.items():
        if isinstance(best, Optimum):
            designs[name] = best.geometry, best.evaluations
        else:
            lambda1, lambda2 = float(str(best["lambda1"])), float(str(best["lambda2"]))
            designs[name] = problem.geometry(lambda1, lambda2), 0
    rows: list[Row] = []
    for name, (g, evaluations) in designs.items():
        lambda1, lambda2, lambda3 = g.lambdas
        row: Row = {
            "design": name,
            "lambda1": lambda1,
            "lambda2": lambda2,
            "lambda3": lambda3,
            "base_radius": g.base_radius,
            "proximal_length": g.proximal_length,
            "platform_radius": g.platform_radius,
            "evaluations": evaluations,
            "a_w_home": design.workspace_area(g),
        }
        for band, heaves in BANDS.items():
            row[f"a_w {band}"] = float(design.over_heaves(g, heaves).min())
        rows.append(row)
    return rows


def heave_rows(robust: RRSGeometry) -> list[Row]:
    """A_w by heave of the initial, the optimized and the robust design."""
    heaves = np.round(np.arange(0.190, 0.2601, 0.0025), 4)
    areas = [design.over_heaves(g, heaves) for g in (INITIAL, OPTIMIZED, robust)]
    return [
        {"heave": float(h), "initial": float(a), "optimized": float(b), "robust": float(c)}
        for h, a, b, c in zip(heaves, *areas, strict=True)
    ]


def threshold_rows() -> list[Row]:
    """A_w by threshold on sigma_min, and the optimum for each."""
    thresholds = [0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.40]
    sweep = design.over_thresholds([INITIAL, OPTIMIZED], thresholds)
    return [
        {
            "threshold": t,
            "initial": float(given[0]),
            "optimized": float(given[1]),
            "reoptimized": float(best),
            "lambda1": float(lambdas[0]),
            "lambda2": float(lambdas[1]),
        }
        for t, given, best, lambdas in zip(
            thresholds, sweep.given, sweep.optimum, sweep.lambdas, strict=True
        )
    ]


def tolerance_rows(robust: RRSGeometry, draws: int = 100) -> tuple[list[Row], list[Row]]:
    """Slopes of A_w by length, and its distribution under tolerances."""
    designs = {"initial": INITIAL, "optimized": OPTIMIZED, "robust": robust}
    slopes: list[Row] = [{"design": name, **design.slopes(g)} for name, g in designs.items()]
    rows: list[Row] = []
    for name, g in designs.items():
        for tolerance in (1e-4, 5e-4, 1e-3, 2e-3):
            areas = design.under_tolerances(g, tolerance, draws)
            rows.append(
                {
                    "design": name,
                    "tolerance_mm": 1e3 * tolerance,
                    "mean": float(areas.mean()),
                    "std": float(areas.std(ddof=1)),
                    "least": float(areas.min()),
                }
            )
    return slopes, rows


def trajectory_rows(robust: RRSGeometry) -> tuple[list[Row], list[Row]]:
    """The test trajectory's poses and joint angles, and the report of each design."""
    path = design.cone_trajectory()
    reports = {
        name: design.validate(g, path)
        for name, g in (("initial", INITIAL), ("optimized", OPTIMIZED), ("robust", robust))
    }
    rows: list[Row] = []
    for i in range(0, len(path.time), 4):
        roll, pitch, heave = path.poses[i].tolist()
        row: Row = {"time": float(path.time[i]), "roll": roll, "pitch": pitch, "heave": heave}
        for name in ("initial", "optimized"):
            row.update({f"q{k} {name}": float(reports[name].q[i, k]) for k in range(3)})
        rows.append(row)
    summary: list[Row] = [
        {
            "design": name,
            "valid": report.valid,
            "joint_low": math.degrees(report.joint_low),
            "joint_high": math.degrees(report.joint_high),
            "excursion": math.degrees(report.excursion),
            "peak_rate": math.degrees(report.peak_rate),
            "peak_acceleration": math.degrees(report.peak_acceleration),
            "log_jerk": report.log_jerk,
            "sigma_min": report.sigma_min,
            "kappa_max": report.kappa_max,
            "forward_error": report.forward_error,
        }
        for name, report in reports.items()
    ]
    return rows, summary


def pose_model_rows() -> list[Row]:
    """What the paper's pose costs on the optimized design, worst over azimuth, by tilt.

    The last columns command the real machine with the angles that the paper's model gives, and
    ask forward kinematics where it goes.
    """
    azimuth = np.radians(np.arange(0.0, 360.0, 2.0))
    rows: list[Row] = []
    for tilt in (5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0):
        lean = math.radians(tilt)
        n = np.stack(
            [
                math.sin(lean) * np.cos(azimuth),
                math.sin(lean) * np.sin(azimuth),
                np.full_like(azimuth, math.cos(lean)),
            ],
            axis=-1,
        )
        poses = np.concatenate([roll_pitch(n), np.full((len(azimuth), 1), 0.21)], axis=-1)
        exact, paper = rrs.platform_pose(poses), rrs.platform_pose(poses, pose_model="paper")
        reached = rrs.forward(rrs.inverse(poses, pose_model="paper").q, poses)
        there = rrs.platform_pose(reached.pose)
        rows.append(
            {
                "tilt": tilt,
                "plane_mm": 1e3 * _worst(rrs.plane_offset(poses, pose_model="paper")),
                "centre_mm": 1e3 * _worst(np.linalg.norm(exact.position - paper.position, axis=-1)),
                "yaw_deg": math.degrees(_worst(rrs.parasitic(poses)[:, 2])),
                "hole_mm": 1e3 * _hole_errors(exact, paper)[0],
                "hole_deg": math.degrees(_hole_errors(exact, paper)[1]),
                "lost": int((~reached.converged).sum()),
                "reached_hole_mm": 1e3 * _hole_errors(there, paper)[0],
                "reached_hole_deg": math.degrees(_hole_errors(there, paper)[1]),
            }
        )
    return rows


def pose_model_design_rows() -> list[Row]:
    """The table's figures of both designs, with the mechanism's pose and with the paper's."""
    rows: list[Row] = []
    for model in ("exact", "paper"):
        for name, g in GEOMETRIES.items():
            found = design.measure(g, DesignProblem(pose_model=model))
            rows.append(
                {
                    "pose_model": model,
                    "design": name,
                    "a_w": found.area,
                    "sigma_cone": found.sigma_cone,
                    "max_angle": math.degrees(found.max_angle),
                    "kappa_variation": 100.0 * found.kappa_variation,
                    "joint_low": math.degrees(found.joint_low),
                    "joint_high": math.degrees(found.joint_high),
                }
            )
    return rows


def _worst(values: np.ndarray) -> float:
    return float(np.nanmax(np.abs(values)))


def _hole_errors(a: rrs.PlatformPose, b: rrs.PlatformPose) -> tuple[float, float]:
    """Largest distance (m) and angle (rad) between one hole of the dome in two platform poses."""
    directions = np.array(PAPER_TASK.hole_normals)
    normals = [np.einsum("nij,hj->nhi", pose.rotation, directions) for pose in (a, b)]
    holes = [
        pose.position[:, None] + PAPER_TASK.dome_radius * normal
        for pose, normal in zip((a, b), normals, strict=True)
    ]
    apart = np.linalg.norm(holes[0] - holes[1], axis=-1)
    return _worst(apart), _worst(angle_between(normals[0], normals[1]))


def speed_rows(repeats: int = 9) -> list[Row]:
    """Best time of one A_w map: flood fill, full map, and numpy with batched SVD; turn about."""
    timed: dict[str, Callable[[RRSGeometry], object]] = {
        "A_w alone (flood fill)": design.workspace_area,
        "full map of sigma_min and kappa": design.workspace_map,
        "numpy, batched SVD": design_reference.workspace_map,
    }
    rows: list[Row] = []
    for geometry_name, geometry in GEOMETRIES.items():
        best = dict.fromkeys(timed, math.inf)
        for _ in range(repeats):
            for name, function in timed.items():
                start = time.perf_counter()
                function(geometry)
                best[name] = min(best[name], time.perf_counter() - start)
        slowest = best["numpy, batched SVD"]
        rows += [
            {"geometry": geometry_name, "method": name, "ms": 1e3 * s, "times_faster": slowest / s}
            for name, s in best.items()
        ]
    return rows


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
        arrays[f"manipulability_{name}"] = np.stack([1.0 / m.kappa for m in maps]).astype(
            np.float16
        )
        arrays[f"inside_{name}"] = np.stack([m.inside for m in maps])
    return arrays
