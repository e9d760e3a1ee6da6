"""Episodes on the twin, for the tests of this folder."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from coop_env.physics.model import Machine
from coop_env.physics.task import start_configurations

NO_ERROR = {"position_error": 0.0, "tilt_error": 0.0}
REST = np.zeros(6)
PUSH = np.array([0.0, 0.0, -1.0, 0.0, 0.0, 0.0])
ASIDE = np.array([1.0, -0.6, 0.8, 0.5, -0.5, 0.4])
RIM: dict[str, Any] = {"hole": 4, "error": [0.0025, 0.0, 0.0, 0.0]}
"""Reset options: the peg comes down on a hole's rim."""


def above(hole: int, height: float = 0.01) -> dict[str, Any]:
    """Reset options of the whole task: the tip so far above a hole's mouth, aligned, its target."""
    return {"configuration": start_configurations(Machine(), height)[hole], "target": hole}


def beside(hole: int, height: float, aside: float = 0.02) -> dict[str, Any]:
    """The same, so far to the side along y."""
    start = above(hole, height)
    return {**start, "configuration": start["configuration"] + aside * np.eye(6)[1]}


def steps(env: Any, action: Any, seed: int = 0, **options: Any) -> Iterator[dict[str, Any]]:
    """Repeat an action, or ask for it, to the end of an episode; each step's info and its ends."""
    seen, _ = env.reset(seed=seed, options=options)
    over = False
    while not over:
        seen, reward, terminated, truncated, info = env.step(
            action(seen) if callable(action) else action
        )
        over = terminated or truncated
        assert env.observation_space.contains(seen)
        assert reward == pytest.approx(sum(info["reward_terms"].values()))
        assert not (terminated and truncated)
        ends = {"observation": seen, "reward": reward, "terminated": terminated}
        yield {**info, **ends, "truncated": truncated}


def play(env: Any, action: Any, seed: int = 0, **options: Any) -> dict[str, Any]:
    """The last of :func:`steps`, and the ``return`` of the episode."""
    taken = list(steps(env, action, seed, **options))
    return {**taken[-1], "return": sum(step["reward"] for step in taken)}
