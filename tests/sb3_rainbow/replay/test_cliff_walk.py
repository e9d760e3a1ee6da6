"""Prioritized replay on the blind cliff walk (Schaul et al. 2016, Fig. 1): the updates it saves.

``states`` places in a row have two actions each. The right one, 0 in even states and 1 in odd ones,
leads on, and in the last state is paid 1; the wrong one ends the episode. As in the paper, the
memory holds every transition that the ``2 ** states`` sequences of actions meet, in random order,
and the learner only updates.
"""

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.logger import configure

from sb3_rainbow import Rainbow
from tests.sb3_rainbow.small import Toy

TOLERANCE = 1e-3  # mean squared error of Q below which it counts as learned, the paper's
CHECK_EVERY = 20
RAINBOW: dict[str, Any] = {
    **dict.fromkeys(("double_q", "dueling", "noisy", "distributional"), False),
    **{"n_steps": 1, "tau": 1.0, "batch_size": 32, "learning_rate": 1e-2},
    **{"beta_start": 0.4, "beta_end": 0.4},
}


def transitions(states: int, seed: int) -> Iterator[tuple[int, int, int, float, bool]]:
    """State, action, next state, reward and end of every step of every sequence."""
    sequences = np.array(list(itertools.product((0, 1), repeat=states)))
    for actions in np.random.default_rng((1, seed)).permutation(sequences):
        for state, action in enumerate(actions.tolist()):
            right, last = action == state % 2, state == states - 1
            ended = last or not right
            yield state, action, min(state + right, states - 1), float(right and last), ended
            if ended:
                break


def optimal_values(states: int) -> np.ndarray:
    """``gamma ** (steps left after it)`` of the right action, 0 of the wrong one."""
    values, gamma = np.zeros((states, 2)), 1.0 - 1.0 / states
    for state in range(states):
        values[state, state % 2] = gamma ** (states - 1 - state)
    return values


def updates_needed(states: int, limit: int, seed: int, prioritized: bool) -> int:
    """Updates at the first check within the tolerance, or ``limit``."""
    model = Rainbow(
        "MlpPolicy",
        Toy(spaces.Discrete(states)),  # nobody takes a step in it
        buffer_size=2 ** (states + 1) + 1,
        gamma=1.0 - 1.0 / states,
        seed=1_000 + seed,
        device="cpu",
        policy_kwargs={"net_arch": []},
        prioritized=prioritized,
        **RAINBOW,
    )
    model.set_logger(configure(None, []))
    assert model.replay_buffer is not None
    for transition in transitions(states, seed):
        state, action, following, reward, ended = (np.array([value]) for value in transition)
        model.replay_buffer.add(state, following, action, reward, ended, [{}])
    truth = optimal_values(states)
    observations, _ = model.policy.obs_to_tensor(np.arange(states))
    for updates in range(CHECK_EVERY, limit, CHECK_EVERY):
        model.train(CHECK_EVERY, model.batch_size)
        with th.no_grad():
            errors = model.q_net(observations).numpy() - truth
        if np.mean(errors**2) < TOLERANCE:
            return updates
    return limit


def test_prioritized_replay_learns_the_walk_in_fewer_updates() -> None:
    prioritized, uniform = (
        [updates_needed(10, 4000, seed, on) for seed in range(3)] for on in (True, False)
    )
    assert max(prioritized) < 4000
    assert np.median(uniform) > 1.3 * np.median(prioritized)
