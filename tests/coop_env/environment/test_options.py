"""The environment's options: both checkers accept their combinations, and what each does."""

import itertools
import math
import random
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check

from benchmarks.methods.oracle import LatticeOracle
from coop_env import CoopInsertionEnv, SimToReal
from coop_env.simulation.observation import PAPER_FIELDS, markov_fields
from tests.coop_env.moves import MOVES

CHOICES: dict[str, tuple[Any, ...]] = {
    "geometry": ("initial", "optimized"),
    "reward": ("paper", "progress"),
    "observation": ("paper", "markov"),
    "normalize": (True, False),
    "mask_singularities": (False, True),
    "mask_visited": (0, 64),
    "mask_refused": (False, True),
    "stage": (0, 1),
    "pose_model": ("exact", "paper"),
    "sim_to_real": (None, "randomized"),
}
OF_SINGLE_MOVES = ("mask_visited", "mask_refused", "sim_to_real")
# the contact tasks have arguments of their own, and their tests stand beside them
IDS = [
    name
    for name, spec in gym.registry.items()
    if str(spec.entry_point).startswith(("coop_env.env", "coop_env.team"))
]


@pytest.mark.parametrize("env_id", IDS)
def test_checkers_accept_96_combinations_with_every_triple_of_values(env_id: str) -> None:
    values = [
        choices[:1] if "Joint" in env_id and name in OF_SINGLE_MOVES else choices
        for name, choices in CHOICES.items()
    ]
    every = list(itertools.product(*values))
    drawn = random.Random(0).sample(every, 96)
    for three in itertools.combinations(range(len(CHOICES)), 3):
        seen = {tuple(combination[i] for i in three) for combination in drawn}
        assert seen == set(itertools.product(*(values[i] for i in three)))
    for combination in drawn:
        env = gym.make(env_id, **dict(zip(CHOICES, combination, strict=True))).unwrapped
        gymnasium_check(env, skip_render_check=True)
        sb3_check(env, skip_render_check=True)


def test_markov_appends_filled_holes_and_time() -> None:
    paper = CoopInsertionEnv(normalize=False)
    markov = CoopInsertionEnv(normalize=False, observation="markov")
    options = {"filled": [1, 4], "target": 2}
    short, _ = paper.reset(seed=5, options=options)
    long, _ = markov.reset(seed=5, options=options)
    assert short.shape == (len(PAPER_FIELDS),)
    assert long.shape == (len(markov_fields(6)),)
    assert long[:12].tolist() == short.tolist()
    assert long[12:].tolist() == [0, 1, 0, 0, 1, 0, 0]
    action = int(np.flatnonzero(markov.action_masks())[0])
    assert markov.step(action)[0][-1] == pytest.approx(0.2)


def test_normalized_and_plain_observations_say_the_same() -> None:
    plain, normal = CoopInsertionEnv(normalize=False), CoopInsertionEnv()
    for seed in range(20):
        si, _ = plain.reset(seed=seed)
        unit, _ = normal.reset(seed=seed)
        assert plain.observation_space.contains(si)
        space = plain.observation_space
        low, high = space.low.copy(), space.high.copy()
        low[6:9], high[6:9] = -0.15, 0.15
        expected = np.clip((si - low) / (high - low), 0.0, 1.0)
        np.testing.assert_allclose(unit, expected, atol=1e-6)
        state = plain.state
        target = state["target"]
        np.testing.assert_allclose(si[:6], state["configuration"], atol=1e-7)
        np.testing.assert_allclose(si[6:9], state["mouths"][target] - state["tip"], atol=1e-7)
        np.testing.assert_allclose(si[9:12], state["normals"][target], atol=1e-7)


@pytest.mark.parametrize(
    ("geometry", "safe"), [("initial", False), ("optimized", False), ("initial", True)]
)
def test_masks_equal_a_check_of_each_neighbour(geometry: str, safe: bool) -> None:
    """Safe ones exclude collisions and singular moves too."""
    env = CoopInsertionEnv(geometry=geometry, mask_singularities=safe, max_moves=10_000)
    rng = np.random.default_rng(0)
    towards_trouble = np.ones(12)
    towards_trouble[[5, 6, 8]] = 6.0  # down, and to one side
    env.reset(seed=0)
    hidden = 0
    for _ in range(1000):
        ways = env.configuration + MOVES * env.task.steps
        status = np.array([env.configuration_status(way) for way in ways])
        expected = status == 0 if safe else status != 1
        masks = env.action_masks()
        assert masks.tolist() == (expected if expected.any() else ~expected).tolist()
        hidden += (~masks & (status > 1)).sum()
        weights = masks * towards_trouble
        _, _, terminated, truncated, info = env.step(rng.choice(12, p=weights / weights.sum()))
        assert not (safe and info["violation"])
        if terminated or truncated:
            env.reset()
    assert (hidden > 20) == safe


