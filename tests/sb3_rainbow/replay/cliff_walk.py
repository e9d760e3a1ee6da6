"""The blind cliff walk: how many updates prioritized replay saves (Schaul et al. 2016, Fig. 1).

The protocol is the paper's. The replay memory holds every transition that the ``2 ** n`` sequences
of actions meet, in random order, of which one in ``2 ** (n + 1) - 2`` is rewarded; then the learner
only updates. Both kinds of replay begin with the same network and the same memory.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import gymnasium as gym
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.logger import configure

from sb3_rainbow import Rainbow

TOLERANCE: Final = 1e-3  # mean squared error of Q below which it counts as learned, the paper's
OPTIMIZERS: Final = {"adam": torch.optim.Adam, "sgd": torch.optim.SGD}
Transition = tuple[int, int, int, float, bool]  # state, action, next state, reward, ended


@dataclass(frozen=True)
class Variant:
    """A learner of the walk: Rainbow's arguments, and after how many updates it is given up."""

    rainbow: dict[str, Any]
    limit: int
    optimizer: str = "adam"
    check_every: int = 20


class BlindCliffWalkEnv(gym.Env[np.int64, np.int64]):
    """The blind cliff walk of Schaul et al. (2016), section 3.1.

    ``states`` places in a row with two actions each, of which one is right: 0 in even states, 1 in
    odd ones. The right one leads on, the wrong one ends the episode with reward 0; the right one in
    the last state ends it with reward 1. A random walk is paid once in ``2 ** states`` episodes.

    Args:
        states: length of the walk.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 - as Gymnasium declares it

    def __init__(self, states: int) -> None:
        if states < 1:
            raise ValueError(f"states = {states} must be 1 or above")
        self.states = states
        self.observation_space = spaces.Discrete(states)
        self.action_space = spaces.Discrete(2)
        self._place = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.int64, dict[str, Any]]:
        """Begin at the first state."""
        super().reset(seed=seed)
        self._place = 0
        return np.int64(0), {}

    def step(self, action: np.int64) -> tuple[np.int64, float, bool, bool, dict[str, Any]]:
        """Take a step; the observation after the end is that of the state before it."""
        if int(action) != self.right_action(self._place):
            return np.int64(self._place), 0.0, True, False, {}
        ended = self._place == self.states - 1
        self._place = min(self._place + 1, self.states - 1)
        return np.int64(self._place), float(ended), ended, False, {}

    @staticmethod
    def right_action(state: int) -> int:
        """The action that leads on."""
        return state % 2

    @property
    def gamma(self) -> float:
        """The paper's discount, 1 - 1 / states."""
        return 1.0 - 1.0 / self.states

    def optimal_values(self) -> NDArray[np.float64]:
        """Q of the optimal policy in closed form, shape ``(states, 2)``.

        The right action is worth ``gamma ** (steps left after it)``, the wrong one nothing.
        """
        values = np.zeros((self.states, 2))
        for state in range(self.states):
            values[state, self.right_action(state)] = self.gamma ** (self.states - 1 - state)
        return values


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


def build(variant: Variant, replay: str, states: int, seed: int) -> Rainbow:
    """The learner, with its memory filled."""
    env = BlindCliffWalkEnv(states)
    arguments = dict(variant.rainbow)
    policy = {**arguments.pop("policy_kwargs", {})}
    policy["optimizer_class"] = OPTIMIZERS[variant.optimizer]
    model = Rainbow(
        "MlpPolicy",
        env,
        buffer_size=2 ** (states + 1) + int(arguments.get("n_steps", 1)),
        gamma=env.gamma,
        prioritized=replay == "prioritized",
        seed=1_000 + seed,
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
    return np.random.default_rng((1, seed))


def measure(variant: Variant, replay: str, states: int, seed: int) -> int | None:
    """Updates at the first check with a mean squared error below :data:`TOLERANCE`, or None."""
    model = build(variant, replay, states, seed)
    truth = BlindCliffWalkEnv(states).optimal_values()
    observations, _ = model.policy.obs_to_tensor(np.arange(states))
    for updates in range(variant.check_every, variant.limit + 1, variant.check_every):
        model.train(variant.check_every, model.batch_size)
        with torch.no_grad():
            values: NDArray[Any] = model.q_net(observations).numpy()
        if np.mean((values - truth) ** 2) < TOLERANCE:
            return updates
    return None
