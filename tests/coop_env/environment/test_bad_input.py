"""Bad input: one named error each, and the environment left as it was."""

import json
import math
import pickle
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from gymnasium.error import NoAsyncCallError, ResetNeeded

from coop_env import (
    OPTIMIZED,
    CoopInsertionEnv,
    CoopInsertionJointEnv,
    CoopInsertionJointVecEnv,
    CoopInsertionTeamVecEnv,
    CoopInsertionVecEnv,
    CoopInsertionVectorEnv,
    DeltaGeometry,
    RRSGeometry,
)
from coop_env.errors import ActionError, ArgumentError, ResetOptionError, RewardError, StateError
from coop_env.geometry import GeometryError
from coop_env.kinematics import rrs_kernels
from coop_env.shield import ShieldedInsertionEnv

VALID = (0.0, 0.0, -0.33, 0.1, 0.1, 0.22)
SINGULAR = (0.0, 0.0, -0.27, 0.6, -0.3, 0.22)  # of the initial geometry


@contextmanager
def refused(env: Any, error: type[Exception], message: str) -> Iterator[None]:
    """What is asked for here is refused, and the environment is left as it was."""
    before = pickle.dumps(env.get_state())
    with pytest.raises(error, match=message):
        yield
    assert pickle.dumps(env.get_state()) == before


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"geometry": "better"}, ArgumentError, "'better'.*initial.*optimized"),
        ({"reward": "dense"}, RewardError, "'dense'.*'paper' or 'progress'"),
        ({"reward": "paper", "reward_kwargs": {"gamma": 1.0}}, RewardError, "takes no scales"),
        ({"reward": "progress", "reward_kwargs": {"scale": 1}}, RewardError, "scale.*known"),
        ({"reward": "progress", "reward_kwargs": {"step_cost": -0.5}}, RewardError, "-0.5"),
        ({"reward": "progress", "reward_kwargs": {"step_cost": None}}, RewardError, "None"),
        ({"reward": "progress", "reward_kwargs": {"gamma": 1.5}}, RewardError, "1.5"),
        ({"observation": "full"}, ArgumentError, "'full'"),
        ({"normalize": 1}, ArgumentError, "normalize = 1"),
        ({"mask_singularities": "yes"}, ArgumentError, "'yes'"),
        ({"mask_visited": 65}, ArgumentError, "65: must be an integer from 0 to 64"),
        ({"mask_refused": 1}, ArgumentError, "mask_refused = 1"),
        ({"stage": True}, ArgumentError, "stage = True"),
        ({"pose_model": "approximate"}, ArgumentError, "'approximate'"),
        ({"collision": "bounce"}, ArgumentError, "'bounce'.*'refuse' or 'terminate'"),
        ({"max_moves": 2**63}, ArgumentError, "max_moves = 9223372036854775808.*2147483647"),
        ({"reward": "progress", "reward_kwargs": "big"}, RewardError, "'big': must be a mapping"),
        ({"sim_to_real": {"wind": 1}}, ArgumentError, "unknown keys.*wind"),
        ({"render_mode": "opengl"}, ArgumentError, "'opengl'"),
        ({"sim_to_real": "harsh"}, ArgumentError, "'harsh'"),
        ({"sim_to_real": {"backlash": math.nan}}, ArgumentError, "backlash = nan"),
        ({"sim_to_real": {"latency": 2}}, ArgumentError, "latency = 2"),
        ({"sim_to_real": {"randomize": 1}}, ArgumentError, "randomize = 1"),
        ({"delta": {"proximal_length": "long"}}, GeometryError, "'long': must be a number"),
        ({"delta": {"proximal_length": 0.5}}, GeometryError, "must exceed"),
        ({"delta": 0.2}, ArgumentError, "delta = 0.2: must be None, a DeltaGeometry or a mapping"),
        ({"geometry": {"base_radius": 0.2}}, ArgumentError, "proximal_length"),
        ({"geometry": {**asdict(OPTIMIZED), "joint_min": "low"}}, GeometryError, "'low'"),
        ({"geometry": {**asdict(OPTIMIZED), "distal_length": 0.08}}, GeometryError, "home"),
        ({"geometry": {**asdict(OPTIMIZED), "heave_min": 0.22}}, GeometryError, "0.21.*heave_min"),
        ({"delta": {"peg_length": 0.004}}, GeometryError, "peg_length = 0.004 m must exceed"),
        ({"mask_visited": 1, "task": {"linear_step": 1e-4}}, ArgumentError, "steps of at least"),
        (
            {"sim_to_real": {"chamfer_error": 0.004}, "task": {"tolerance": 0.003}},
            ArgumentError,
            "chamfer_error = 0.004: must be below",
        ),
    ],
)
def test_arguments(kwargs: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        CoopInsertionEnv(**kwargs)


def test_a_geometry_of_other_numbers_is_one_of_floats() -> None:
    given: dict[str, Any] = {k: np.float32(value) for k, value in asdict(OPTIMIZED).items()}
    machine = RRSGeometry(**{**given, "joint_min": 0})
    assert {type(value) for value in asdict(machine).values()} == {float}
    assert json.loads(json.dumps(asdict(DeltaGeometry(base_radius=np.float64(0.12)))))


@pytest.mark.slow
def test_a_geometry_without_start_states_is_told_not_searched_for_ever() -> None:
    p = CoopInsertionEnv().params.rrs
    home = rrs_kernels.inverse(rrs_kernels.platform_pose(0.0, 0.0, 0.21, p), p)[1][0]
    limits = {"joint_min": home - 1e-5, "joint_max": home + 1e-5}
    env = CoopInsertionEnv(geometry=RRSGeometry(**{**asdict(OPTIMIZED), **limits}))
    with pytest.raises(ResetOptionError, match="too little workspace"):
        env.reset(seed=0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"target": 5}, "target = 5: not active"),
        ({"filled": [0, 1, 2, 3]}, "leaves no active hole"),
        ({"config": VALID}, "config.*known"),
        ({"configuration": (0.0, 0.0)}, r"shape \(2,\)"),
        ({"configuration": (math.nan, *VALID[1:])}, "finite"),
        ({"configuration": (0.0, 0.0, -0.1, 0.0, 0.0, 0.22)}, "workspace"),
        ({"configuration": (0.0, 0.0, -0.6, 0.0, 0.0, 0.22)}, "collision"),
        ({"configuration": SINGULAR}, "singular"),
        ({"target": 1.0}, "target = 1.0"),
        ({"filled": map(int, "01")}, "filled = <map"),
        ({"filled": {0: False}}, "filled = {0: False}"),
        ({"filled": [7]}, "7"),
        ({"filled": [2], "target": 2}, "target = 2"),
        ("home", "'home': must be a mapping"),
    ],
)
def test_reset_options(options: Any, message: str) -> None:
    env = CoopInsertionEnv("initial", stage=0)
    env.reset(seed=3)
    env.step(int(np.flatnonzero(env.action_masks())[0]))
    with refused(env, ResetOptionError, message):
        env.reset(seed=4, options=options)


