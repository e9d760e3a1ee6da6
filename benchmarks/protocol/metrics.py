"""The evaluation metrics, each computed from the stored rows of test episodes."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import pandas as pd
from numpy.typing import NDArray


@dataclass(frozen=True)
class Metric:
    """One row of the performance table.

    ``column`` is averaged over the episodes that have it (one without an insertion has no
    completion time) and multiplied by ``scale``; ``proportion``: it holds nothing but 0 and 1.
    """

    key: str
    label: str
    column: str
    digits: int
    scale: float = 1.0
    proportion: bool = False

    def values(self, episodes: pd.DataFrame) -> NDArray[np.float64]:
        """The metric of each episode that has it, unscaled."""
        if self.column not in episodes:
            return np.empty(0)
        return np.asarray(episodes[self.column].dropna(), dtype=np.float64)

    def reduce(self, episodes: pd.DataFrame) -> float:
        """The metric of one seed's episodes; NaN if no episode has it."""
        values = self.values(episodes)
        return float(values.mean()) * self.scale if len(values) else math.nan


# the paper's six; collisions and energy count over the whole episode, as the paper defines them,
# time, alignment and trajectory up to the first insertion
PAPER_METRICS: Final = (
    Metric("success", "Success rate (%)", "success", 1, 100.0, True),
    Metric("time_first", "Avg. completion time (s)", "time_first", 2),
    Metric("alignment_error", "Avg. alignment error (deg)", "alignment_error", 2),
    Metric("collisions", "Avg. collisions per episode", "collisions", 2),
    Metric("energy", "Avg. energy proxy (J)", "energy", 2),
    Metric("trajectory_error", "RMS trajectory error (mm)", "trajectory_error", 2),
)

SUCCESS: Final = PAPER_METRICS[0]

EXTRA_METRICS: Final = (
    Metric("holes", "Holes per episode (of 6)", "holes", 2),
    Metric("all_holes", "All six holes (% of episodes)", "all_holes", 1, 100.0, True),
)

FIRST: Final = "seconds_first"  # column: stop-and-go under the joints' limits, docs/trajectory.md
# a move counts 0.2 s in the paper's completion time, and this in the joints' own
JOINTS_TIME: Final = Metric(FIRST, "The same by the joints' limits (s)", FIRST, 2)

N_HOLES: Final = 6
GREEDY: Final = "greedy"  # in column "acting": the best action, always
# as a learner was trained: with its noise, epsilon or sampling; a script with random moves
EXPLORING: Final = "exploring"
RANDOM_MOVES: Final = 0.05  # share of them in a script that explores
HOLES: Final = EXTRA_METRICS[0]
METRICS: Final = {each.key: each for each in (*PAPER_METRICS, *EXTRA_METRICS, JOINTS_TIME)}
