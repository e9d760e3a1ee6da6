"""The levels of a cell: noise, errors of an uncertain machine, and ways of acting."""

import dataclasses
import math
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks.evaluation import evaluate
from benchmarks.evaluation.evaluate import evaluate_cell, follow, levels, with_random_moves
from benchmarks.methods import rrt_connect
from benchmarks.methods.learners import build_model, make_training_env
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.methods.replanning import Replanner
from benchmarks.protocol.plan import Cell, displaced
from benchmarks.protocol.presets import Preset, load_preset
from benchmarks.protocol.seeding import episode_seeds
from benchmarks.runs.store import Store
from benchmarks.studies.scoring.scores import FRESH_EPISODES, Replay
from coop_env import SimToReal


@pytest.fixture(scope="module")
def preset() -> Preset:
    """The paper's, small."""
    whole = load_preset("cut")
    small: dict[str, Any] = {"buffer_size": 1000, "n_envs": 2, "net_arch": [16, 16]}
    tracks = {}
    for name, track in whole.tracks.items():
        h = dataclasses.replace(track.hyperparameters, **small)
        tracks[name] = dataclasses.replace(track, hyperparameters=h)
    tests = dataclasses.replace(
        whole.evaluation, episodes=2, noise=[0.0, 0.01], errors=[0.0, 3.0], stream="validate"
    )
    return dataclasses.replace(whole, tracks=tracks, evaluation=tests)


def cell(method: str, track: str) -> Cell:
    return Cell(method, "full", "optimized", track, 0)


def exploring(preset: Preset) -> Preset:
    """The preset whose methods are tested once more as they explore."""
    tests = dataclasses.replace(preset.evaluation, exploring=True)
    return dataclasses.replace(preset, evaluation=tests)


@pytest.mark.parametrize(
    ("method", "track", "noise", "explores"),
    [
        ("rainbow", "printed", [0.0, 0.01], True),
        ("dqn", "safe", [0.0, 0.01], True),
        ("greedy_observed", "safe", [0.0, 0.01], True),
        ("lookahead", "safe", [0.0], True),
        ("greedy", "safe", [0.0], True),
        ("random", "memory", [0.0], False),
        ("optimum", "", [0.0], False),
    ],
)
def test_who_sees_the_state_has_no_noise_and_who_has_two_ways_is_played_in_both(
    method: str, track: str, noise: list[float], explores: bool, preset: Preset
) -> None:
    wanted: list[Any] = [(level, {}, False) for level in noise]
    more = explores * [(0.0, {"acting": "exploring"}, True)]
    for asked, expected in ((preset, wanted), (exploring(preset), wanted + more)):
        result = levels(asked, cell(method, track))
        assert [(each.noise, each.columns, each.exploring) for each in result] == expected


