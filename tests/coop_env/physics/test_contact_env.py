"""The contact task: checkers, episodes and their ends, forces, what is drawn, bad input."""

import copy
import pickle
from dataclasses import replace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from coop_env.errors import ActionError, ArgumentError, ResetOptionError
from coop_env.geometry import OPTIMIZED, GeometryError
from coop_env.kinematics import delta, rrs
from coop_env.physics.env import CoopInsertionContactEnv, CoopInsertionPhysicsEnv
from coop_env.physics.model import Servos
from coop_env.physics.moves import CoopInsertionPhysicsDiscreteEnv
from coop_env.physics.twin import last
from tests.coop_env.moves import MOVES
from tests.coop_env.physics.episodes import ASIDE, PUSH, REST, RIM, above, play

TASKS = ("Contact", "ContactDiscrete", "Physics", "PhysicsDiscrete")
IDS = tuple(f"CoopInsertion{task}-v0" for task in TASKS)
DOWN = 0.5 * PUSH


@pytest.fixture(scope="module")
def env() -> CoopInsertionContactEnv:
    return CoopInsertionContactEnv()


def push(observation: np.ndarray) -> np.ndarray:
    """Downwards as long as less than 8 N is felt."""
    return DOWN if 10.0 * observation[13] < 8.0 else REST


@pytest.mark.parametrize("name", IDS)
def test_checkers(name: str) -> None:
    check_env(gym.make(name).unwrapped, skip_render_check=True)
    sb3_check_env(gym.make(name).unwrapped)


def test_a_hole_where_it_is_believed_takes_the_peg(env: CoopInsertionContactEnv) -> None:
    _, info = env.reset(seed=0, options={"error": [0.0] * 4})
    assert info["depth"] == pytest.approx(-0.01, abs=1e-9)
    assert info["lateral_error"] < 1e-9
    end = play(env, DOWN, error=[0.0] * 4)
    assert (end["is_success"], end["failure"]) == (True, "")
    assert end["depth"] >= 0.01
    assert end["peak_force"] < 1.0
    # 20 mm of depth, the bonus, 0.05 a step
    assert end["return"] == pytest.approx(1000 * 0.02 + 20 - end["time"], abs=0.1)


@pytest.mark.parametrize(
    ("level", "error", "expected"),
    [
        ("easy", 0.003, 1.0),  # a round tip finds the hole by itself
        ("standard", 0.001, 1.0),  # within clearance and chamfer
        ("standard", 0.0025, 0.0),
        ("hard", 0.0006, 1.0),
        ("hard", 0.0015, 0.0),
    ],
)
def test_a_compliant_push_succeeds_as_far_as_clearance_and_chamfer_reach(
    level: str, error: float, expected: float
) -> None:
    env = CoopInsertionContactEnv(level)
    ends = []
    for k in range(6):
        side = 2.0 * np.pi * k / 6
        where = [error * np.cos(side), error * np.sin(side), 0.005, -0.005]
        ends.append(play(env, push, seed=k, error=where, hole=k))
    assert np.mean([end["success"] for end in ends]) == expected
    if expected == 0.0:
        assert {end["failure"] for end in ends} == {"time"}
        assert max(end["depth"] for end in ends) < 2e-4  # nothing leaks


def test_nothing_leaks_beside_a_hole() -> None:
    """A stiff Delta presses the peg on the rim, all around, to 20 N: it sinks in by 0.1 mm."""
    env = CoopInsertionContactEnv({"force_limit": 20.0}, servos=Servos(delta_stiffness=1000.0))
    for k in range(24):
        side, off = 2.0 * np.pi * k / 24, 0.0018 + 0.0002 * k  # over chamfer and spot face
        where = [off * np.cos(side), off * np.sin(side), 0.0, 0.0]
        end = play(env, 0.2 * PUSH, seed=k, error=where, hole=k % 6, friction=0.4)
        assert end["failure"] == "force"
        data = env.batch.twin.inspect(0)[1]
        platform = data.body("platform")
        tip = platform.xmat.reshape(3, 3).T @ (data.site("tip").xpos - platform.xpos)
        height = tip @ env.batch.machine.task.hole_normals[k % 6]
        assert height - 0.1 > -3e-4
        assert min(data.contact.dist) > -1.5e-4


def test_force_is_measured_noticed_and_ends_the_episode(env: CoopInsertionContactEnv) -> None:
    end = play(env, DOWN, seed=3, **RIM)
    assert (end["failure"], end["terminated"]) == ("force", True)
    assert end["reward_terms"]["failure"] == -5.0
    assert end["force"][2] > 39.0
    assert end["peak_force"] >= np.linalg.norm(end["force"])
    # the hole is at +x, so the rim carries the peg at -x: a moment about +y
    assert end["moment"][1] > 0.02
    observation = end["observation"]
    assert 10.0 * observation[13] == pytest.approx(end["force"][2], abs=0.2)
    assert 0.05 * observation[15] == pytest.approx(end["moment"][1], abs=0.005)
    with pytest.raises(ResetNeeded):
        env.step(DOWN)


