"""The test protocol: every method on the same initial states, deterministic, all holes, to the end.

Learners act on all episodes of a seed at once, so that the network is asked once per move.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.methods.base import Plan
from benchmarks.methods.episodes import Episode
from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import Preset
from benchmarks.protocol.seeding import derive, episode_seeds
from coop_env.env import CoopInsertionEnv

Observations = NDArray[np.float32]
Masks = NDArray[np.bool_]
Policy = Callable[[Observations, Masks], NDArray[Any]]
Rows = list[dict[str, object]]
Tell = Callable[[float], None]  # hears which share is done


def hush(share: float) -> None:
    """Tell nobody."""


def begin_episodes(
    arguments: dict[str, Any],
    seed: int,
    number: int,
    stream: str = "test",
    starts: int | None = None,
) -> list[Episode]:
    """``number`` episodes, each in an environment of its own, on the stream's initial states."""
    seeds = episode_seeds(seed, number, stream, starts)
    return [Episode(CoopInsertionEnv(**arguments), i, s) for i, s in enumerate(seeds)]


def run_policy(
    policy: Policy, episodes: Sequence[Episode], noise: float, noise_seed: int, tell: Tell = hush
) -> Rows:
    """Run a policy on all episodes side by side until each is over.

    Args:
        policy: observations (n, size) and action masks (n, 12) to actions (n,).
        episodes: fresh episodes.
        noise: standard deviation of Gaussian noise on the normalized observations; clipped to
            [0, 1] like the observations themselves.
        noise_seed: of the noise, drawn per episode so that it is the same for every method.
        tell: hears before each move which share of the episodes is over.
    """
    generators = [np.random.default_rng((noise_seed, episode.number)) for episode in episodes]
    while running := [i for i, episode in enumerate(episodes) if not episode.over]:
        tell(1.0 - len(running) / len(episodes))
        observations = np.stack([episodes[i].observation for i in running])
        if noise > 0.0:
            size = observations.shape[1]
            drawn = np.stack([generators[i].normal(0.0, noise, size) for i in running])
            observations = np.clip(observations + drawn, 0.0, 1.0).astype(np.float32)
        masks = np.stack([episodes[i].env.action_masks() for i in running])
        for i, action in zip(running, policy(observations, masks), strict=True):
            episodes[i].move(int(action))
    return [episode.row(noise) for episode in episodes]


def model_policy(model: Any) -> Policy:
    """Greedy actions of an SB3 model; masks go to those whose ``predict`` takes them."""
    takes_masks = "action_masks" in inspect.signature(model.predict).parameters

    def act(observations: Observations, masks: Masks) -> NDArray[Any]:
        arguments = {"action_masks": masks} if takes_masks else {}
        actions, _ = model.predict(observations, deterministic=True, **arguments)
        return np.asarray(actions)

    return act


def evaluate_policy(
    policy: Policy,
    preset: Preset,
    seed: int,
    arguments: dict[str, Any],
    tell: Tell = hush,
    starts: int | None = None,
) -> Rows:
    """Rows of all test episodes of one seed, at every level of noise of the preset.

    With ``starts`` the episodes begin where that number says, not at the test episodes' starts.
    """
    rows: Rows = []
    levels = preset.evaluation.noise
    for number, noise in enumerate(levels):
        episodes = begin_episodes(arguments, seed, preset.evaluation.episodes, starts=starts)

        def tell_part(share: float, before: int = number) -> None:
            tell((before + share) / len(levels))

        rows += run_policy(policy, episodes, noise, derive("noise", seed), tell_part)
    return rows


def play_episodes(
    play: Callable[[Episode], None],
    preset: Preset,
    seed: int,
    arguments: dict[str, Any],
    tell: Tell,
    starts: int | None = None,
) -> Rows:
    """Rows of all test episodes of one seed, played one after the other.

    Without noise: planners see the true state.
    """
    episodes = begin_episodes(arguments, seed, preset.evaluation.episodes, starts=starts)
    for number, episode in enumerate(episodes, start=1):
        play(episode)
        tell(number / len(episodes))
    return [episode.row() for episode in episodes]


def planner_runner(preset: Preset, cell: Cell) -> Callable[[Episode], None]:
    """How a planner plays one episode."""
    from benchmarks.methods import rrt_connect
    from benchmarks.methods.oracle import LatticeOracle

    limits = preset.planner
    oracle = LatticeOracle(node_limit=limits.node_limit)
    if cell.method == "optimum":
        return lambda episode: follow(episode, oracle.plan)
    rrt = rrt_connect.RRTConnect(
        limits.time_limit, limits.max_iterations, 1 + derive("planner", cell.seed) % 2**30
    )
    if cell.method == "rrt_lattice":
        return lambda episode: rrt_connect.execute(episode, rrt.plan, finish=oracle.plan)
    return lambda episode: rrt_connect.execute(episode, rrt.plan)


def follow(episode: Episode, plan: Callable[[CoopInsertionEnv], Plan]) -> None:
    """Fill hole after hole by exact plans until none is left, or one has no plan."""
    while not episode.over:
        answer = plan(episode.env)
        if not episode.insertions:
            episode.plan_seconds = answer.seconds
        if answer.moves is None or not len(answer.moves):
            episode.failure = answer.status
            return
        for move in answer.moves[: episode.moves_left]:
            episode.move(int(move))
