"""The test protocol: every method on the same initial states, deterministic, all holes, to the end.

A cell's episodes are played at each of its levels (:func:`levels`): of observation noise, of the
error of an uncertain machine, and once as the learner was trained, or with random moves.
"""

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sb3_contrib import QRDQN
from stable_baselines3 import DQN
from stable_baselines3.common.utils import set_random_seed

from benchmarks.methods.base import Chooser, Masks, Observations, Plan, Policy
from benchmarks.methods.controls import control
from benchmarks.methods.episodes import Episode, env_arguments
from benchmarks.methods.team.env import DecentralizedEnv, each_for_itself, make_env
from benchmarks.protocol.metrics import EXPLORING, FIRST, GREEDY, RANDOM_MOVES
from benchmarks.protocol.plan import CONTROLS, OPTIMUM_AT_ONCE, Cell, displaced, explores, own_error
from benchmarks.protocol.presets import Preset
from benchmarks.protocol.seeding import derive, episode_seeds
from coop_env.env import CoopInsertionEnv

Rows = list[dict[str, object]]
OnProgress = Callable[[float], None]  # called with the share that is done, 0 to 1
#: plays a list of episodes, all under the same condition
Player = Callable[[Sequence[Episode], "Condition", OnProgress], None]


@dataclass(frozen=True)
class Condition:
    """One of the conditions under which a cell's test episodes are played."""

    arguments: dict[str, Any]  # of the environments
    noise: float = 0.0  # standard deviation, of the normalized observations
    columns: dict[str, object] = field(default_factory=dict)  # of episodes.csv, beside the noise

    @property
    def exploring(self) -> bool:
        return self.columns.get("acting") == EXPLORING


def levels(preset: Preset, cell: Cell) -> list[Condition]:
    """The levels of a cell; each has all test episodes.

    A track with ``sim_to_real`` has its machine at each of the preset's errors, others each level
    of noise (no noise for who sees the true state). Last comes, where the preset asks for it, that
    of the method as it explores, without noise.
    """
    tests, track = preset.evaluation, preset.tracks[cell.track] if cell.track else None
    arguments = env_arguments(preset, cell, track)
    if track is not None and track.sim_to_real is not None:
        machine, own = track.sim_to_real, own_error(track.sim_to_real)
        result = [
            Condition(arguments | {"sim_to_real": displaced(machine, error)}, 0.0, {"error": error})
            for error in tests.errors
        ]
        main = next(each for each in result if each.columns["error"] == own)
    else:
        sees_the_state = cell.plans or cell.method in ("random", "greedy", "lookahead")
        levels_of_noise = [0.0] if sees_the_state else tests.noise
        result = [Condition(arguments, noise) for noise in levels_of_noise]
        main = result[0]
    if tests.exploring and explores(cell.method):
        return [*result, replace(main, noise=0.0, columns={**main.columns, "acting": EXPLORING})]
    return result


def evaluate_cell(
    preset: Preset,
    cell: Cell,
    progress: OnProgress = lambda share: None,
    starts: int | None = None,
    model: Any = None,
) -> Rows:
    """Rows of all test episodes of a cell, at each of its levels.

    Args:
        starts: the episodes begin where that number says, not at the preset's starts.
        model: the trained model of a learner.
    """
    player = in_turn(planner_runner(preset, cell)) if cell.plans else _player(preset, cell, model)
    acting = {"acting": GREEDY} if preset.evaluation.exploring else {}
    conditions = [replace(at, columns={**acting, **at.columns}) for at in levels(preset, cell)]
    return play(player, preset, cell.seed, conditions, progress, starts)


def play(
    player: Player, preset: Preset, seed: int, conditions: Sequence[Condition],
    progress: OnProgress = lambda share: None, starts: int | None = None,
) -> Rows:  # fmt: skip
    """Rows of a seed's test episodes, played under each condition."""
    rows: Rows = []
    tests = preset.evaluation
    for number, condition in enumerate(conditions):
        episodes = begin_episodes(condition.arguments, seed, tests.episodes, tests.stream, starts)
        player(episodes, condition, lambda s, n=number: progress((n + s) / len(conditions)))  # type: ignore[misc]
        for episode in episodes:
            seconds = math.nan if condition.noise else episode.seconds_first(condition.arguments)
            rows.append(episode.row(condition.noise) | condition.columns | {FIRST: seconds})
    return rows


def in_turn(play_one: Callable[[Episode], None]) -> Player:
    """A player that plays one episode after the other."""

    def player(episodes: Sequence[Episode], _: Condition, progress: OnProgress) -> None:
        for number, episode in enumerate(episodes, start=1):
            play_one(episode)
            progress(number / len(episodes))

    return player


def by_policy(policy: Policy, seed: int) -> Player:
    """A player that asks a policy without memory for all moves at once; ``seed``: of the noise."""

    def player(episodes: Sequence[Episode], at: Condition, progress: OnProgress) -> None:
        def choose(observations: Observations, masks: Masks, _: Sequence[int]) -> NDArray[Any]:
            return policy(observations, masks)

        play_together(choose, episodes, at.noise, derive("noise", seed), progress)

    return player