def test_a_force_balances_the_servos(env: CoopInsertionContactEnv) -> None:
    """What the peg feels is what the Delta's servos push with, by its Jacobian."""
    env.reset(seed=3, options=RIM)
    for action in [DOWN] * 27 + [REST] * 20:
        *_, info = env.step(action)
    twin = env.batch.twin
    torques = twin.inspect(0)[1].actuator_force[:3].copy()
    turned = delta.jacobian(env.configuration[:3]) / twin.machine.delta.proximal_length
    assert info["force"][2] > 5.0
    assert turned.T @ torques == pytest.approx(-info["force"], rel=0.02, abs=0.1)


def test_another_assembly_mode_is_seen_within_a_control_step(env: CoopInsertionContactEnv) -> None:
    """The same servo commands hold the platform elsewhere: where a jump would leave it."""
    env.reset(seed=0, options={"hole": 0})
    start, twin = env.configuration, env.batch.twin
    near = np.random.default_rng(0).uniform([-1.2, -1.2, 0.1], [1.2, 1.2, 0.3], (400, 3))
    found = rrs.forward(rrs.inverse(start[3:]).q, near).pose  # on whose side of det A each is
    poses = np.unique(np.round(found[np.isfinite(found).all(axis=1)], 9), axis=0)
    elsewhere = poses[np.abs(poses - start[3:]).max(axis=1) > 0.01]
    assert len(elsewhere) >= 2
    for pose in elsewhere:
        env.reset(seed=0, options={"hole": 0})
        position = twin.joint_positions([*start[:3], *pose])
        twin.states[0, 1 : 1 + position.size] = position
        *_, terminated, _, info = env.step(REST)
        assert (terminated, info["failure"]) == (True, "snap")
        targets = twin.servo_targets(start)
        joints = last(twin.advance(targets[None], 500)).joints[0]
        assert joints[3:] == pytest.approx(targets[3:], abs=1e-3)  # it stays, and no joint shows it


@pytest.mark.parametrize("name", [IDS[0], IDS[2]])
def test_a_simulation_that_diverges_ends_with_a_cause(name: str) -> None:
    env: Any = gym.make(name).unwrapped
    env.reset(seed=0)
    env.step(REST)
    env.batch.twin.states[0, -21:] = 1e12
    observation, reward, terminated, _, info = env.step(REST)
    assert (terminated, info["failure"]) == (True, "diverged")
    numbers = [reward, *info["force"], info["depth"], info["lateral_error"]]
    assert np.isfinite([*observation, *numbers, *env.reset(seed=0)[0]]).all()


@pytest.mark.parametrize("name", [IDS[0], IDS[2]])
def test_a_command_beyond_the_robots_is_not_taken(name: str) -> None:
    env: Any = gym.make(name).unwrapped
    env.reset(seed=0)
    for _ in range(80):
        *_, info = env.step(np.array([0.0, 0.0, 1.0, 0.0, 0.0, 1.0]))
    assert info["violation"]
    assert info["failure"] == ("time" if name == IDS[0] else "")
    assert env.configuration[5] <= 0.25


def test_what_is_drawn_stays_within_the_task_and_is_as_drawn_whatever_options_fix(
    env: CoopInsertionContactEnv,
) -> None:
    env.reset(seed=0)
    infos = [env.reset()[1] for _ in range(100)]
    errors = np.array([info["error"] for info in infos])
    offset = np.hypot(errors[:, 0], errors[:, 1])
    assert offset.max() <= 0.003
    assert np.mean(offset > 0.003 * np.sqrt(0.5)) == pytest.approx(0.5, abs=0.17)  # over a disc
    assert np.degrees(np.hypot(errors[:, 2], errors[:, 3])).max() <= 1.0
    friction = np.array([info["friction"] for info in infos])
    assert 0.1 <= friction.min() < 0.15 < 0.35 < friction.max() <= 0.4
    assert {info["hole"] for info in infos} == set(range(6))
    # the drawn error is where the hole really is
    lateral = np.array([info["lateral_error"] for info in infos])
    assert lateral == pytest.approx(offset, abs=3e-4)  # the tip stands 10 mm up a tilted axis
    _, free = env.reset(seed=4)
    _, fixed = env.reset(seed=4, options={"error": [0.0] * 4})
    assert (free["hole"], free["friction"]) == (fixed["hole"], fixed["friction"])
    assert np.all(fixed["error"] == 0.0)


def test_moves_are_increments(env: CoopInsertionContactEnv) -> None:
    discrete: Any = gym.make(IDS[1]).unwrapped
    discrete.reset(seed=2)
    env.reset(seed=2)
    for action, moved in enumerate(MOVES):
        before = discrete.configuration
        observation = discrete.step(action)[0]
        expected = moved * env.task.increments
        assert discrete.configuration - before == pytest.approx(expected, abs=1e-15)
        assert observation.tobytes() == env.step(moved)[0].tobytes()
    for wrong in (12, -1, 0.0, True, "0"):
        with pytest.raises(ActionError, match="action"):
            discrete.step(wrong)


