"""Both vector forms: seeds, copies that play on, snapshots, options, conventions."""

import copy
import pickle
from functools import partial
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from sb3_contrib.common.maskable.utils import get_action_masks, is_masking_supported
from stable_baselines3.common.vec_env import VecMonitor

from coop_env import (
    CoopInsertionEnv,
    CoopInsertionJointEnv,
    CoopInsertionJointVecEnv,
    CoopInsertionTeamVecEnv,
    CoopInsertionVecEnv,
    CoopInsertionVectorEnv,
    parallel_env,
)
from coop_env.errors import ArgumentError, ResetOptionError

NOISY: dict[str, Any] = {
    "sim_to_real": "randomized",
    "max_moves": 30,
    "mask_visited": 4,
    "mask_refused": True,
}
FORMS: dict[Any, dict[str, Any]] = {
    CoopInsertionVecEnv: NOISY,
    CoopInsertionTeamVecEnv: {"max_moves": 9},
}


@pytest.mark.parametrize(
    ("single", "vec_form", "arguments"),
    [
        (CoopInsertionEnv, CoopInsertionVecEnv, {"reward": "progress", "max_moves": 40}),
        (CoopInsertionEnv, CoopInsertionVecEnv, {**NOISY, "mask_singularities": True}),
        (
            CoopInsertionJointEnv,
            CoopInsertionJointVecEnv,
            {"max_moves": 12, "mask_singularities": True},
        ),
    ],
)
def test_both_batches_are_single_environments_in_rows(
    single: Any, vec_form: Any, arguments: dict[str, Any]
) -> None:
    n, seed = 4, 5
    singles = [single(**arguments) for _ in range(n)]
    vec = vec_form(n, seed, **arguments)
    vector = CoopInsertionVectorEnv(n, None, single, **arguments)
    rows = vec.reset()
    assert vector.reset(seed=seed)[0].tobytes() == rows.tobytes()
    for i, env in enumerate(singles):
        assert env.reset(seed=seed + i)[0].tobytes() == rows[i].tobytes()
    rng, violations, ends = np.random.default_rng(0), 0, 0
    for _ in range(200):
        actions = rng.integers(singles[0].action_space.n, size=n)
        rows, rewards, dones, infos = vec.step(actions)
        others, floats, terminated, truncated, _ = vector.step(actions)
        assert others.tobytes() == rows.tobytes()
        assert floats.astype(np.float32).tobytes() == rewards.tobytes()
        assert (terminated | truncated).tolist() == dones.tolist()
        masks = vec.env_method("action_masks")
        np.testing.assert_array_equal(masks, vector.action_masks())
        for i, env in enumerate(singles):
            row, reward, ended, cut, info = env.step(actions[i])
            assert rewards[i] == np.float32(reward)
            assert dones[i] == (ended or cut)
            assert {k: infos[i][k] for k in info} == info
            violations, ends = violations + info["violation"], ends + dones[i]
            if dones[i]:
                assert infos[i]["TimeLimit.truncated"] == cut
                assert infos[i]["terminal_observation"].tobytes() == row.tobytes()
                assert infos[i]["terminal_action_mask"].tolist() == env.action_masks().tolist()
                row, _ = env.reset()
            assert rows[i].tobytes() == row.tobytes()
            assert masks[i].tolist() == env.action_masks().tolist()
    assert min(violations, ends) > 10


def course(env: Any) -> list[bytes]:
    """What the move taken, fixed ones after it and the next reset show, masks included."""
    rng = np.random.default_rng(1)
    step, shown = env.step_wait(), []
    for _ in range(80):
        masks = env.action_masks()
        shown += [x.tobytes() for x in step[:-1]] + [masks.tobytes()]
        step = env.step(rng.integers(masks.shape[1], size=env.num_envs))
    return [*shown, env.reset().tobytes()]