def _player(preset: Preset, cell: Cell, model: Any) -> Player:
    """A player for a control or a trained model; it explores where the condition says so."""

    def player(episodes: Sequence[Episode], at: Condition, progress: OnProgress) -> None:
        if cell.method not in CONTROLS:
            if at.exploring:  # all that the model then draws follows from the cell's seed
                set_random_seed(derive("explore", cell.seed))
                model.action_space.seed(derive("explore", cell.seed))
            policy, env = model_policy(model, not at.exploring), episodes[0].env
            if preset.tracks[cell.track].rows > 1:
                assert isinstance(env, DecentralizedEnv)
                policy = each_for_itself(policy, env)
            by_policy(policy, cell.seed)(episodes, at, progress)
            return
        choose = control(cell.method, preset.tracks[cell.track].controls, cell.seed)(episodes)
        if at.exploring:
            seeds = [derive("explore", cell.seed, each.number) for each in episodes]
            choose = with_random_moves(choose, [np.random.default_rng(seed) for seed in seeds])
        play_together(choose, episodes, at.noise, derive("noise", cell.seed), progress)

    return player


def with_random_moves(
    choose: Chooser, generators: Sequence[np.random.Generator], share: float = RANDOM_MOVES
) -> Chooser:
    """The script, a share of its moves random among the allowed; a generator for each episode."""

    def explore(observations: Observations, masks: Masks, running: Sequence[int]) -> NDArray[Any]:
        actions = np.array(choose(observations, masks, running))
        for row, i in enumerate(running):
            if generators[i].random() < share:
                actions[row] = generators[i].choice(np.flatnonzero(masks[row]))
        return actions

    return explore


def begin_episodes(
    arguments: dict[str, Any],
    seed: int,
    number: int,
    stream: str = "test",
    starts: int | None = None,
) -> list[Episode]:
    """``number`` episodes, each in an environment of its own, on the stream's initial states."""
    seeds = episode_seeds(seed, number, stream, starts)
    return [Episode(make_env(**arguments), i, s) for i, s in enumerate(seeds)]


def play_together(
    choose: Chooser,
    episodes: Sequence[Episode],
    noise: float,
    noise_seed: int,
    progress: OnProgress = lambda share: None,
) -> None:
    """Play all episodes side by side until each is over, with one call of ``choose`` per move.

    Gaussian ``noise`` (standard deviation) is added to the normalized observations, which are
    clipped to [0, 1]. It is drawn per episode, so that it is the same for every method.
    """
    generators = [np.random.default_rng((noise_seed, episode.number)) for episode in episodes]
    while running := [i for i, episode in enumerate(episodes) if not episode.over]:
        progress(1.0 - len(running) / len(episodes))
        observations = np.stack([episodes[i].observation for i in running])
        if noise > 0.0:
            size = observations.shape[1]
            drawn = np.stack([generators[i].normal(0.0, noise, size) for i in running])
            observations = np.clip(observations + drawn, 0.0, 1.0).astype(np.float32)
        masks = np.stack([episodes[i].env.action_masks() for i in running])
        for i, action in zip(running, choose(observations, masks, running), strict=True):
            episodes[i].move(int(action))


def model_policy(model: Any, deterministic: bool = True) -> Policy:
    """Actions of an SB3 model, greedy or as in training, with masks if its ``predict`` has them."""
    takes_masks = "action_masks" in inspect.signature(model.predict).parameters

    def act(observations: Observations, masks: Masks) -> NDArray[Any]:
        arguments = {"action_masks": masks} if takes_masks else {}
        actions, _ = model.predict(observations, deterministic=deterministic, **arguments)
        return np.asarray(actions)

    def act_one_by_one(observations: Observations, masks: Masks) -> NDArray[Any]:
        rows = [act(observations[i : i + 1], masks[i : i + 1]) for i in range(len(observations))]
        return np.concatenate(rows)

    # these draw once for a whole batch, but each episode is to explore for itself
    shares_a_coin = isinstance(model, DQN | QRDQN) and not deterministic
    return act_one_by_one if shares_a_coin else act


def planner_runner(preset: Preset, cell: Cell) -> Callable[[Episode], None]:
    """How a planner plays one episode."""
    from benchmarks.methods import replanning, rrt_connect
    from benchmarks.methods.oracle import LatticeOracle

    limits = preset.planner
    if cell.method in ("nominal_plan", "plan_search"):
        return replanning.Replanner(cell.method == "plan_search", limits.node_limit).play
    uncertain = bool(cell.track) and preset.tracks[cell.track].sim_to_real is not None
    at_once = cell.method == OPTIMUM_AT_ONCE
    oracle = LatticeOracle(node_limit=limits.node_limit, real=uncertain, at_once=at_once)
    if cell.method == "optimum" or at_once:
        return lambda episode: follow(episode, oracle.plan)
    rrt = rrt_connect.RRTConnect(limits, 1 + derive("planner", cell.seed) % 2**30)
    if cell.method == "rrt_lattice":
        return lambda episode: rrt_connect.execute(episode, rrt.plan, finish=oracle.plan)
    return lambda episode: rrt_connect.execute(episode, rrt.plan, again=uncertain)


def follow(episode: Episode, plan: Callable[[CoopInsertionEnv], Plan]) -> None:
    """Fill hole after hole by plans until the episode is over, or one has no moves."""
    while not episode.over:
        answer = plan(episode.env)
        if not episode.insertions:
            episode.plan_seconds = answer.seconds
        if answer.moves is None or not len(answer.moves):
            episode.failure = answer.status
            return
        for move in answer.moves:
            if not episode.over:
                episode.move(int(move))
