"""Test episodes: what each metric counts, common initial states, noise that repeats."""

import dataclasses
import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.evaluation.evaluate import (
    Condition,
    Rows,
    begin_episodes,
    by_policy,
    follow,
    in_turn,
    play,
)
from benchmarks.methods.base import Plan, Policy
from benchmarks.methods.episodes import Episode, distance_to_segment, dome_frame, env_arguments
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import load_preset
from benchmarks.protocol.seeding import episode_seeds
from coop_env.env import CoopInsertionEnv
from coop_env.geometry import GEOMETRIES, RRSGeometry
from coop_env.simulation.insertion_task import PAPER_TASK
from coop_env.trajectory import make_trajectory
from tests.benchmarks.smoke import smoke_preset

ARGUMENTS: dict[str, Any] = {"reward": "progress", "max_moves": 40}
COORDINATE = st.floats(-1.0, 1.0)
POINT = st.tuples(COORDINATE, COORDINATE, COORDINATE).map(np.array)


@given(POINT, POINT, POINT)
def test_distance_to_a_segment_is_the_least_over_its_points(
    point: np.ndarray, start: np.ndarray, end: np.ndarray
) -> None:
    along = np.linspace(0.0, 1.0, 2001)[:, None]
    least = np.linalg.norm(start + along * (end - start) - point, axis=1).min()
    ours = distance_to_segment(point[None], start, end)[0]
    assert ours <= least + 1e-12
    assert ours == pytest.approx(least, abs=2e-3)


def test_a_hole_stands_still_in_the_domes_frame() -> None:
    env = CoopInsertionEnv(**ARGUMENTS)
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(30):
        state = env.state
        # the tip's offset from a mouth keeps its length, and the mouth its place, in that frame
        for hole in range(6):
            mouth = PAPER_TASK.dome_radius * np.array(PAPER_TASK.hole_normals[hole])
            ours = dome_frame(env) - mouth
            world = state["tip"] - state["mouths"][hole]
            assert np.linalg.norm(ours) == pytest.approx(np.linalg.norm(world), abs=1e-12)
        if env.step(int(rng.choice(np.flatnonzero(env.action_masks()))))[2]:
            break


def test_counts_agree_with_the_environments_infos() -> None:
    episode = Episode(CoopInsertionEnv(**ARGUMENTS), 0, episode_seeds(0, 1)[0])
    rng = np.random.default_rng(1)
    infos = []
    while not episode.over:
        infos.append(episode.move(int(rng.integers(12))))
    row = episode.row()
    assert row["moves"] == len(infos)
    assert row["collisions"] == sum(info["collision"] for info in infos)
    assert row["violations"] == sum(info["violation"] for info in infos)
    assert row["energy"] == infos[-1]["energy"]
    assert row["holes"] == infos[-1]["n_filled"]
    total = sum(sum(info["reward_terms"].values()) for info in infos)
    assert row["reward"] == pytest.approx(total)


def test_an_insertion_is_measured_where_it_happens_and_each_entry_after_it_counted() -> None:
    env = CoopInsertionEnv(reward="progress")
    episode = Episode(env, 0, episode_seeds(0, 1)[0])
    start, target = dome_frame(env), int(env.state["target"])
    plan: Any = LatticeOracle().plan(env)
    track = [start]
    for move in plan.moves:
        info = episode.move(int(move))
        track.append(dome_frame(env))
    row = episode.row()
    assert row["success"]
    assert row["moves_first"] == len(plan.moves)
    assert row["time_first"] == pytest.approx(0.2 * len(plan.moves))
    assert row["alignment_error"] == pytest.approx(np.degrees(info["alignment_error"]))
    assert float(str(row["alignment_error"])) < 5.0
    hole = PAPER_TASK.dome_radius * np.array(PAPER_TASK.hole_normals[target])
    deviation = distance_to_segment(np.array(track), start, hole)
    assert row["trajectory_error"] == pytest.approx(1000 * np.sqrt(np.mean(deviation**2)))
    assert np.linalg.norm(track[-1] - hole) < 0.01
    assert row["duplicates"] == 0
    infos = [episode.move(move) for move in 3 * (4, 5)]  # out and in again
    assert episode.row()["duplicates"] == sum(info["duplicate"] for info in infos) == 3