@pytest.mark.parametrize(
    "action", [np.full(6, np.nan), np.full(6, 1.01), np.zeros(5), "down", None, np.inf * np.ones(6)]
)
def test_actions_that_are_none(env: CoopInsertionContactEnv, action: Any) -> None:
    env.reset(seed=0)
    state = env.batch.twin.states.copy()
    with pytest.raises(ActionError, match="action"):
        env.step(action)
    assert np.array_equal(env.batch.twin.states, state)


OPTIONS: dict[Any, list[Any]] = {
    CoopInsertionContactEnv: [
        {"hole": 6}, {"hole": True}, {"hole": np.array([1, 2])},
        {"error": [0.0, 0.0]}, {"error": [np.nan] * 4}, {"error": dict.fromkeys(range(4))},
        {"error": [0.1, 0, 0, 0]}, {"friction": 0.0}, {"force": 1}, 7,
    ],
    CoopInsertionPhysicsEnv: [{"error": [1.0]}, {"hole": 1}, {"target": 9}, 3],
    CoopInsertionPhysicsDiscreteEnv: [{"error": [0.0]}, {"hole": 1}],
}  # fmt: skip


@pytest.mark.parametrize("kind", OPTIONS)
def test_reset_options_that_cannot_be(kind: Any) -> None:
    env = kind()
    still = 0 * env.action_space.sample()
    with pytest.raises(ResetNeeded):
        env.step(still)
    env.reset(seed=0)
    before = env.configuration
    for options in OPTIONS[kind]:
        with pytest.raises(ResetOptionError):
            env.reset(options=options)
    np.testing.assert_array_equal(env.configuration, before)
    env.step(still)


ARGUMENTS: dict[Any, list[Any]] = {
    CoopInsertionContactEnv: [
        {"level": "harder"}, {"level": {"dt": 0.001}}, {"level": {"friction": [0.4, 0.1]}},
        {"level": {"insertion_depth": 0.03}}, {"level": {"max_steps": 0}},
        {"level": {"position_error": 0.03}}, {"level": {"clearence": 1}},
        {"servos": {"rrs_stiffness": -1.0}},
    ],
    CoopInsertionPhysicsEnv: [
        {"max_steps": 0}, {"max_steps": None}, {"stage": 2}, {"render_mode": "x"},
    ],
    CoopInsertionPhysicsDiscreteEnv: [{"pose_model": "paper"}, {"finish": 3}, {"touch": 0.0}],
}  # fmt: skip


@pytest.mark.parametrize("kind", ARGUMENTS)
def test_arguments_that_cannot_be(kind: Any) -> None:
    for wrong in ARGUMENTS[kind]:
        with pytest.raises(ArgumentError):
            kind(**wrong)


def test_holes_that_cannot_be_turned_upright() -> None:
    with pytest.raises(GeometryError, match="upright"):
        CoopInsertionContactEnv(holes={"holes": [[1.2, 0.0]]})
    narrow = replace(OPTIMIZED, heave_max=0.2199)
    with pytest.raises(GeometryError, match="5 mm of heave left both ways"):
        CoopInsertionContactEnv(geometry=narrow)
    # the initial geometry's singularity lies at its 30-degree holes
    starts = CoopInsertionContactEnv(geometry="initial").batch.starts
    assert np.isfinite(starts).all(axis=1).tolist() == [False] * 4 + [True] * 2


ASLANT = np.array([0.1, 0.0, -0.5, 0.0, 0.0, 0.1])


@pytest.mark.parametrize(
    "take", [copy.copy, copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))]
)
@pytest.mark.parametrize(
    ("name", "arguments", "start", "before", "after"),
    [
        (IDS[0], {}, {}, [ASLANT] * 25, [ASLANT] * 10),  # in contact by then
        (IDS[0], {"sim_to_real": "randomized"}, {}, [ASIDE], [ASIDE] * 3),
        (IDS[3], {"finish": push}, above(2, 0.045), [0], [1, 5, 4]),
    ],
    ids=["nominal", "disturbed", "moves"],
)
def test_a_copy_in_the_midst_of_an_episode_goes_on_alike(
    name: str, arguments: Any, start: Any, before: list[Any], after: list[Any], take: Any
) -> None:
    """To the end of this episode, and with the same machine in the next."""
    env: Any = gym.make(name, **arguments).unwrapped
    env.reset(seed=5, options={"error": [0.002, 0.0, 0.0, 0.0], **start})
    for action in before:
        env.step(action)
    other = take(env)
    for action in after:
        mine, theirs = env.step(action), other.step(action)
        np.testing.assert_array_equal(mine[0], theirs[0])
        assert mine[1:4] == theirs[1:4]
        assert mine[4]["peak_force"] == theirs[4]["peak_force"]
    mine, theirs = env.reset()[1], other.reset()[1]
    np.testing.assert_array_equal(mine.get("privileged"), theirs.get("privileged"))
    np.testing.assert_array_equal(env.step(after[0])[0], other.step(after[0])[0])
