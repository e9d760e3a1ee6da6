"""Both tasks in batches, whose rows are single environments; no failure is cheaper than idling."""

from collections.abc import Callable
from itertools import cycle, islice
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from numpy.testing import assert_equal

from coop_env.errors import ActionError, ArgumentError, ResetOptionError
from coop_env.physics.env import CoopInsertionContactEnv, CoopInsertionPhysicsEnv
from coop_env.physics.moves import CoopInsertionPhysicsDiscreteEnv
from coop_env.physics.task import ContactTask
from coop_env.physics.vector_env import (
    CoopInsertionContactDiscreteVectorEnv,
    CoopInsertionContactVectorEnv,
)
from tests.coop_env.physics.episodes import NO_ERROR, PUSH, REST, RIM, beside, steps

ID = "CoopInsertionContact-v0"


@pytest.mark.parametrize(
    ("name", "threads", "arguments"),
    [
        (ID, 1, {}),
        (ID, 2, {"sim_to_real": "randomized", "privileged": True}),
        ("CoopInsertionPhysics-v0", 2, {"max_steps": 25}),
    ],
)
def test_rows_are_single_environments(name: str, threads: int, arguments: dict[str, Any]) -> None:
    """Through ends of episodes: a fast descent, half of them against the rim until it is 40 N."""
    n = 3
    ours: Any = gym.make_vec(name, num_envs=n, threads=threads, **arguments)
    theirs = SyncVectorEnv(
        [lambda: gym.make(name, **arguments).unwrapped] * n, autoreset_mode=AutoresetMode.SAME_STEP
    )
    (seen, infos), (expected, others) = ours.reset(seed=7), theirs.reset(seed=7)
    assert_equal(seen, expected)
    alike(infos, others)
    rng, ended = np.random.default_rng(0), 0
    for _ in range(60):
        actions = rng.uniform(-0.3, 0.3, (n, 6))
        actions[:, 2] -= 0.7
        seen, rewards, *ends, infos = ours.step(actions)
        expected, paid, *over, others = theirs.step(actions)
        assert_equal((seen, ends), (expected, over))
        alike(rewards, paid)
        alike(infos, others)
        ended += np.any(over, axis=0).sum()
    assert ended >= n
    ours.close()


def alike(mine: Any, theirs: Any) -> None:
    """The same keys, texts and last observations, and numbers to 1e-12."""
    if isinstance(theirs, dict):
        assert set(mine) == set(theirs)
        for key, value in theirs.items():
            alike(mine[key], value)
    elif theirs.dtype == object:
        assert_equal(mine.tolist(), theirs.tolist())
    else:
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=1e-12)


def test_make_vec_makes_it_and_knows_the_limit() -> None:
    endless: Any = gym.make_vec(ID, num_envs=1, max_episode_steps=-1)
    assert endless.batch.max_steps == ContactTask().max_steps
    env = gym.make_vec(ID, num_envs=2, level="hard", max_episode_steps=4)
    assert isinstance(env, CoopInsertionContactVectorEnv)
    env.reset(seed=0)
    for _ in range(4):
        *_, truncated, infos = env.step(np.zeros((2, 6)))
    assert truncated.all()
    assert infos["final_info"]["failure"].tolist() == ["time", "time"]
    moves = gym.make_vec("CoopInsertionContactDiscrete-v0", num_envs=2)
    assert isinstance(moves, CoopInsertionContactDiscreteVectorEnv)
    assert moves.action_space.shape == (2,)
    moves.reset(seed=0)
    observations, *_ = moves.step(np.array([5, 0]))
    assert observations[:, 23:].tolist() == [[0, 0, -1, 0, 0, 0], [1, 0, 0, 0, 0, 0]]


