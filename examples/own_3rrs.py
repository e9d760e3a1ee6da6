"""A 3-RRS of one's own: optimized at all heights of the task, and asked how many holes it reaches.
100 starts, about a minute; `python -m examples.own_3rrs 5` takes fewer.
"""

import sys

import gymnasium

import coop_env  # noqa: F401 - registers the task
from benchmarks.methods.oracle import LatticeOracle
from coop_env import design
from coop_env.geometry import GEOMETRIES

starts = int(sys.argv[1]) if len(sys.argv) > 1 else 100

# The paper measures its workspace at the lowest height alone; the task uses 0.21 to 0.25 m.
problem = design.at_heaves(design.DesignProblem(), [0.21, 0.23, 0.25])
best = design.optimize(problem)
lengths = best.geometry
print(f"Rb {lengths.base_radius:.4f}, L1 {lengths.proximal_length:.4f}, "
      f"Rp {lengths.platform_radius:.4f} m: worst A_w {best.value:.3f} rad²")  # fmt: skip

for name, geometry in {**GEOMETRIES, "own": lengths}.items():
    env = gymnasium.make("CoopInsertion-v0", geometry=geometry, reward="progress")
    oracle, reached = LatticeOracle(), 0
    for seed in range(starts):
        env.reset(seed=seed)
        reached += oracle.plan(env).moves is not None
    print(f"{name}: the optimum inserts from {reached} of {starts} starts")
