"""The blind cliff walk: how many updates prioritized replay saves (Schaul et al. 2016, Fig. 1).

The protocol is the paper's. The replay memory holds every transition that the ``2 ** n`` sequences
of actions meet, in random order, of which one in ``2 ** (n + 1) - 2`` is rewarded; then the learner
only updates. Both kinds of replay begin with the same network and the same memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.logger import configure

from benchmarks.protocol.seeding import derive
from benchmarks.runs.store import RunFolder
from benchmarks.studies.classic.environments.named import BlindCliffWalkEnv
from benchmarks.studies.classic.plan import Cell
from benchmarks.studies.classic.presets import CliffVariant, Preset, spelled_out
from sb3_rainbow import Rainbow

TOLERANCE: Final = 1e-3  # mean squared error of Q below which it counts as learned, the paper's
STAYS: Final = 10  # checks in a row at which the greedy policy must be right to count as solved
OPTIMIZERS: Final = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}
Transition = tuple[int, int, int, float, bool]  # state, action, next state, reward, ended


def transitions(states: int, rng: np.random.Generator) -> Iterator[Transition]:
    """Everything that the ``2 ** states`` sequences of actions meet, sequences in random order."""
    env = BlindCliffWalkEnv(states)
    sequences = np.array(list(itertools.product((0, 1), repeat=states)))
    for actions in rng.permutation(sequences):
        state = int(env.reset()[0])
        for action in actions:
            following, reward, ended, _, _ = env.step(action)
            yield state, int(action), int(following), reward, ended
            if ended:
                break
            state = int(following)


def build(variant: CliffVariant, replay: str, states: int, seed: int) -> Rainbow:
    """The learner, with its memory filled."""
    env = BlindCliffWalkEnv(states)
    arguments = spelled_out(variant.rainbow)
    policy = {**arguments.pop("policy_kwargs", {})}
    policy["optimizer_class"] = OPTIMIZERS[variant.optimizer]
    model = Rainbow(
        "MlpPolicy",
        env,
        buffer_size=2 ** (states + 1) + int(arguments.get("n_steps", 1)),
        gamma=env.gamma,
        prioritized=replay == "prioritized",
        seed=derive("learner", seed),
        device="cpu",
        policy_kwargs=policy,
        **arguments,
    )
    model.set_logger(configure(None, []))
    buffer = model.replay_buffer
    assert buffer is not None
    for state, action, following, reward, ended in transitions(states, rng_of(seed)):
        buffer.add(
            np.array([state]),
            np.array([following]),
            np.array([[action]]),
            np.array([reward]),
            np.array([ended]),
            [{}],
        )
    return model


def rng_of(seed: int) -> np.random.Generator:
    """The generator that orders the memory of a seed."""
    return np.random.default_rng(derive("train", seed))


def measure(
    variant: CliffVariant, replay: str, states: int, seed: int
) -> tuple[int | None, int | None]:
    """Updates until the Q-values are learned and until the greedy policy is right for good.

    Returns:
        Updates at the first check with a mean squared error below :data:`TOLERANCE`, and at the
        first of :data:`STAYS` checks in a row with every greedy action right; None where
        ``variant.limit`` came first. The run ends when the one the variant measures is known.
    """
    env = BlindCliffWalkEnv(states)
    right = np.array([env.right_action(state) for state in range(states)])
    truth = env.optimal_values()
    model = build(variant, replay, states, seed)
    observations, _ = model.policy.obs_to_tensor(np.arange(states))
    learned: int | None = None
    solved: int | None = None
    run_of_right = 0
    every, batch_size = variant.check_every, model.batch_size
    for updates in range(every, variant.limit + 1, every):
        model.train(every, batch_size)
        with torch.no_grad():
            values: NDArray[Any] = model.q_net(observations).numpy()
        if learned is None and np.mean((values - truth) ** 2) < TOLERANCE:
            learned = updates
        run_of_right = run_of_right + 1 if (values.argmax(axis=1) == right).all() else 0
        if solved is None and run_of_right == STAYS:
            solved = updates - (STAYS - 1) * every
        if (learned if variant.measure == "learned" else solved) is not None:
            break
    return learned, solved


def run_cliff(
    preset: Preset,
    cell: Cell,
    folder: RunFolder,
    stop_requested: Callable[[], bool] = lambda: False,
) -> dict[str, Any] | None:
    """Measure all seeds of one walk and one kind of replay; writes ``updates.csv``.

    Returns:
        What meta.json says of it, or None if it was stopped (it then starts over: it is short).
    """
    torch.set_num_threads(1)
    variant = preset.cliff[cell.task]
    rows: list[dict[str, object]] = []
    for seed in range(variant.seeds):
        if stop_requested():
            return None
        learned, solved = measure(variant, cell.method, cell.number, seed)
        rows.append({"seed": seed, "learned": learned, "solved": solved})
        note = f"seed {seed}: {learned or 'not'} learned, {solved or 'not'} solved"
        folder.write_progress((seed + 1) / variant.seeds, note)
    folder.write_rows("updates", rows)
    return {"seeds": {"learner": [derive("learner", s) for s in range(variant.seeds)]}}
