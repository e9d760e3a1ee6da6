"""Prioritized replay on the blind cliff walk (Schaul et al. 2016, Fig. 1): the updates it saves.

``states`` places in a row have two actions each. The right one, 0 in even states and 1 in odd ones,
leads on, and in the last state is paid 1; the wrong one ends the episode. As in the paper, the
memory holds every transition that the ``2 ** states`` sequences of actions meet, in random order,
and the learner only updates.
"""

from typing import Any

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import configure

from tests.sb3_rainbow.small import Toy, make

TOLERANCE = 1e-3  # mean squared error of Q below which it counts as learned, the paper's
CHECK_EVERY = 20
RAINBOW: dict[str, Any] = {
    **dict.fromkeys(("double_q", "dueling", "noisy", "distributional"), False),
    **{"n_steps": 1, "tau": 1.0, "batch_size": 32, "learning_rate": 1e-2},
    **{"beta_start": 0.4, "beta_end": 0.4, "policy_kwargs": {"net_arch": []}},
}


def fill(buffer: ReplayBuffer, states: int, seed: int) -> None:
    """Every step of every sequence: half of those that come to a state go on from there."""
    places = np.repeat(np.arange(states), 2 ** np.arange(states, 0, -1))
    goes_on = np.arange(places.size) % 2 == 0
    for i in np.random.default_rng((1, seed)).permutation(places.size)[:, None]:
        state, right = places[i], goes_on[i]
        last = state == states - 1
        action, following = np.where(right, state % 2, 1 - state % 2), state + (right & ~last)
        buffer.add(state, following, action, 1.0 * (right & last), last | ~right, [{}])


def optimal_values(states: int) -> np.ndarray:
    """``gamma ** (steps left after it)`` of the right action, 0 of the wrong one."""
    values, place = np.zeros((states, 2)), np.arange(states)
    values[place, place % 2] = (1.0 - 1.0 / states) ** place[::-1]
    return values


def updates_needed(states: int, limit: int, seed: int, prioritized: bool) -> int:
    """Updates at the first check within the tolerance, or ``limit``."""
    env = Toy(spaces.Discrete(states))  # nobody takes a step in it
    own: Any = {"buffer_size": 2 ** (states + 1) + 1, "gamma": 1.0 - 1.0 / states}
    model = make(env=env, seed=1_000 + seed, prioritized=prioritized, **own, **RAINBOW)
    model.set_logger(configure(None, []))
    assert model.replay_buffer is not None
    fill(model.replay_buffer, states, seed)
    truth = optimal_values(states)
    observations, _ = model.policy.obs_to_tensor(np.arange(states))
    for updates in range(CHECK_EVERY, limit, CHECK_EVERY):
        model.train(CHECK_EVERY, model.batch_size)
        with th.no_grad():
            errors = model.q_net(observations).numpy() - truth
        if np.mean(errors**2) < TOLERANCE:
            return updates
    return limit


@pytest.mark.slow
def test_prioritized_replay_learns_the_walk_in_fewer_updates() -> None:
    prioritized, uniform = (  # seeds differ threefold, and by the processor's rounding
        [updates_needed(10, 4000, seed, on) for seed in range(7)] for on in (True, False)
    )
    assert max(prioritized) < 4000
    assert np.median(uniform) > 1.3 * np.median(prioritized)
