"""Scripted controls: what they choose is the least potential, found here by trying every move."""

from __future__ import annotations

import copy
import math
from typing import Any

import numpy as np
import pytest

from benchmarks.errors import BenchmarkError
from benchmarks.evaluation.evaluate import begin_episodes, play_together
from benchmarks.methods.controls import control
from benchmarks.methods.episodes import Episode
from benchmarks.protocol.presets import Controls
from coop_env import CoopInsertionEnv, SimToReal

WEIGHTS = Controls(greedy_angle=120.0, lookahead_angle=200.0)
SAFE: dict[str, Any] = {"reward": "progress", "mask_singularities": True}
MEMORY: dict[str, Any] = {**SAFE, "mask_visited": 64}
UNSURE = SimToReal(base_position_error=0.003, base_tilt_error=math.radians(1.0))


def after(env: CoopInsertionEnv, action: int, weight: float) -> tuple[float, CoopInsertionEnv]:
    """The potential that a move leads to, as the environment itself tells it."""
    probe = copy.deepcopy(env)
    info = probe.step(action)[-1]
    if info["inserted"]:
        return -1.0, probe
    return 500.0 * info["distance"] + weight * info["alignment_error"], probe


def least(env: CoopInsertionEnv, weight: float, ahead: bool) -> list[float]:
    """The cost of every move, by making it, and with ``ahead`` every other one after it."""
    costs = [math.inf] * 12
    for action in np.flatnonzero(env.action_masks()).tolist():
        cost, probe = after(env, action, weight)
        costs[action] = 2.0 * cost if cost < 0.0 else cost
        if ahead and cost >= 0.0:
            second = [after(probe, int(a), weight)[0] for a in np.flatnonzero(probe.action_masks())]
            costs[action] = min([cost, *second])
    return costs


def choose(method: str, episode: Episode) -> int:
    chooser = control(method, WEIGHTS, 0)([episode])
    masks = episode.env.action_masks()[None]
    return int(chooser(episode.observation[None], masks, [0])[0])


def play(method: str, arguments: dict[str, Any], number: int, seed: int = 0) -> list[Episode]:
    episodes = begin_episodes(arguments, seed, number, "validate")
    play_together(control(method, Controls(), seed)(episodes), episodes, 0.0, 0)
    return episodes


@pytest.mark.parametrize("arguments", [SAFE, MEMORY, {}], ids=["safe", "memory", "paper"])
@pytest.mark.parametrize("method", ["greedy", "lookahead"])
def test_the_chosen_move_has_the_least_potential(method: str, arguments: dict[str, Any]) -> None:
    ahead = method == "lookahead"
    weight = WEIGHTS.lookahead_angle if ahead else WEIGHTS.greedy_angle
    inserted = 0
    for episode in begin_episodes(arguments, 1, 2, "validate"):
        for _ in range(30):
            costs = least(episode.env, weight, ahead)
            action = choose(method, episode)
            if arguments:  # a collision, which the paper's masks allow, ends in another place
                assert costs[action] == pytest.approx(min(costs), abs=1e-9)
            assert episode.env.action_masks()[action]
            inserted += bool(episode.move(action)["inserted"])
            if episode.over:
                break
    assert inserted or not arguments


@pytest.mark.parametrize("method", ["greedy", "lookahead"])
def test_the_observation_is_enough_without_noise(method: str) -> None:
    same = moves = 0
    for episode in begin_episodes(SAFE, 2, 6, "validate"):
        for _ in range(25):
            action = choose(method, episode)
            same += action == choose(f"{method}_observed", episode)
            moves += 1
            episode.move(action)
            if episode.over:
                break
    assert same / moves > 0.97


@pytest.mark.parametrize("method", ["greedy", "lookahead"])
def test_nobody_sees_where_the_real_machine_stands(method: str) -> None:
    arguments = {**MEMORY, "mask_refused": True, "sim_to_real": UNSURE}
    (unsure,) = begin_episodes(arguments, 3, 1, "validate")
    plain = Episode(CoopInsertionEnv(**MEMORY), 0, 0)
    options = {"configuration": unsure.env.configuration, "target": int(unsure.env.state["target"])}
    plain.env.reset(options=options)
    for _ in range(15):
        if not np.array_equal(unsure.env.action_masks(), plain.env.action_masks()):
            break  # the real machine has refused a move
        action = choose(method, plain)
        assert choose(method, unsure) == action
        inserted = [bool(each.move(action)["inserted"]) for each in (plain, unsure)]
        if any(inserted):
            break
    assert unsure.moves > 5


def test_random_draws_from_the_masks_and_from_the_seed_alone() -> None:
    one, again, other = (play("random", MEMORY, 2, seed) for seed in (0, 0, 1))
    assert one[0].row()["energy"] == again[0].row()["energy"]
    assert one[0].row()["energy"] != other[0].row()["energy"]
    assert all(e.collisions == e.violations == 0 for e in one)


def test_a_memory_is_worth_what_it_is_worth() -> None:
    """Rough bounds of the figures in the tables, on validation starts."""
    rate = {
        (name, method): np.mean([bool(e.insertions) for e in play(method, arguments, 30)])
        for name, arguments in (("safe", SAFE), ("memory", MEMORY))
        for method in ("random", "greedy", "lookahead")
    }
    assert rate["safe", "random"] == rate["memory", "random"] == 0.0
    assert rate["memory", "greedy"] >= 0.9
    assert rate["safe", "greedy"] <= 0.9
    assert rate["safe", "greedy"] < rate["memory", "greedy"]


def test_what_is_no_control_is_named() -> None:
    with pytest.raises(BenchmarkError, match="unknown control 'rainbow'"):
        control("rainbow", WEIGHTS, 0)
