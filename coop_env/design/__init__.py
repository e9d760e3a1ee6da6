"""The design stage: which 3-RRS has the largest singularity-free orientation workspace.

>>> from coop_env import design
>>> problem = design.DesignProblem(threshold=0.2, heaves=(0.22,))
>>> best = design.optimize(problem)
>>> best.value > best.start_value
True
"""

from __future__ import annotations

from coop_env.design.metrics import DesignMetrics, measure
from coop_env.design.optimize import (
    Atlas,
    Optimum,
    at_heaves,
    atlas,
    optimize,
    optimize_globally,
    repeat,
)
from coop_env.design.problem import (
    DesignError,
    DesignProblem,
    Samples,
    WorkspaceMap,
    sample_points,
    workspace_area,
    workspace_map,
)
from coop_env.design.sensitivity import (
    ThresholdSweep,
    over_heaves,
    over_thresholds,
    slopes,
    under_tolerances,
)
from coop_env.design.validation import Trajectory, TrajectoryReport, cone_trajectory, validate

__all__ = [
    "Atlas",
    "DesignError",
    "DesignMetrics",
    "DesignProblem",
    "Optimum",
    "Samples",
    "ThresholdSweep",
    "Trajectory",
    "TrajectoryReport",
    "WorkspaceMap",
    "at_heaves",
    "atlas",
    "cone_trajectory",
    "measure",
    "optimize",
    "optimize_globally",
    "over_heaves",
    "over_thresholds",
    "repeat",
    "sample_points",
    "slopes",
    "under_tolerances",
    "validate",
    "workspace_area",
    "workspace_map",
]
