"""How hard the task is for a policy without foresight: greedy descent on the shaping potential.

The exact optimum cannot tell a benign environment from one full of traps; this can. About four
fifths of the starts must be solvable by going wherever distance and angle shrink most.
"""

from __future__ import annotations

from benchmarks.methods.controls import choices
from coop_env import CoopInsertionEnv
from coop_env.simulation.task import pack


def test_greedy_descent_solves_about_four_fifths_of_the_starts() -> None:
    """By the valid move of least 500 d + 150 angle, or one that inserts, within 120 moves."""
    env = CoopInsertionEnv(mask_singularities=True, max_moves=120)
    packed, solved = pack(env.params), 0
    for seed in range(500):
        env.reset(seed=seed)
        inserted = False
        while env.running and not inserted:
            (action,) = choices(env.state.reshape(1), 150.0, False, packed)
            inserted = env.step(action)[4]["inserted"]
        solved += inserted
    assert 0.75 < solved / 500 < 0.88
