"""Walks for the tests of the team: low above the dome, where limits and collisions are met."""

from __future__ import annotations

from typing import Any

import numpy as np

from coop_env import CoopInsertionJointEnv

HOLD = 6
LOW = (0.0, 0.0, -0.41, 0.05, -0.05, 0.23)  # the tip is some centimetres above the dome


def single_action(delta: int, rrs: int) -> int:
    """The single agent's action of two choices of which one is to hold."""
    return delta if rrs == HOLD else 6 + rrs


def joint_action(delta: int, rrs: int) -> int:
    return 7 * delta + rrs


def low_walk(env: CoopInsertionJointEnv, seed: int, n: int) -> Any:
    """Yield the drawn choices (delta, rrs) of a walk; the caller steps. Downwards more often."""
    rng = np.random.default_rng(seed)
    chances = np.array([1, 1, 1, 1, 1, 2, 1]) / 8
    env.reset(seed=seed, options={"configuration": LOW})
    for _ in range(n):
        yield int(rng.choice(7, p=chances)), int(rng.integers(7))
        if env.state["over"]:
            env.reset(options={"configuration": LOW})