@pytest.mark.parametrize(
    "action", [99, -1, "up", None, True, np.array([1]), np.float64(2), math.nan]
)
@pytest.mark.parametrize("kind", [CoopInsertionEnv, CoopInsertionJointEnv])
def test_actions(kind: type[CoopInsertionEnv], action: Any) -> None:
    env = kind()
    env.reset(seed=0)
    most = int(env.action_space.n) - 1
    with refused(env, ActionError, f"must be an integer from 0 to {most}"):
        env.step(most + 1 if action == 99 else action)


@pytest.mark.parametrize("actions", [[0], [0, 99], [0, -1], [0.0, 1.0], [[0, 1]]])
@pytest.mark.parametrize("form", [CoopInsertionVecEnv, CoopInsertionTeamVecEnv])
def test_batch_actions(form: Any, actions: Any) -> None:
    batch = form(1 if form is CoopInsertionTeamVecEnv else 2, seed=0)
    batch.reset()
    with refused(batch, ActionError, "action"):
        batch.step(np.array(actions))


def test_use_out_of_turn() -> None:
    env, batch, two = CoopInsertionEnv(max_moves=1), CoopInsertionVecEnv(2), np.zeros(2, int)
    uses: list[Callable[[], object]] = [
        lambda: env.step(0), env.action_masks, lambda: env.configuration, env.scene,
        lambda: batch.step(two), lambda: batch.step_async(two), batch.step_wait, batch.action_masks,
        lambda: CoopInsertionVectorEnv(2).step(two), lambda: CoopInsertionTeamVecEnv(1).step(two),
    ]  # fmt: skip
    for use in uses:
        with pytest.raises(ResetNeeded, match="reset"):
            use()
    batch.reset()
    batch.step(two)
    with pytest.raises(NoAsyncCallError, match="no actions"):
        batch.step_wait()
    env.reset(seed=0)
    assert env.step(0)[3]
    assert env.scene().status == "timeout"
    with pytest.raises(ResetNeeded):
        env.step(0)


