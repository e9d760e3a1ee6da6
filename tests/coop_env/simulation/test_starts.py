"""Start states: valid, collision-free, spread as documented, and only from the seed."""

import numpy as np
import pytest

from coop_env import CoopInsertionEnv
from coop_env.geometry import GEOMETRIES
from coop_env.kinematics import rrs


@pytest.mark.parametrize("geometry", ["initial", "optimized"])
def test_no_start_is_ever_invalid(geometry: str) -> None:
    env = CoopInsertionEnv(geometry=geometry)
    p = env.params
    env.reset(seed=0)
    targets = np.zeros(6, int)
    clearances = []
    starts = np.empty((5_000, 6))
    for c in starts:
        env.reset()
        state = env._states[0]
        c[:] = state["configuration"]
        assert env.configuration_status(c) == 0
        assert not state["inside"].any()
        targets[state["target"]] += 1
        clearances.append(state["tip"][2] - c[5] - env.task.dome_radius)
    assert rrs.signed_sigma_min(starts[:, 3:], GEOMETRIES[geometry]).min() >= 0.15
    assert np.all(np.abs(targets / len(starts) - 1 / 6) < 0.02)
    lows, highs = starts.min(axis=0), starts.max(axis=0)
    assert -0.06 <= lows[:2].min() <= lows[:2].max() < -0.0595
    assert 0.0595 < highs[:2].min() <= highs[:2].max() <= 0.06
    assert lows[3:5].min() >= -0.5
    assert 0.4 < highs[3:5].max() <= 0.5
    assert [lows[5], highs[5]] == pytest.approx([p.rrs.heave_min, p.rrs.heave_max], abs=2e-4)
    assert 0.05 <= min(clearances) < 0.0505
    assert 0.1495 < max(clearances) <= 0.15 + 1e-12


@pytest.mark.parametrize(
    ("stage", "filled", "left"), [(0, set(), {0, 1, 2, 3}), (1, {0, 3}, {1, 2, 4, 5})]
)
def test_a_target_is_given_or_drawn_among_the_stages_open_holes(
    stage: int, filled: set[int], left: set[int]
) -> None:
    env = CoopInsertionEnv(stage=stage)
    seen = set()
    for seed in range(60):
        env.reset(seed=seed, options={"filled": filled})
        seen.add(int(env.state["target"]))
    assert seen == left
    env.reset(seed=1, options={"target": np.int64(2)})
    assert env.state["target"] == 2
