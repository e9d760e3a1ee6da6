"""Both robots in one tick: the single agent, refusals, masks against trying every choice."""

from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from benchmarks.methods.oracle import LatticeOracle
from coop_env import OPTIMIZED, CoopInsertionEnv, CoopInsertionJointEnv
from coop_env.physics.model import Machine
from coop_env.physics.task import start_configurations
from coop_env.simulation.insertion_task import PAPER_TASK
from coop_env.simulation.state import COLLISION, INVALID, SINGULAR, VALID
from coop_env.team.agents import Team
from tests.coop_env.moves import MOVES

HOLD = 6
LOW = (0.0, 0.0, -0.41, 0.05, -0.05, 0.23)  # the tip is some centimetres above the dome


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


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"mask_singularities": True, "reward": "progress", "observation": "markov"},
        {"geometry": "initial", "pose_model": "paper", "normalize": False, "max_moves": 25},
    ],
)
def test_with_the_other_on_hold_all_is_the_single_agents(arguments: dict[str, Any]) -> None:
    single, joint = CoopInsertionEnv(**arguments), CoopInsertionJointEnv(**arguments)
    rng = np.random.default_rng(0)
    (a, info), (b, twin) = single.reset(seed=3), joint.reset(seed=3)
    for _ in range(1500):
        assert a.tobytes() == b.tobytes()
        assert info == twin
        assert single.state.tobytes() == joint.state.tobytes()
        if single.state["over"]:
            (a, info), (b, twin) = single.reset(), joint.reset()
            continue
        action = int(rng.integers(12))
        a, *rest, info = single.step(action)
        choices = (action, HOLD) if action < 6 else (HOLD, action - 6)
        b, *others, twin = joint.step(joint_action(*choices))
        assert rest == others


def expected(env: CoopInsertionJointEnv, delta: int, rrs: int) -> tuple[np.ndarray, list[int]]:
    """Where a tick should lead and the status of each move, from ``configuration_status`` alone."""
    start, offset = env.state["start"], env.state["offset"]

    def lattice_point(*moves: int) -> np.ndarray:
        return start + (offset + MOVES[list(moves)].sum(axis=0)) * PAPER_TASK.steps

    moves = {0: delta, 1: 6 + rrs} if rrs != HOLD else {0: delta}
    if delta == HOLD:
        del moves[0]
    status = [VALID, VALID]
    for robot, move in list(moves.items()):
        if env.configuration_status(lattice_point(move)) == INVALID:
            status[robot] = INVALID
            del moves[robot]
    where = lattice_point(*moves.values())
    result = env.configuration_status(where)
    if result == COLLISION:
        for robot in moves:
            status[robot] = COLLISION
        return lattice_point(), status
    if result == SINGULAR:
        status[1] = SINGULAR
    return where, status


def test_ticks_against_a_slow_reference() -> None:
    """Status and arrival from single configurations; what is left of the state from a fresh one."""
    env, fresh = CoopInsertionJointEnv(), CoopInsertionEnv()
    seen: Counter[tuple[int, int]] = Counter()
    for delta, rrs in low_walk(env, 0, 3000):
        where, status = expected(env, delta, rrs)
        before = env.state
        *_, info = env.step(joint_action(delta, rrs))
        seen[status[0], status[1]] += delta != HOLD and rrs != HOLD
        np.testing.assert_array_equal(env.configuration, where)
        assert info["collision"] == (COLLISION in status)
        assert info["singular"] == (SINGULAR in status)
        assert info["violation"] == (status != [VALID, VALID])
        after = env.state
        assert after["moves"] == before["moves"] + 1
        turned = np.abs(after["theta"] - before["theta"]).sum()
        turned += np.abs(after["q"] - before["q"]).sum()
        assert after["energy"] - before["energy"] == pytest.approx(turned, abs=1e-12)
        if SINGULAR not in status:
            fresh.reset(options={"configuration": where, "target": int(before["target"])})
            for name in ("theta", "q", "sigma", "tip", "mouths", "normals", "inside"):
                np.testing.assert_array_equal(after[name], fresh.state[name])
    both = {
        (VALID, VALID), (COLLISION, COLLISION), (INVALID, VALID), (VALID, INVALID),
        (INVALID, COLLISION), (COLLISION, INVALID), (VALID, SINGULAR),
    }  # fmt: skip
    assert both - {(INVALID, COLLISION), (VALID, SINGULAR)} <= set(seen), seen


def test_a_refused_robot_does_not_stop_the_other_from_inserting() -> None:
    env = CoopInsertionJointEnv()
    for seed in range(10):
        env.reset(seed=seed)
        plan = LatticeOracle().plan(env)
        if plan.moves is None or plan.moves[-1] >= 6:
            continue
        for move in plan.moves[:-1].tolist():
            env.step(joint_action(move, HOLD) if move < 6 else joint_action(HOLD, move - 6))
        down = env.configuration - np.array([0, 0, 0, 0, 0, PAPER_TASK.heave_step])
        heave = 5 if env.configuration_status(down) == INVALID else 4
        platform = env.configuration[3:]
        *_, info = env.step(joint_action(int(plan.moves[-1]), heave))
        assert info["inserted"]
        assert info["violation"]
        assert not info["collision"]
        assert info["reward_terms"]["violation"] == -3.0
        assert info["reward_terms"]["insertion"] > 0.0
        np.testing.assert_array_equal(env.configuration[3:], platform)
        return
    pytest.fail("no plan ended with a move of the Delta")