@pytest.mark.parametrize("form", FORMS)
def test_copies_and_snapshots_play_on_as_the_original(form: Any) -> None:
    """With the move taken, and the stage and the options of the next reset."""
    env, other = (form(3, seed=seed, **FORMS[form]) for seed in (0, 9))
    env.reset()
    for _ in range(20):
        last, *_ = env.step(np.arange(env.num_envs))
    env.set_options({"target": 2})
    env.set_attr("stage", 0)
    env.step_async(np.arange(env.num_envs)[::-1].copy())
    snapshot = pickle.loads(pickle.dumps(env.get_state()))
    assert other.set_state(snapshot).tobytes() == last.tobytes()  # the very noise, not another draw
    twins = [copy.deepcopy(env), pickle.loads(pickle.dumps(env)), other]
    assert set(env.get_attr("stage")) == {0}
    assert {int(s["active"].sum()) for s in env.get_attr("state")} == {6}  # until the next reset
    assert [course(twin) for twin in twins] == [course(env)] * 3
    assert {(int(s["target"]), int(s["active"].sum())) for s in env.get_attr("state")} == {(2, 4)}


@pytest.mark.parametrize("form", FORMS)
def test_sb3s_tools_and_wrappers_work_on_the_batch(form: Any) -> None:
    batch = form(2, seed=0, max_moves=3)
    n = batch.rows_each  # of each environment
    batch.set_options([{"target": 1}, {"target": 2}])
    monitored = VecMonitor(batch)
    monitored.reset()
    assert [s["target"] for s in batch.get_attr("state")] == [1] * n + [2] * n
    assert is_masking_supported(monitored)
    assert get_action_masks(monitored).shape == (2 * n, batch.action_space.n)
    for _ in range(3):
        *_, infos = monitored.step(np.full(2 * n, 6))
    assert [info["episode"]["l"] for info in infos] == [3] * (2 * n)
    batch.env_method("set_stage", 0)
    batch.set_attr("stage", 1, indices=[2 * n - 1])
    assert batch.get_attr("stage") == [0] * n + [1] * n
    with pytest.raises(ArgumentError, match="speed"):
        batch.set_attr("speed", 1)
    assert batch.env_is_wrapped(VecMonitor) == [False] * (2 * n)
    assert len(batch.get_images()) == 2
    assert batch.metadata == CoopInsertionEnv.metadata
    batch.close()


@pytest.mark.parametrize(
    "bad", [{"target": 9}, [{"target": 1}], [{}, {"filled": 3}], {"filled": np.array(1)}, 5]
)
def test_bad_options_leave_the_old_ones(bad: Any) -> None:
    env = CoopInsertionVecEnv(2, seed=0)
    here = (0.01, 0.0, -0.33, 0.1, 0.1, 0.22)
    env.set_options({"configuration": here, "target": 3, "filled": [0]})
    with pytest.raises(ResetOptionError):
        env.set_options(bad)
    env.reset()
    for state in env.get_attr("state"):
        assert tuple(state["configuration"]) == here
        assert state["target"] == 3
        assert state["filled"].tolist() == [1, 0, 0, 0, 0, 0]
    env.reset()  # they serve once
    assert tuple(env.get_attr("configuration")[0]) != here


@pytest.mark.parametrize("seed", [-1, "one", 1.5, True])
def test_seeds(seed: Any) -> None:
    with pytest.raises(ArgumentError, match="seed"):
        CoopInsertionVecEnv(2, seed=seed)
    with pytest.raises(ArgumentError, match="seed"):
        CoopInsertionVectorEnv(2).reset(seed=seed)


