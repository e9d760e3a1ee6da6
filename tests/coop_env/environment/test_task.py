"""The task's numbers as arguments: what they change, and one named error for each bad value."""

import math
from dataclasses import asdict
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.methods.oracle import LatticeOracle
from coop_env import CoopInsertionEnv, CoopInsertionVecEnv, DeltaGeometry, InsertionTask, SimToReal
from coop_env.errors import ArgumentError, ResetOptionError
from coop_env.geometry import OPTIMIZED
from coop_env.kinematics.delta import signed_sigma_min
from coop_env.simulation.state import INVALID, VALID, state_dtype
from tests.coop_env.kinematics.reference import FOLDING

RING = [[0.4, 2.0 * math.pi * k / 9.0] for k in range(9)]


def test_the_defaults_are_one_task_in_three_spellings() -> None:
    own = CoopInsertionEnv().get_state()["params"]
    for task in (InsertionTask(), {}, asdict(InsertionTask())):
        assert CoopInsertionEnv(task=task).get_state()["params"] == own
    for delta in (DeltaGeometry(), {}, asdict(DeltaGeometry())):
        assert CoopInsertionEnv(delta=delta).get_state()["params"] == own
    assert CoopInsertionEnv(geometry=asdict(OPTIMIZED)).get_state()["params"] == own
    made: Any = gym.make("CoopInsertion-v0", task={"tolerance": 0.005}, delta={"peg_length": 0.1})
    assert made.unwrapped.task.tolerance == 0.005
    assert made.unwrapped.params.delta.peg_length == 0.1
    knobs = {"backlash": 0.01}
    assert CoopInsertionEnv(sim_to_real=knobs)._knobs == SimToReal(backlash=0.01)


def test_another_delta_reaches_elsewhere() -> None:
    far = (0.18, 0.0, -0.4, 0.0, 0.0, 0.22)
    assert CoopInsertionEnv().configuration_status(far) == 1
    long = CoopInsertionEnv(delta={"proximal_length": 0.25, "distal_length": 0.5})
    assert long.configuration_status(far) == 0
    assert long.unwrapped.observation_space.shape == (12,)
    high = CoopInsertionEnv(delta={"base_height": 0.95}, normalize=False)
    high.reset(seed=0)
    assert high.scene().effector[2] == pytest.approx(high.configuration[2] + 0.95)


@pytest.mark.slow
def test_any_number_of_holes() -> None:
    holes, n = RING, len(RING)  # one number, as each compiles the kernels of the state anew
    arguments: dict[str, Any] = {
        "observation": "markov",
        "task": {"holes": holes, "stage_0_holes": 2},
    }
    env = CoopInsertionEnv(**arguments)
    gymnasium_check(env, skip_render_check=True)
    assert env.observation_space.shape == (13 + n,)
    for dtype in (env.state.dtype, state_dtype(6)):  # no padding, so that bytes compare
        assert dtype.itemsize == sum(dtype[name].itemsize for name in dtype.names or ())
    batch = CoopInsertionVecEnv(2, seed=7, stage=0, **arguments)
    batch.reset()
    assert all(s["active"].sum() == 2 for s in batch.get_attr("state"))
    env.set_stage(1)
    env.reset(seed=1, options={"filled": range(n - 1)})
    assert env.state["target"] == n - 1
    polar, azimuth = holes[-1]
    scene = env.scene()
    inwards = scene.platform_rotation.T @ scene.hole_normals[n - 1]
    expected = [math.sin(polar) * math.cos(azimuth), math.sin(polar) * math.sin(azimuth)]
    np.testing.assert_allclose(inwards[:2], expected, atol=1e-12)
    moves: Any = LatticeOracle().plan(env).moves
    for move in moves[:-1]:
        assert not env.step(move)[2]
    *_, terminated, _, info = env.step(moves[-1])
    assert terminated
    assert (info["n_filled"], info["all_filled"]) == (n, True)
    assert env.scene().status == "success"


@pytest.mark.slow
def test_entering_the_last_of_many_holes_once_more_is_a_duplicate() -> None:
    env = CoopInsertionEnv(task={"holes": [*([1.2, 0.6 * k] for k in range(8)), [0.0, 0.0]]})
    for filled in (8, 0):
        above = (0.0, 0.0, -0.43, 0.0, 0.0, 0.22)
        env.reset(options={"configuration": above, "filled": [filled], "target": 1})
        assert [env.step(action)[4]["duplicate"] for action in (5, 5, 4, 5)] == (
            [True, False, False, True] if filled == 8 else [False] * 4
        )