@pytest.mark.parametrize("method", ["rainbow", "dqn", "maskable_ppo", "greedy"])
def test_rows_say_how_they_were_played_and_exploring_repeats(method: str, preset: Preset) -> None:
    both, mine = exploring(preset), cell(method, "uncertain")
    learns = method != "greedy"
    model = build_model(both, mine, make_training_env(both, mine)) if learns else None
    if method == "dqn":
        model.exploration_rate = 0.5  # type: ignore[union-attr]
    report: list[float] = []
    one, two = (evaluate_cell(both, mine, report.append, model=model) for _ in range(2))
    for rows in (one, two):
        for row in rows:
            row.pop("plan_seconds")
    assert str(one) == str(two)
    assert len({tuple(row) for row in one}) == 1  # one header for the file of them all
    played = [(row["error"], row["acting"], row["episode"]) for row in one]
    ways = [(0.0, "greedy"), (3.0, "greedy"), (3.0, "exploring")]
    assert played == [(*way, episode) for way in ways for episode in range(2)]
    assert [row["energy"] for row in one[2:4]] != [row["energy"] for row in one[4:]]
    assert 0.0 <= report[0] <= report[-1] <= 1.0
    first = report[: len(report) // 2]
    assert first == sorted(first)


def test_all_see_the_seeds_own_noise(preset: Preset, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[np.ndarray] = []

    def still(observations: np.ndarray, *_: object) -> np.ndarray:
        seen.append(observations)
        return np.zeros(len(observations), np.int64)

    monkeypatch.setattr(evaluate, "control", lambda _, __, seed: {1: lambda episodes: still}[seed])
    model = SimpleNamespace(predict=lambda rows, deterministic: (still(rows), None))
    for method in ("greedy_observed", "dqn"):
        mine = dataclasses.replace(cell(method, "safe"), seed=1)
        rows = evaluate_cell(preset, mine, starts=7, model=model)
        assert [row["reset_seed"] for row in rows] == 2 * episode_seeds(1, 2, starts=7)
    assert np.ptp(np.split(np.concatenate(seen), 2), axis=0).max() == 0.0  # script and model


def test_a_planner_plays_as_one_that_is_built_by_hand(preset: Preset) -> None:
    players: list[tuple[str, str, Any]] = [
        ("nominal_plan", "uncertain", Replanner(False, 10**6).play),
        ("plan_search", "uncertain", Replanner(True, 10**6).play),
        ("optimum", "uncertain", partial(follow, plan=LatticeOracle(real=True).plan)),
        ("optimum_at_once", "", partial(follow, plan=LatticeOracle(at_once=True).plan)),
    ]
    for method, track, own in players:
        mine, player = cell(method, track), evaluate.in_turn(own)
        both = evaluate_cell(preset, mine), evaluate.play(player, preset, 0, levels(preset, mine))
        rows, expected = ([str({**row, "plan_seconds": 0.0}) for row in each] for each in both)
        assert rows == expected, method


def test_rrt_has_its_cells_rules(preset: Preset, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[int, bool, bool]] = []

    def execute(_: object, plan: int, finish: object = None, again: bool = False) -> None:
        calls.append((plan, finish is not None, again))

    monkeypatch.setattr(rrt_connect, "RRTConnect", lambda _, seed: SimpleNamespace(plan=seed))
    monkeypatch.setattr(rrt_connect, "execute", execute)
    for method, track in (("rrt_lattice", ""), ("rrt_connect", "uncertain"), ("rrt_connect", "")):
        for seed in (0, 1):
            evaluate_cell(preset, dataclasses.replace(cell(method, track), seed=seed))
    rules = list(dict.fromkeys(call[1:] for call in calls))
    assert rules == [(True, False), (False, True), (False, False)]
    assert len({call[0] for call in calls}) == 2  # a seed of each run's own


def test_rainbow_explores_by_its_noise_but_where_a_track_says_otherwise(preset: Preset) -> None:
    safe = dataclasses.replace(
        preset.tracks["safe"], methods={"rainbow": {"exploration_initial_eps": 0.3}}
    )
    own = dataclasses.replace(preset, tracks={**preset.tracks, "safe": safe})
    for each, first in ((preset, 0.0), (own, 0.3)):
        mine = cell("rainbow", "safe")
        model: Any = build_model(each, mine, make_training_env(each, mine))
        assert (model.exploration_initial_eps, model.exploration_final_eps) == (first, 0.0)


def test_a_script_that_explores_makes_one_move_of_twenty_at_random() -> None:
    masks = np.zeros((200, 12), np.bool_)
    masks[:, 3:5] = True
    generators = [np.random.default_rng(number) for number in range(200)]
    choose = with_random_moves(lambda o, m, i: np.full(200, 3), generators)
    moves = np.array(
        [choose(np.empty((200, 12), np.float32), masks, range(200)) for _ in range(50)]
    )
    assert set(np.unique(moves)) == {3, 4}
    assert np.mean(moves == 4) == pytest.approx(0.025, abs=0.004)

    def last(running: list[int]) -> list[int]:
        """Moves of the last of these episodes, whichever others are still running."""
        choose = with_random_moves(
            lambda o, m, i: np.full(len(i), 3), [np.random.default_rng(n) for n in range(2)]
        )
        seen = np.empty((len(running), 12), np.float32)
        return [int(choose(seen, masks[: len(running)], running)[-1]) for _ in range(200)]

    assert last([1]) == last([0, 1])
    assert last([1]) != last([0])


@pytest.mark.parametrize("method", ["rainbow", "maskable_ppo", "greedy", "plan_search", "optimum"])
def test_on_an_uncertain_machine_all_play_at_each_error(method: str, preset: Preset) -> None:
    result = levels(preset, cell(method, "uncertain"))
    assert [level.columns for level in result] == [{"error": 0.0}, {"error": 3.0}]
    none, own = (level.arguments["sim_to_real"] for level in result)
    assert none == SimToReal(observation_noise=0.01, joint_resolution=math.radians(0.1))
    track: Any = preset.tracks["uncertain"].sim_to_real
    assert dataclasses.asdict(own) == pytest.approx({**dataclasses.asdict(own), **track})
    if method not in ("plan_search", "optimum"):  # who explores does so at the track's own error
        more = {"error": 3.0, "acting": "exploring"}
        assert levels(exploring(preset), cell(method, "uncertain"))[-1].columns == more


def test_the_tilt_grows_with_the_displacement() -> None:
    machine = {"base_position_error": 0.003, "base_tilt_error": math.radians(1.0)}
    far = displaced(machine, 6.0)
    assert far.base_position_error == pytest.approx(0.006)
    assert far.base_tilt_error == pytest.approx(math.radians(2.0))


def test_training_draws_machines_unless_it_is_nominal(preset: Preset) -> None:
    spread = {}
    for track in ("uncertain", "uncertain_nominal"):
        env = make_training_env(preset, cell("rainbow", track))
        bases = []
        for _ in range(3):
            env.reset()
            bases += [state["machine"]["base"].copy() for state in env.get_attr("state")]
        spread[track] = np.ptp(bases, axis=0)
        masks = env.get_attr("params")[0].task
        assert (masks.visited, masks.refused, masks.mask_singularities) == (64, True, True)
    assert spread["uncertain"].min() > 0.0
    assert spread["uncertain_nominal"].max() == 0.0


@pytest.mark.parametrize(
    ("method", "track", "result"),
    [
        ("rainbow", "safe", [{}]),
        ("greedy_observed", "safe", [{}]),
        ("greedy", "uncertain", [{"error": 3.0}]),
        ("rainbow", "uncertain_nominal", [{"error": 3.0}]),
        ("optimum", "", [{}]),
    ],
)
def test_other_starts_are_played_as_the_headline_has_them(
    method: str, track: str, result: list[dict[str, object]], tmp_path: Path
) -> None:
    Store.open(tmp_path, "cut", create=True)
    fresh, mine = Replay("cut", tmp_path, None, 7), cell(method, track)
    preset = fresh.shortened(mine)
    assert preset.evaluation.episodes == FRESH_EPISODES
    played = levels(preset, mine)
    assert [level.columns for level in played] == result
    assert all(level.noise == 0.0 for level in played)
    # the same machine as in the stored episodes, to the bit
    whole = [level.arguments for level in levels(fresh.preset, mine)]
    assert all(level.arguments in whole for level in played)