def test_bad_input() -> None:
    env = CoopInsertionContactVectorEnv(2)
    with pytest.raises(ResetNeeded):
        env.step(np.zeros((2, 6)))
    with pytest.raises(ArgumentError, match="seeds"):
        env.reset(seed=[1, 2, 3])
    first = env.reset(seed=0) and env.reset(seed=[1, None])[0]
    env.reset(seed=0)
    assert env.reset(seed=[1, None])[0].tobytes() == first.tobytes()  # None goes on drawing
    for wrong in (np.zeros((3, 6)), np.full((2, 6), np.nan), np.full((2, 6), 2.0)):
        with pytest.raises(ActionError, match="action"):
            env.step(wrong)
    moves = CoopInsertionContactDiscreteVectorEnv(2)
    moves.reset(seed=0)
    with pytest.raises(ActionError, match="actions"):
        moves.step(np.array([0, 12]))
    with pytest.raises(TypeError, match="render_mode"):
        CoopInsertionContactVectorEnv(2, render_mode="rgb_array")
    for name in ("num_envs", "threads"):
        with pytest.raises(ArgumentError, match=name):
            CoopInsertionContactVectorEnv(**{name: 0})
    for name in ("n", "threads", "max_steps"):
        with pytest.raises(ArgumentError, match=name):
            CoopInsertionContactEnv(**{name: -1})  # type: ignore[arg-type]


BROKEN: dict[str, Any] = {**RIM, "friction": 0.2}


@pytest.mark.parametrize(
    ("make", "start", "breaking", "idling"),
    [
        (CoopInsertionContactEnv, BROKEN, PUSH, [REST]),
        (lambda: CoopInsertionContactEnv({"max_steps": 600}), BROKEN, PUSH, [REST]),
        (lambda: CoopInsertionPhysicsEnv(NO_ERROR, max_steps=600), beside(4, 0.01), PUSH, [REST]),
        (
            lambda: CoopInsertionPhysicsDiscreteEnv(
                touch=1e3, level={**NO_ERROR, "force_limit": 15.0}, reward="progress", max_moves=40
            ),
            *(beside(4, 0.03), 5, [4, 5]),
        ),
    ],
    ids=["contact", "a long episode", "whole task", "moves"],
)
def test_a_failure_costs_at_least_what_idling_to_the_end_costs(
    make: Callable[[], Any], start: dict[str, Any], breaking: Any, idling: list[Any]
) -> None:
    env, turns = make(), cycle(idling)
    failed = list(steps(env, breaking, **start))
    assert failed[-1]["failure"] in ("force", "snap")
    idle = list(steps(env, lambda _: next(turns), **start))
    assert idle[-1]["failure"] == "time"
    left = sum(step["reward"] for step in idle[len(failed) - 1 :])  # before, both may do the same
    assert failed[-1]["reward"] <= left + 1e-9


def test_the_force_limit_is_of_the_peak_and_not_of_a_mean() -> None:
    free = CoopInsertionContactEnv({"force_limit": 1e4, "snap_angle": 1.0})
    pushed = list(islice(steps(free, PUSH, **BROKEN), 20))
    first = next(k for k, step in enumerate(pushed) if step["peak_force"] > 1.0)  # at the rim
    peak, mean = pushed[first]["peak_force"], np.linalg.norm(pushed[first]["force"])
    assert peak > 1.2 * mean
    strict = CoopInsertionContactEnv({"force_limit": 0.5 * (peak + mean)})
    ended = list(steps(strict, PUSH, **BROKEN))
    assert ended[-1]["failure"] == "force"
    assert len(ended) == first + 1
    assert ended[-1]["reward_terms"]["force"] == pytest.approx(
        -0.02 * max(0.0, peak - ContactTask().free_force)
    )


def test_depth_beyond_the_required_one_pays_nothing() -> None:
    """One step from just above the required depth to far below it pays no more than to it."""
    fast = CoopInsertionContactEnv({"depth_step": 0.01})
    taken = list(steps(fast, PUSH, hole=4, error=[0.0] * 4))
    assert taken[-1]["success"]
    assert taken[-1]["depth"] > 0.0105
    paid = sum(step["reward_terms"]["depth"] for step in taken)
    assert paid == pytest.approx(1000.0 * 0.02, abs=1e-6)


@pytest.mark.parametrize(
    ("options", "message"),
    [(3, "options = 3: must be a mapping"), ({"configuration": [0, 0, -0.6, 0, 0, 0.22]}, "coll")],
)
def test_options_that_cannot_be_taken_leave_the_episodes_as_they_are(
    options: Any, message: str
) -> None:
    vector: Any = gym.make_vec(
        "CoopInsertionPhysics-v0", 2, vectorization_mode="vector_entry_point"
    )
    vector.reset(seed=0)
    with pytest.raises(ResetOptionError, match=message):
        vector.reset(options=options)
    vector.step(vector.action_space.sample())
