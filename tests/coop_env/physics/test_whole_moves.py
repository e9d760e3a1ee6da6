"""The kinematic task's moves on the twin: where they end, collisions, finishes, the contract."""

from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded

from coop_env.env import CoopInsertionEnv
from coop_env.errors import ActionError, ResetOptionError, StateError
from coop_env.physics.moves import CoopInsertionPhysicsDiscreteEnv
from tests.coop_env.physics.episodes import NO_ERROR, REST, above, beside

DOWN = 5


def push(seen: np.ndarray) -> np.ndarray:
    """Down while less than 6 N is felt, and to the side that gives way."""
    fx, fy, fz = 10.0 * seen[11:14]
    down = -1.0 if fz < 1.0 else 0.1 * (fz - 6.0)
    return np.clip([0.3 * fx, 0.3 * fy, down, 0.0, 0.0, 0.0], -1.0, 1.0)


def test_moves_end_where_the_kinematic_task_has_them() -> None:
    """Without errors and contact: tip within 0.05 mm, platform within 0.05 degrees."""
    arguments: dict[str, Any] = {
        "reward": "progress", "mask_singularities": True, "observation": "markov",
    }  # fmt: skip
    env = CoopInsertionPhysicsDiscreteEnv(level=NO_ERROR, **arguments)
    kinematic = CoopInsertionEnv(**arguments)
    assert env.observation_space == kinematic.observation_space
    assert env.action_space == kinematic.action_space
    rng = np.random.default_rng(0)
    for seed in range(3):
        seen, info = env.reset(seed=seed)
        there, known = kinematic.reset(seed=seed)
        np.testing.assert_array_equal(seen, there)
        assert set(known) <= set(info)
        for _ in range(25):
            masks = env.action_masks()
            np.testing.assert_array_equal(masks, kinematic.action_masks())
            masks[DOWN] = False  # up and about: nothing is touched
            action = int(rng.choice(np.flatnonzero(masks)))
            seen, reward, *_, info = env.step(action)
            there, expected, *_, known = kinematic.step(action)
            np.testing.assert_allclose(seen, there, atol=1e-6)
            assert reward == pytest.approx(expected)
            assert set(known) <= set(info)
            assert info["violation"] == known["violation"]
            assert info["distance"] == pytest.approx(known["distance"], abs=5e-4)
        assert info["time"] == pytest.approx(known["time"])
        body, p = env.physics, kinematic.state
        body.lead(body.configuration, 10)  # to rest
        readings = body.twin.readings()
        assert np.linalg.norm(readings.tip[0] - p["tip"]) < 5e-5
        normals = readings.rotation[0] @ np.array(env.task.hole_normals).T
        cosine = np.clip(np.sum(normals.T * p["normals"], axis=1), -1.0, 1.0)
        assert np.degrees(np.arccos(cosine)).max() < 0.05


def test_an_error_of_the_machine_is_not_seen_but_counts() -> None:
    env = CoopInsertionPhysicsDiscreteEnv()
    options = above(2, 0.029)
    seen, _ = env.reset(seed=0, options={**options, "error": [0.0, 0.0, 0.0, 0.0]})
    *_, info = env.step(DOWN)
    assert info["inserted"]  # 9 mm
    there, _ = env.reset(seed=0, options={**options, "error": [0.006, 0.0, 0.0, 0.0]})
    np.testing.assert_array_equal(seen, there)
    *_, info = env.step(DOWN)
    assert not info["inserted"]


def test_a_move_into_the_dome_is_taken_back() -> None:
    env = CoopInsertionPhysicsDiscreteEnv(level=NO_ERROR, mask_refused=True)
    env.reset(seed=0, options=beside(4, 0.012, 0.022))
    before = env.configuration
    *_, info = env.step(DOWN)
    assert (info["collision"], info["violation"], info["failure"]) == (True, True, "")
    np.testing.assert_array_equal(env.configuration, before)
    np.testing.assert_allclose(env.physics.configuration, before, atol=1e-12)
    assert not env.action_masks()[DOWN]


def test_an_insertion_that_a_contact_cuts_short_leaves_the_model_where_the_machine_is() -> None:
    env = CoopInsertionPhysicsDiscreteEnv(touch=8.0)
    energy = []
    for error in (0.0, 0.0035):
        env.reset(seed=0, options={**above(4, 0.012), "error": [error, 0.0, 0.0, 0.0]})
        *_, info = env.step(DOWN)
        assert info["inserted"]
        np.testing.assert_array_equal(env.configuration, env.physics.command[0])
        energy.append(info["energy"])
    assert energy[1] == pytest.approx(0.75 * energy[0], rel=0.02)


def test_a_finish_inserts_and_leaves_the_peg_above_the_hole() -> None:
    """It may look at its environment."""

    def finish(seen: np.ndarray) -> np.ndarray:
        assert env.running
        assert env.observation_space.contains(env.observe())
        return push(seen)

    env = CoopInsertionPhysicsDiscreteEnv(finish=finish)
    env.reset(seed=0, options={**above(3, 0.025), "error": [0.0005, 0.0, 0.01, 0.0]})
    *_, info = env.step(DOWN)
    assert (info["inserted_hole"], info["given_up"]) == (3, [])
    assert env.physics.filled[0, 3]
    assert info["peak_force"] < 10.0
    np.testing.assert_allclose(env.configuration, env.physics.configuration)
    assert not env.state["inside"].any()
    *_, info = env.step(4)
    assert not info["violation"]


@pytest.mark.parametrize("answer", [3, "a", [[0.0] * 6], [np.nan] * 6])
def test_a_finish_that_answers_nonsense_is_named(answer: Any) -> None:
    env = CoopInsertionPhysicsDiscreteEnv(finish=lambda seen: answer)
    env.reset(seed=0, options=above(3, 0.025))
    with pytest.raises(ActionError, match=r"finish gave .*: must be 6 increments"):
        env.step(DOWN)
    assert not env.running