@pytest.mark.parametrize(
    ("form", "kwargs", "error"),
    [
        *((CoopInsertionVecEnv, {"n_envs": n}, ArgumentError) for n in (0, -1, 2.0, True)),
        (CoopInsertionVecEnv, {"n_envs": 2, "geomtry": "initial"}, TypeError),
        (CoopInsertionTeamVecEnv, {"n_teams": 0}, ArgumentError),
        (CoopInsertionTeamVecEnv, {"n_teams": 2, "sight": None}, ArgumentError),
        (CoopInsertionTeamVecEnv, {"n_teams": 2, "indicator": 1}, ArgumentError),
        (CoopInsertionTeamVecEnv, {"n_teams": 2, "colour": 1}, TypeError),
        (CoopInsertionTeamVecEnv, {"n_teams": 2, "sim_to_real": "randomized"}, ArgumentError),
        (CoopInsertionJointEnv, {"sim_to_real": "randomized"}, ArgumentError),
        (CoopInsertionJointEnv, {"mask_visited": 2}, ArgumentError),
        (CoopInsertionJointEnv, {"mask_refused": True}, ArgumentError),
    ],
)
def test_arguments_of_batches_and_teams(form: Any, kwargs: dict[str, Any], error: Any) -> None:
    with pytest.raises(error, match=list(kwargs)[-1]):
        form(**kwargs)


def test_snapshots_of_another_environment() -> None:
    """Other arguments, masks, moves, or another number of them."""
    strict, joint = ShieldedInsertionEnv(shield={"sigma": 0.5}), CoopInsertionJointVecEnv(1)
    pairs: list[tuple[Any, Any]] = [
        (CoopInsertionEnv(), CoopInsertionEnv(geometry="initial")),
        (CoopInsertionEnv(), CoopInsertionEnv(normalize=False)),
        (CoopInsertionEnv(), CoopInsertionEnv(task={"stage_0_holes": 2})),
        (CoopInsertionEnv(), CoopInsertionEnv(observation="markov")),
        (ShieldedInsertionEnv(), strict),
        (CoopInsertionEnv(), strict),
        (CoopInsertionVecEnv(1), joint),
        (CoopInsertionVecEnv(2), CoopInsertionVecEnv(3)),
        (CoopInsertionTeamVecEnv(2), CoopInsertionTeamVecEnv(3)),
    ]
    for env, other in pairs:
        with refused(env, StateError, r"other arguments|another layout"):
            env.set_state(other.get_state())
    with pytest.raises(StateError, match="keys"):
        CoopInsertionEnv().set_state({})


def test_a_damaged_snapshot_changes_nothing() -> None:
    """Neither states and generators nor the move that a batch has taken."""
    batch, one = CoopInsertionVecEnv(2, seed=0), CoopInsertionEnv()
    batch.reset()
    old = batch.get_state()
    batch.reset()
    batch.step_async(np.array([0, 1]))
    one.reset(seed=0)
    snapshot, _ = one.get_state(), one.reset()
    damages: list[tuple[Any, Any, str, Any, str]] = [
        (batch, old, "rngs", [old["rngs"][0], "no"], "rng"),
        (batch, old, "rngs", old["rngs"][:1], "rngs must have 2 entries"),
        (batch, old, "stages", [1, 7], "stage = 7"),
        (batch, old, "actions", np.array([0, 41]), "41"),
        (batch, old, "pending", None, "pending = None"),
        (batch, old, "seeds", [1], "seeds are damaged"),
        (batch, old, "options", None, "options = None"),
        (batch, old, "options", [5, 5], r"options = \[5, 5\]"),
        (batch, old, "started", ["no"] * 2, "started = 'no'"),
        *((one, snapshot, key, None, key) for key in ("rng", "states", "observations")),
        (one, snapshot, "stage", 7, "stage = 7"),
        (one, snapshot, "rng", "no", "rng"),
    ]
    for env, whole, name, wrong, message in damages:
        with refused(env, StateError, message):
            env.set_state({**whole, name: wrong})
    batch.reset()


def test_a_batch_refuses_a_class_whose_step_it_would_pass_by() -> None:
    class Slower(CoopInsertionEnv):
        def step(self, action: Any) -> Any:
            return super().step(action)

    class Slow(CoopInsertionVecEnv):
        env_class = Slower

    with pytest.raises(ArgumentError, match=r"Slower has a step\(\) of its own.*DummyVecEnv"):
        Slow(2)
