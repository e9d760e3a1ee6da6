"""A method of one's own on the leaderboard: the allowed move that pays most, until none pays.
The test episodes of `quick`, about a minute; `python -m examples.own_method 2` plays two a seed.
"""

import sys

import numpy as np

from benchmarks.cli import main
from coop_env import CoopInsertionEnv


def plan(env: CoopInsertionEnv) -> list[int]:
    """The next moves; none gives up. The environment is left as it was."""
    before = env.get_state()
    paid = {}
    for move in np.flatnonzero(env.action_masks()).tolist():
        paid[move] = env.step(move)[1]
        env.set_state(before)
    best = max(paid, key=lambda move: paid[move])
    return [best] if paid[best] > 0 else []


if __name__ == "__main__":
    # A look at a few episodes joins no leaderboard; without --episodes all are played and stored.
    look = ["--episodes", sys.argv[1]] if len(sys.argv) > 1 else []
    words = ["evaluate", "--planner", "examples.own_method:plan", "--name", "climb"]
    sys.exit(main([*words, "--mask-singularities", *look]))