def test_a_row_keeps_the_first_insertion_beside_the_end() -> None:
    env = CoopInsertionEnv(reward="progress", mask_singularities=False)
    episode, rng = Episode(env, 0, episode_seeds(0, 1)[0]), np.random.default_rng(0)
    oracle, infos, seconds = LatticeOracle(), list[dict[str, Any]](), list[float]()
    way = [env.configuration]
    for holes in (1, 2):
        while len(episode.insertions) < holes:  # the optimum, with random moves, some refused
            moves: Any = oracle.plan(env).moves
            infos.append(episode.move(int(rng.integers(12) if rng.random() < 0.3 else moves[0])))
            way.append(env.configuration)
        seconds.append(episode.seconds_first({}))
    infos += [episode.move(move) for move in (4, 5)]
    row = episode.row()
    first, second = (k for k, info in enumerate(infos) if info["inserted"])
    assert row["insertion_moves"] == f"{first + 1};{second + 1}"
    assert (row["holes"], row["all_holes"], row["singular"]) == (2, False, False)
    assert row["time_per_hole"] == pytest.approx(infos[second]["time"] / 2)
    angles = np.degrees([infos[k]["alignment_error"] for k in (first, second)])
    assert row["alignment_error_all"] == pytest.approx(angles.mean())
    before = sum(info["collision"] for info in infos[: first + 1])
    assert (row["collisions_first"], row["energy_first"]) == (before, infos[first]["energy"])
    assert row["collisions"] > before
    assert row["energy"] > infos[first]["energy"]
    # the joints' trajectory passes each configuration once, as a refused move leads nowhere
    assert any(info["violation"] for info in infos[: first + 1])
    there = way[: first + 2]
    met = [at for k, at in enumerate(there) if k == 0 or not np.array_equal(at, there[k - 1])]
    assert seconds == 2 * [make_trajectory(np.array(met)).duration]
    slow = {"geometry": dataclasses.replace(GEOMETRIES["optimized"], max_joint_velocity=0.3)}
    assert episode.seconds_first(slow) > seconds[0]
    assert np.isnan(episode.seconds_first({"sim_to_real": {"base_position_error": 0.003}}))
    fallen = Episode(env, 0, 0)
    assert np.isnan(fallen.seconds_first({}))  # without an insertion
    while not fallen.over:
        fallen.move(8)
    assert fallen.row()["singular"]


def test_an_episodes_environment_is_the_tracks() -> None:
    sizes = {"base_radius": 0.18, "proximal_length": 0.1, "platform_radius": 0.11}
    own: dict[str, Any] = {"mask_visited": 3, "shield": {}, "collision": "terminate"}
    rewards = {"reward_kwargs": {"step_cost": 0.5}}
    preset = smoke_preset(geometries={"mine": sizes}, track=own | rewards)
    cell = Cell("greedy", "full", "mine", "safe", 0)
    arguments = env_arguments(preset, cell, preset.tracks["safe"])
    assert {name: arguments[name] for name in own} == own
    assert arguments["reward_kwargs"]["step_cost"] == 0.5
    assert arguments["geometry"] == RRSGeometry(**sizes)
    at_once = Cell("optimum_at_once", "full", "optimized", "", 0)
    assert env_arguments(preset, at_once)["team"] == "central"


def test_initial_states_depend_on_seed_and_episode_alone() -> None:
    def starts(seed: int, reward: str) -> list[object]:
        return [each.row()["start"] for each in begin_episodes({"reward": reward}, seed, 5)]

    assert starts(0, "paper") == starts(0, "progress")
    assert not set(starts(0, "progress")) & set(starts(1, "progress"))
    assert len(set(starts(0, "progress"))) == 5