def test_pose_models_differ_where_the_platform_is_tilted() -> None:
    exact, paper = (CoopInsertionEnv(pose_model=model) for model in ("exact", "paper"))
    for env in (exact, paper):
        env.reset(options={"configuration": (0.0, 0.0, -0.3, 0.3, 0.3, 0.22)})
    difference = np.linalg.norm(exact.state["mouths"] - paper.state["mouths"], axis=1)
    assert 0.001 < difference.max() < 0.03


@pytest.mark.parametrize(("visited", "safe"), [(1, True), (5, False), (64, True)])
def test_mask_visited_excludes_the_last_configurations(visited: int, safe: bool) -> None:
    """Against a list of the configurations since the last insertion, kept here."""
    env = CoopInsertionEnv(mask_visited=visited, mask_singularities=safe)
    free = CoopInsertionEnv(mask_singularities=safe)
    rng = np.random.default_rng(visited)
    hidden = insertions = 0
    for episode in range(12):
        env.reset(seed=episode)
        free.reset(seed=episode)
        plan = LatticeOracle().plan(env).moves if episode % 2 else None
        way = [] if plan is None else plan.tolist()  # to the hole, so that there are insertions
        past: list[tuple[int, ...]] = []
        for _ in range(200):
            allowed, masks = free.action_masks(), env.action_masks()
            here = env.state["offset"]
            back = np.array([tuple(there) in past[-visited:] for there in here + MOVES])
            expected = allowed & ~back if (allowed & ~back).any() else allowed
            assert masks.tolist() == expected.tolist()
            hidden += int((allowed & back).sum())
            action = way.pop(0) if way else int(rng.choice(np.flatnonzero(masks)))
            *_, terminated, truncated, info = env.step(action)
            free.step(action)
            if info["inserted"]:
                past, insertions = [], insertions + 1
            elif tuple(env.state["offset"]) != tuple(here):
                past.append(tuple(here))
            if terminated or truncated:
                break
    assert hidden > 50
    assert insertions > 2


MACHINE = SimToReal(base_position_error=0.01, base_tilt_error=math.radians(3.0))
DISPLACED: dict[str, Any] = {"sim_to_real": MACHINE, "mask_singularities": True}


def descend(env: CoopInsertionEnv, rng: np.random.Generator) -> int:
    """An allowed move at random, down more often than not, where collisions are."""
    weights = env.action_masks() * np.where(np.arange(12) == 5, 8.0, 1.0)
    return int(rng.choice(12, p=weights / weights.sum()))


@pytest.mark.parametrize("visited", [0, 64])
def test_the_mask_is_the_models_less_what_was_refused_here(visited: int) -> None:
    """Against an environment without the option that makes the same moves."""
    env = CoopInsertionEnv(mask_refused=True, mask_visited=visited, **DISPLACED)
    free = CoopInsertionEnv(**DISPLACED)
    rng = np.random.default_rng(1)
    refusals = 0
    for episode in range(8):
        env.reset(seed=episode)
        free.reset(seed=episode)
        refused = np.zeros(12, bool)
        over = False
        while not over:
            left = free.action_masks() & ~refused
            if not left.any():
                left, refused = free.action_masks(), np.zeros(12, bool)
            mask = env.action_masks()
            assert np.array_equal(mask, left) if visited == 0 else np.all(mask <= left)
            assert mask.any()
            action = descend(env, rng)
            *_, terminated, truncated, info = env.step(action)
            free.step(action)
            over = terminated or truncated
            if info["violation"]:
                refused[action] = True
                refusals += 1
            else:
                refused[:] = False
    assert refusals > 50


def test_when_everything_valid_was_refused_it_is_allowed_again() -> None:
    env = CoopInsertionEnv(mask_refused=True, **DISPLACED)
    env.reset(seed=0)
    snapshot, valid = env.get_state(), env.action_masks()
    rng = np.random.default_rng(0)
    while not env.step(descend(env, rng))[-1]["collision"]:
        snapshot, valid = env.get_state(), env.action_masks()
    action = int(np.flatnonzero(valid & ~env.action_masks())[0])
    # as if all others had been refused before
    snapshot["states"]["refused"] = valid
    snapshot["states"]["refused"][0, action] = 0
    env.set_state(snapshot)
    assert env.step(action)[-1]["collision"]
    assert np.array_equal(env.action_masks(), valid)
