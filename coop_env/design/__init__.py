"""The design stage: which 3-RRS has the largest singularity-free orientation workspace.

>>> from coop_env import design
>>> problem = design.DesignProblem(threshold=0.2, heaves=(0.22,))
>>> best = design.optimize(problem)
>>> best.value > best.start_value
True
"""

from coop_env.design.analysis import DesignMetrics as DesignMetrics
from coop_env.design.analysis import PlatformTrajectory as PlatformTrajectory
from coop_env.design.analysis import TrajectoryReport as TrajectoryReport
from coop_env.design.analysis import cone_trajectory as cone_trajectory
from coop_env.design.analysis import measure as measure
from coop_env.design.analysis import over_heaves as over_heaves
from coop_env.design.analysis import slopes as slopes
from coop_env.design.analysis import under_tolerances as under_tolerances
from coop_env.design.analysis import validate as validate
from coop_env.design.optimize import Atlas as Atlas
from coop_env.design.optimize import Optimum as Optimum
from coop_env.design.optimize import at_heaves as at_heaves
from coop_env.design.optimize import atlas as atlas
from coop_env.design.optimize import optimize as optimize
from coop_env.design.optimize import optimize_globally as optimize_globally
from coop_env.design.problem import DesignError as DesignError
from coop_env.design.problem import DesignProblem as DesignProblem
from coop_env.design.problem import Samples as Samples
from coop_env.design.problem import WorkspaceMap as WorkspaceMap
from coop_env.design.problem import sample_points as sample_points
from coop_env.design.problem import workspace_area as workspace_area
from coop_env.design.problem import workspace_map as workspace_map