def test_no_two_streams_or_seeds_share_a_start() -> None:
    sets: list[dict[str, Any]] = [{"stream": s} for s in ("final", "test", "validate")]
    seeds = [episode_seeds(n, 50, **which) for n in (0, 1) for which in [*sets, {"starts": 7}]]
    assert len(set(itertools.chain(*seeds))) == 8 * 50


def run_policy(policy: Policy, episodes: list[Episode], noise: float) -> Rows:
    by_policy(policy, 7)(episodes, Condition({}, noise), lambda share: None)
    return [episode.row(noise) for episode in episodes]


def test_running_side_by_side_changes_nothing() -> None:
    def tilt(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        # any function of one row alone
        return np.array([int(np.flatnonzero(m)[int(1e4 * o.sum()) % m.sum()])
                         for o, m in zip(observations, masks, strict=True)])  # fmt: skip

    episodes = begin_episodes(ARGUMENTS, 0, 4)
    while not episodes[0].over:  # before the others begin: who runs stands in other rows
        episodes[0].move(8)
    together = run_policy(tilt, episodes, 0.01)[1:]
    alone = [run_policy(tilt, [each], 0.01)[0] for each in begin_episodes(ARGUMENTS, 0, 4)[1:]]
    assert [repr(row) for row in together] == [repr(row) for row in alone]


def test_noise_is_what_it_says_and_stays_in_range() -> None:
    seen: list[np.ndarray] = []

    def watch(observations: np.ndarray, masks: np.ndarray) -> np.ndarray:
        seen.append(observations)
        return np.array([int(np.flatnonzero(mask)[0]) for mask in masks])

    run_policy(watch, begin_episodes(ARGUMENTS, 0, 3), 0.0)
    clean = np.concatenate(seen)
    seen.clear()
    rows = run_policy(watch, begin_episodes(ARGUMENTS, 0, 3), 0.01)
    noisy = np.concatenate(seen)
    assert {row["noise"] for row in rows} == {0.01}
    assert noisy.shape == clean.shape
    assert noisy.dtype == clean.dtype
    assert noisy.min() >= 0.0
    assert noisy.max() <= 1.0
    inside = (clean > 0.05) & (clean < 0.95)
    assert (noisy - clean)[inside].std() == pytest.approx(0.01, rel=0.1)
    seen.clear()  # each episode and each seed has noise of its own
    by_policy(watch, 8)(begin_episodes(ARGUMENTS, 0, 3), Condition({}, 0.01), lambda share: None)
    drawn = np.vstack([noisy[:3] - clean[:3], seen[0] - clean[:3]])
    within = inside[:3].all(axis=0)
    assert np.ptp(drawn[:, within], axis=0).min() > 0.0
    assert np.abs(np.corrcoef(drawn[:, within]) - np.eye(6)).max() < 0.99


def test_each_condition_has_all_episodes_and_seconds_where_nothing_is_noisy() -> None:
    preset, report = load_preset("smoke"), list[float]()

    def plan(env: CoopInsertionEnv) -> Plan:
        return dataclasses.replace(LatticeOracle().plan(env), seconds=env.state["filled"].sum())

    player = in_turn(lambda episode: follow(episode, plan))
    both = [Condition({**ARGUMENTS, "max_moves": 60}, noise) for noise in (0.0, 0.01)]
    rows = play(player, preset, 3, both, report.append)
    assert [row["reset_seed"] for row in rows] == 2 * episode_seeds(3, 2, "validate")
    assert [row["noise"] for row in rows] == [0.0, 0.0, 0.01, 0.01]
    assert all(row["success"] for row in rows)
    assert [row["plan_seconds"] for row in rows] == 4 * [0.0]  # of the first plan
    assert [str(row["seconds_first"]) == "nan" for row in rows] == [False, False, True, True]
    assert report == [0.25, 0.5, 0.75, 1.0]
    others = play(player, preset, 3, both[:1], starts=7)
    assert [row["reset_seed"] for row in others] == episode_seeds(3, 2, starts=7)