def test_the_vector_env_shows_what_gymnasiums_own_shows() -> None:
    """Against ``SyncVectorEnv`` in the same autoreset mode: values, types, infos, final infos."""
    arguments: dict[str, Any] = {"max_moves": 9, "reward": "progress", "observation": "markov"}
    ours: Any = CoopInsertionVectorEnv(3, **arguments)
    theirs = SyncVectorEnv(
        [lambda: CoopInsertionEnv(**arguments)] * 3, autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert ours.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    (a, own_infos), (b, infos) = ours.reset(seed=5), theirs.reset(seed=5)
    assert a.tobytes() == b.tobytes()
    assert data_equivalence(own_infos, infos, exact=True)
    rng = np.random.default_rng(0)
    finals = 0
    for _ in range(60):
        masks = ours.action_masks()
        actions = rng.integers(12, size=3)
        (*got, own_infos), (*expected, infos) = ours.step(actions), theirs.step(actions)
        for x, y in zip(got, expected, strict=True):
            assert x.dtype == y.dtype
            np.testing.assert_array_equal(x, y)
        if "final_obs" in own_infos:
            finals += 1
            ended = own_infos.pop("_final_action_mask")
            assert ended.tolist() == (got[2] | got[3]).tolist()
            final_masks = own_infos.pop("final_action_mask")
            assert final_masks.shape == masks.shape
            assert not final_masks[~ended].any()
            assert final_masks[ended].any(axis=1).all()
        assert data_equivalence(own_infos, infos, exact=True)
    assert finals >= 6


def test_attributes_and_calls_reach_each_environment() -> None:
    env = CoopInsertionVectorEnv(2, render_mode="ansi")
    _, infos = env.reset(seed=[4, None], options={"target": 1})
    infos["_success"][:] = False
    assert infos["_distance"].all()  # an array of its own
    assert [s["target"] for s in env.get_attr("state")] == [1, 1]
    env.call("set_stage", 0)
    env.set_attr("stage", [1, 0])
    assert env.get_attr("stage") == (1, 0)
    env.step(np.zeros(2, int))
    frames: Any = env.render()
    assert all("target" in frame for frame in frames)
    assert [len(each.scene().trace) for each in env.envs] == [2, 2]
    with pytest.raises(ArgumentError, match="3 values for 2"):
        env.set_attr("stage", [0, 1, 0])
    with pytest.raises(ArgumentError, match="stage = 7"):
        env.set_attr("stage", [0, 7])
    assert env.get_attr("stage") == (1, 0)  # the first is as it was, too
    with pytest.raises(ArgumentError, match="seed"):
        env.reset(seed=[1, 2, 3])


@pytest.mark.parametrize(
    ("form", "action"),
    [
        (CoopInsertionEnv, 4),
        (partial(CoopInsertionVecEnv, 1), [4]),
        (CoopInsertionVectorEnv, [4]),
        (parallel_env, {"delta": 4, "rrs": 0}),
    ],
)
def test_a_shallow_copy_leaves_the_original_where_it_was(form: Any, action: Any) -> None:
    def place(env: Any) -> Any:
        single = env.envs[0] if hasattr(env, "envs") else getattr(env, "team", env)
        return single.configuration

    env = form()
    env.seed(0) if isinstance(env, CoopInsertionVecEnv) else env.reset(seed=0)
    env.reset()
    other, before = copy.copy(env), place(env)
    other.step(action)
    np.testing.assert_array_equal(place(env), before)
    assert not np.array_equal(place(other), before)


class Own(CoopInsertionEnv):
    """An environment whose reset says something of its own."""

    def reset(self, **given: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = super().reset(**given)
        return 0.0 * observation, {**info, "name": 7}


class OwnVecEnv(CoopInsertionVecEnv):
    env_class = Own


def test_a_reset_of_ones_own_counts_at_the_start_and_between_episodes() -> None:
    batch = CoopInsertionVectorEnv(2, env_class=Own, max_moves=1)
    vec_env = OwnVecEnv(2, max_moves=1)
    actions = np.array([4, 4])
    for first in (
        *(batch.reset(seed=0)[0], batch.step(actions)[0]),
        *(vec_env.reset(), vec_env.step(actions)[0]),
    ):
        np.testing.assert_array_equal(first, np.zeros((2, 12)))
    assert [info["name"] for info in vec_env.reset_infos] == [7, 7]
    vec_env.reset()
    assert [info["name"] for info in vec_env.reset_infos] == [7, 7]


def test_a_snapshot_brings_no_collision_of_another_episode() -> None:
    env = CoopInsertionEnv(collision="terminate", max_moves=20)
    env.reset(seed=0)
    for k in range(20):
        env.step(4 + k % 2)  # up and down
    timeout = env.get_state()
    while env.scene().status != "collision":
        env.reset()
        while env.running:
            env.step(5)
    env.set_state(timeout)
    assert env.scene().status == "timeout"


def test_a_reset_that_is_refused_starts_no_environment() -> None:
    """Options that were right when they were set, and are wrong at another stage."""
    env = CoopInsertionVecEnv(3, seed=0)
    env.reset()
    before = env.get_attr("state")
    env.set_options([{}, {"target": 5}, {}])
    env.set_attr("stage", 0)
    with pytest.raises(ResetOptionError, match="target"):
        env.reset()
    assert env.get_attr("state") == before