@pytest.mark.parametrize(("action", "size"), [(0, 0.01), (6, 0.05), (10, 0.004)])
def test_steps_and_their_duration(action: int, size: float) -> None:
    task = {"linear_step": 0.01, "angular_step": 0.05, "heave_step": 0.004, "dt": 0.5}
    env = CoopInsertionEnv(task=task, observation="markov", normalize=False)
    env.reset(options={"configuration": (0, 0, -0.33, 0, 0, 0.22), "target": 0})
    before = env.configuration
    observation, *_, info = env.step(action)
    assert (env.configuration - before)[action // 2] == pytest.approx(size)
    assert info["time"] == observation[-1] == 0.5
    assert env.observation_space.high[-1] == 150.0
    assert env.metadata["render_fps"] == 2


def test_the_time_bonus_and_the_bound_of_the_error() -> None:
    bonus = {}
    for time in (60.0, 30.0):
        env = CoopInsertionEnv(task={"task_time": time})
        env.reset(seed=0)
        plan: Any = LatticeOracle().plan(env).moves
        for move in plan:
            info = env.step(int(move))[4]
        bonus[time] = info["reward_terms"]["insertion"]
    elapsed = 0.2 * len(plan)
    assert bonus[60.0] - bonus[30.0] == pytest.approx(80.0 * elapsed * (1 / 30 - 1 / 60))
    fine, coarse = (CoopInsertionEnv(task={"error_bound": b}) for b in (0.3, 0.6))
    a, b = (env.reset(seed=0)[0][6:9] - 0.5 for env in (fine, coarse))
    np.testing.assert_allclose(a, 2.0 * b, atol=1e-6)


@settings(max_examples=8)
@given(
    tilt=st.floats(0.0, 0.4),
    planar=st.floats(0.0, 0.05),
    low=st.floats(0.03, 0.08),
    width=st.floats(0.0, 0.05),
)
def test_starts_lie_within_their_ranges(
    tilt: float, planar: float, low: float, width: float
) -> None:
    task = InsertionTask(start_tilt=tilt, start_planar=planar, start_clearance=(low, low + width))
    env = CoopInsertionEnv(task=task)
    for seed in range(5):
        env.reset(seed=seed)
        x, y, _, roll, pitch, heave = env.configuration
        assert max(abs(x), abs(y)) <= planar
        assert max(abs(roll), abs(pitch)) <= tilt
        assert low - 1e-9 <= env.state["tip"][2] - heave - task.dome_radius <= low + width + 1e-9


def test_a_wider_singular_margin_ends_episodes_sooner() -> None:
    near = (0.0, 0.0, -0.3, 0.55, 0.0, 0.22)
    for margin, status in ((0.05, 0), (0.9, 3)):
        env = CoopInsertionEnv(task={"singular_margin": margin, "start_sigma": 0.95})
        assert env.configuration_status(near) == status
    for nonsense in ([math.nan] * 6, [math.inf, 0, 0, 0, 0, 0]):
        assert env.configuration_status(nonsense) == 1


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ({"tolerence": 0.005}, "unknown keys.*tolerence.*known.*tolerance"),
        ({"tolerance": 0.0}, r"tolerance = 0.0: must be above 0 and at most 0.1"),
        ({"tolerance": 10**400}, "tolerance"),
        ({"tolerance": True}, "tolerance = True: must be a number"),
        ({"angle_tolerance": 5.0}, "angle_tolerance = 5.0.*at most 1.57"),
        ({"start_sigma": 0.01}, "start_sigma = 0.01: must be at least 0.05"),
        ({"start_clearance": 0.1}, "start_clearance = 0.1: must be two numbers"),
        ({"start_clearance": (0.15, 0.05)}, r"start_clearance\[1\] = 0.05: must be at least 0.15"),
        ({"holes": [(0.0, 0.1 * k) for k in range(33)]}, "holes are 33"),
        ({"holes": [(0.0, 0.0), (0.0, 1.0)]}, "are the same"),  # the pole
        ({"holes": [(0.1, -math.pi), (0.1, math.pi)]}, "are the same"),
        ({"holes": {0.1: 0.0}}, "must be pairs"),
        ({"holes": [(2.0, 0.0)]}, r"holes\[0\] polar angle = 2.0"),
        ({"holes": [0.1, 0.2]}, r"holes\[0\] = 0.1: must be two numbers"),
        ({"holes": "six"}, "holes = 'six'"),
        ({"holes": np.array(0.1)}, "holes = array"),
        ({"stage_0_holes": 0}, "stage_0_holes = 0"),
    ],
)
def test_bad_numbers_of_a_task(task: Any, message: str) -> None:
    with pytest.raises(ArgumentError, match=message):
        CoopInsertionEnv(task=task)


def test_a_move_beyond_the_deltas_singularity_is_refused_as_its_mask_says() -> None:
    env = CoopInsertionEnv(delta=FOLDING)
    beyond, before = (np.array([-0.0125, 0.0889, z, 0.0, 0.0, 0.21]) for z in (-0.1306, -0.1706))
    assert env.configuration_status(before) == VALID
    assert env.configuration_status(beyond) == INVALID
    with pytest.raises(ResetOptionError, match="workspace"):
        env.reset(options={"configuration": beyond})
    env.reset(seed=0, options={"configuration": before})
    refused = []
    for _ in range(3):
        allowed = env.action_masks()[4]
        refused.append(env.step(4)[-1]["violation"])
        assert refused[-1] is not bool(allowed)
        assert signed_sigma_min(env.configuration[:3], FOLDING) > 0.0
    assert refused[-1]