def test_what_arrives_singular_inserts_nothing() -> None:
    for margin, inserted in ((0.05, True), (0.26, False)):  # sigma is 0.29, then 0.24
        env = CoopInsertionJointEnv(task={"singular_margin": margin, "start_sigma": margin})
        before = start_configurations(Machine(), 0.002)[0]
        before[[2, 3]] += env.task.linear_step, -env.task.angular_step
        env.reset(options={"configuration": before, "target": 0})
        *_, info = env.step(joint_action(5, 0))  # what the Delta does is valid
        assert info["singular"] is not inserted
        assert (info["inserted"], info["n_filled"]) == (inserted, int(inserted))


def test_when_both_hold_only_time_passes() -> None:
    env = CoopInsertionJointEnv(max_moves=2)
    env.reset(seed=0)
    before = env.state
    _, _, terminated, truncated, info = env.step(48)
    assert [terminated, truncated, info["violation"], info["inserted"]] == [False] * 4
    changed = [n for n in before.dtype.names or () if before[n].tobytes() != env.state[n].tobytes()]
    assert changed == ["moves"]
    assert env.step(48)[3]


def tried(env: CoopInsertionJointEnv, delta: int, rrs: int) -> dict[str, Any]:
    """The info of a tick that is taken back."""
    snapshot = env.get_state()
    *_, info = env.step(joint_action(delta, rrs))
    env.set_state(snapshot)
    return info


def walk(env: CoopInsertionJointEnv, n: int) -> Any:
    """States of a low walk, after each tick."""
    for delta, rrs in low_walk(env, 0, n):
        env.step(joint_action(delta, rrs))
        if not env.state["over"]:
            yield


def test_without_sight_the_other_robot_makes_no_difference() -> None:
    """Masks are what the robot's own half alone says, with the other one out of its way."""
    env, level = Team(mask_singularities=True), CoopInsertionEnv()
    hidden = 0
    for _ in walk(env, 300):
        masks, state = env.action_masks(), env.state
        for action in range(12):
            to = state["start"] + (state["offset"] + MOVES[action]) * PAPER_TASK.steps
            if action < 6:
                allowed = level.configuration_status(to) != INVALID
                choices = (action, HOLD)
            else:
                to[:3] = 0.0, 0.0, -0.27  # the Delta is out of the 3-RRS's way
                allowed = level.configuration_status(to) == VALID
                choices = (HOLD, action - 6)
            assert masks[action // 6, action % 6] == allowed
            hidden += allowed and tried(env, *choices)["collision"]
    assert hidden > 100


@pytest.mark.parametrize(("safe", "sight"), [(False, False), (False, True), (True, True)])
def test_the_joint_mask_against_trying_all_49(safe: bool, sight: bool) -> None:
    """And an agent's masks against the joint one's where the other robot holds."""
    env = CoopInsertionJointEnv(mask_singularities=safe)
    team = Team(sight, mask_singularities=safe)
    collisions = refused = 0
    for _ in walk(env, 120):
        mask = env.action_masks()
        assert mask.shape == (49,)
        assert mask[48]
        team.set_state(env.get_state())
        assert team.action_masks().tolist() == [mask[HOLD::7].tolist(), mask[7 * HOLD :].tolist()]
        refused += (~mask[HOLD::7]).sum() + (~mask[7 * HOLD :]).sum()
        infos = [tried(env, *divmod(action, 7)) for action in range(49)]
        bad, collided, singular = (
            np.array([info[name] for info in infos]).reshape(7, 7)
            for name in ("violation", "collision", "singular")
        )
        if not safe:  # only what a robot's own limits forbid
            alone = bad & ~collided & ~singular
            bad = alone[:, [HOLD]] | alone[[HOLD]]
        assert mask.tolist() == (~bad).ravel().tolist()
        collisions += collided.sum()
    assert min(collisions, refused) > 100


def test_a_full_mask_of_the_single_agent_is_not_taken_for_leave() -> None:
    """Where no move is valid the single agent's mask is full; the team's allows to hold alone."""
    arguments: dict[str, Any] = {
        "task": {"linear_step": 0.2, "angular_step": 0.5, "heave_step": 0.2},
        "geometry": {**asdict(OPTIMIZED), "max_tilt": 0.4},
        "mask_singularities": True,
    }
    here = {"configuration": (0.0, 0.0, -0.4, 0.0, 0.0, 0.23)}
    single = CoopInsertionEnv(**arguments)
    single.reset(options=here)
    assert single.action_masks().all()
    team, central = Team(sight=True, **arguments), CoopInsertionJointEnv(**arguments)
    team.reset(options=here)
    central.reset(options=here)
    assert team.action_masks().tolist() == [[False] * 6 + [True]] * 2
    assert central.action_masks().tolist() == [False] * 48 + [True]
