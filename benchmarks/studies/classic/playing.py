"""Episodes on the public tasks: of a greedy policy, and of what plays without learning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

import gymnasium as gym
import numpy as np

from benchmarks.protocol.plan import Cell
from benchmarks.protocol.presets import CONTACT, SuitePreset, Task
from benchmarks.protocol.seeding import derive, episode_seeds
from benchmarks.runs.cell import ProgressReporter
from benchmarks.runs.experiment import StopRequested
from benchmarks.runs.store import RunFolder
from benchmarks.studies.classic.controls import Act, at_random, held, scripted
from benchmarks.studies.classic.envs import make

IN_MOVES: Final = "coop_env:CoopInsertionContactDiscrete-v0"  # for who cannot act continuously
PARALLEL: Final = 50  # episodes that a test plays side by side


def make_env(task: Task, discrete: bool = True, training: bool = False) -> gym.Env[Any, Any]:
    """One environment of a task, to be tested in or to learn in."""
    name = IN_MOVES if discrete and task.env == CONTACT else task.env
    return make(name, training, **task.env_kwargs)


def evaluate(
    act: Act, task: Task, seeds: Sequence[int], discrete: bool = True
) -> list[tuple[float, int]]:
    """Return and length of a policy's episodes, one for each ``reset(seed=...)``.

    ``discrete`` says whether actions are numbers, where the task could be played by both.
    """
    if len(seeds) > PARALLEL:
        some = evaluate(act, task, seeds[:PARALLEL], discrete)
        return some + evaluate(act, task, seeds[PARALLEL:], discrete)
    playing = [make_env(task, discrete) for _ in seeds]
    masked = playing[0].has_wrapper_attr("action_masks")
    observations = [env.reset(seed=seed)[0] for env, seed in zip(playing, seeds, strict=True)]
    returns, lengths = [0.0] * len(seeds), [0] * len(seeds)
    active = list(range(len(seeds)))
    while active:
        batch = _stack([observations[i] for i in active])
        masks: Any = None
        if masked:
            masks = np.stack([playing[i].get_wrapper_attr("action_masks")() for i in active])
        still = []
        for i, action in zip(active, act(batch, masks), strict=True):
            observations[i], reward, terminated, truncated, _ = playing[i].step(action)
            returns[i] += float(reward)
            lengths[i] += 1
            if not (terminated or truncated):
                still.append(i)
        active = still
    for env in playing:
        env.close()
    return list(zip(returns, lengths, strict=True))


def _stack(observations: Sequence[Any]) -> Any:
    """Observations of several environments as a batch."""
    if isinstance(observations[0], dict):
        return {key: np.stack([each[key] for each in observations]) for key in observations[0]}
    return np.stack(observations)


def test(act: Act, preset: SuitePreset, cell: Cell, folder: RunFolder, discrete: bool) -> None:
    """The final test, whose episodes depend on the cell's seed alone; writes ``episodes.csv``."""
    seeds = episode_seeds(cell.seed, preset.final_episodes)
    played = evaluate(act, preset.tasks[cell.track], seeds, discrete)
    rows = [
        {"episode": number, "seed": seed, "return": total, "length": length}
        for number, (seed, (total, length)) in enumerate(zip(seeds, played, strict=True))
    ]
    folder.write_rows("episodes", rows)


def run_control(
    preset: SuitePreset,
    cell: Cell,
    folder: RunFolder,
    stop_requested: StopRequested = lambda: False,
) -> dict[str, Any]:
    """Test what plays without learning on the episodes of a learner; writes ``episodes.csv``.

    The one action that is held is the best on a learner's validation episodes. Stopped is raised
    where it was asked to end.
    """
    task, seed = preset.tasks[cell.track], cell.seed
    report = ProgressReporter(folder, stop_requested)
    env: Any = make_env(task)
    n = int(env.action_space.n)
    env.close()
    about: dict[str, Any] = {}
    if cell.method == "random":
        control = at_random(n, derive("noise", seed))
    elif cell.method == "held":
        validation = episode_seeds(seed, task.eval_episodes, "validate")
        totals = []
        for action in range(n):
            played = evaluate(held(action), task, validation)
            totals.append(sum(total for total, _ in played))
            report(0.5 * (action + 1) / n, f"action {action}")
        about["action"] = int(np.argmax(totals))
        control = held(about["action"])
    else:
        control = scripted(task.env)
    report(0.5, "test")
    test(control, preset, cell, folder, discrete=True)
    return {**about, "seeds": {"first_test_episode": episode_seeds(seed, 1)[0]}}
