"""A Delta of one's own: its lengths, the limits of its drives, and a file for its controller.
The exact optimum's way to the first hole; `python -m examples.own_delta 5` takes start 5.
"""

import sys
from pathlib import Path

import coop_env
from benchmarks.methods.oracle import LatticeOracle
from coop_env.trajectory import make_trajectory

mine = coop_env.DeltaGeometry(proximal_length=0.22, distal_length=0.48, base_height=0.9,
                              max_joint_velocity=4.0, max_joint_acceleration=40.0,
                              max_joint_jerk=2000.0)  # fmt: skip
env = coop_env.CoopInsertionEnv(delta=mine)
env.reset(seed=int(sys.argv[1]) if len(sys.argv) > 1 else 0)
way, moves = [env.configuration], LatticeOracle().plan(env).moves
if moves is None:
    raise SystemExit("from this start there is no way to a hole: take another")
for move in moves:
    env.step(move)
    way.append(env.configuration)
trajectory = make_trajectory(way, delta=mine)
Path("build").mkdir(exist_ok=True)
trajectory.to_yaml(Path("build", "own_delta.yaml"))
print(f"{len(way) - 1} moves: {trajectory.duration:.2f} s by the drives' limits")
print(f"moves that are not free on their way: {trajectory.blocked() or 'none'}")