def test_what_is_observed_is_of_the_space() -> None:
    env = CoopInsertionPhysicsDiscreteEnv(privileged=True)
    seen: Any = env.reset(seed=0)[0]
    assert env.observation_space.contains(env.observe())
    np.testing.assert_array_equal(env.observe()["observation"], seen["observation"])


def test_a_hole_that_is_not_filled_is_given_up_and_the_last_one_ends_the_episode() -> None:
    env = CoopInsertionPhysicsDiscreteEnv(finish=push)
    with pytest.raises(ResetNeeded):
        env.scene()
    for filled in ([], [0, 1, 2, 4, 5]):
        aside = {"error": [0.003, 0.0, 0.0, 0.0], "filled": filled}
        env.reset(seed=0, options={**above(3, 0.025), **aside})
        _, _, terminated, _, info = env.step(DOWN)
        assert (info["inserted"], info["given_up"]) == (False, [3])
        assert (info["target"] == 3) == terminated == bool(filled)
        assert info["failure"] == ("not inserted" if filled else "")
    assert env.scene().status == "not inserted"
    assert not env.scene().active[3]
    with pytest.raises(ResetOptionError, match=r"known: .*'filled', 'error', 'friction'\]"):
        env.reset(options={"errors": 0.0})


def fly(env: CoopInsertionPhysicsDiscreteEnv, hole: int) -> np.ndarray:
    """Up, upright, and over to another hole, 50 mm higher than now; where its insertion begins."""
    body = env.physics
    there: np.ndarray = above(hole)["configuration"]
    away, over = body.configuration, there.copy()
    away[2] += 0.05
    upright = np.array([0.0, 0.0, away[2], 0.0, 0.0, away[5]])
    over[2] = away[2]
    for to in (away, upright, over):
        body.lead(to, 4)
    return there


def test_after_a_hole_the_view_and_the_next_target_are_those_of_where_it_stands() -> None:
    """On the way between them the 3-RRS's forward kinematics has no straight line to follow."""
    seen: list[np.ndarray] = []

    def steered(observation: np.ndarray) -> np.ndarray:
        seen.append(observation[:5])
        x, y = -10.0 * observation[:2]
        return np.clip([x, y, -1.0, 0.0, 0.0, 0.0], -1.0, 1.0)

    env = CoopInsertionPhysicsDiscreteEnv(finish=steered, level=NO_ERROR)
    env.reset(seed=0, options={**above(1, 0.02), "filled": [0, 3, 4, 5]})
    assert env.physics.insert()
    assert env.physics.target == 2
    fly(env, 2)
    before = len(seen)
    assert env.physics.insert()
    np.testing.assert_allclose(seen[before], [0.0, 0.0, 1.0, 0.0, 0.0], atol=0.05)


def test_the_next_target_is_the_nearest_hole_wherever_the_episode_began() -> None:
    env = CoopInsertionPhysicsDiscreteEnv(level=NO_ERROR)
    body = env.physics
    env.reset(seed=0, options=above(1, 0.03))
    assert body.lead(fly(env, 2), 4)
    body.hole[0] = 2
    body.fill(0)
    readings = body.twin.readings()
    normals = readings.rotation[0] @ np.array(env.task.hole_normals).T
    away = np.linalg.norm(readings.platform[0] + 0.1 * normals.T - readings.tip[0], axis=1)
    away[2] = np.inf
    assert body.target == int(np.argmin(away))


def test_a_simulation_has_no_snapshots() -> None:
    env = CoopInsertionPhysicsDiscreteEnv()
    for use in (env.get_state, lambda: env.set_state({})):
        with pytest.raises(StateError):
            use()


def test_the_kinematic_criterion_fills_a_hole_and_each_episode_is_drawn_as_it_is() -> None:
    env = CoopInsertionPhysicsDiscreteEnv(level=NO_ERROR, render_mode="ansi")
    for _ in range(2):
        env.reset(seed=0, options=above(2, 0.025))
        np.testing.assert_array_equal(env.scene().trace, [env.physics.twin.readings().tip[0]])
        *_, info = env.step(DOWN)
        assert (info["inserted"], info["inserted_hole"]) == (True, 2)
        assert info["distance"] == pytest.approx(0.005, abs=1e-3)
        assert info["target"] != 2
        scene = env.scene()
        assert scene.filled.tolist() == [False, False, True, False, False, False]
        assert len(scene.trace) == 2
        assert scene.tip == pytest.approx(env.physics.twin.readings().tip[0])
        assert "2#" in env.render()


def test_after_close_there_is_no_step() -> None:
    for name in ("Physics-v0", "Contact-v0", "PhysicsDiscrete-v0"):
        env: Any = gym.make(f"CoopInsertion{name}").unwrapped
        env.reset(seed=0)
        env.close()
        env.close()
        with pytest.raises(ResetNeeded):
            env.step(REST)
        with pytest.raises(ClosedEnvironmentError, match="anew"):
            env.reset(seed=0)


def test_a_snap_is_no_collision() -> None:
    level: dict[str, Any] = {**NO_ERROR, "force_limit": 1e4}
    servos = {"rrs_stiffness": 2.0, "delta_stiffness": 400.0}
    env = CoopInsertionPhysicsDiscreteEnv(touch=1e9, level=level, servos=servos)
    env.reset(seed=0, options=beside(0, 0.03))
    terminated = False
    while not terminated:
        *_, terminated, _, info = env.step(5)
    assert (info["failure"], info["singular"], info["collision"]) == ("snap", True, False)
