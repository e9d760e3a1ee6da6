"""
tianshou's and AgileRL's Rainbow as their users run them, in an interpreter that has them.

``make rivals`` builds that interpreter; :mod:`benchmarks.studies.speed.contest` starts this
module in it and drives it by one JSON line per request, ``["learn", n]`` or ``["train", n]``.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
import torch as th
from torch import nn

from benchmarks.studies.speed.setting import (
    ALPHA,
    BATCH_SIZE,
    BETA,
    GAMMA,
    LEARNING_RATE,
    N_ACTIONS,
    N_ATOMS,
    N_INPUTS,
    N_STEPS,
    NET_ARCH,
    REWARD,
    SIGMA0,
    SUPPORT,
    TAU,
    Seconds,
    StubEnv,
    random_contents,
    seconds_of,
)

WARM_UP: Final = 2 * BATCH_SIZE


class Tianshou:
    """``RainbowDQN`` with ``PrioritizedVectorReplayBuffer``, ``Collector`` and ``update``."""

    package = "tianshou"
    net = "256-128, then 64 noisy units in each of two streams; target copied at each 1000th update"

    def __init__(self, capacity: int) -> None:
        from tianshou.algorithm.modelfree.c51 import C51Policy
        from tianshou.algorithm.modelfree.rainbow import RainbowDQN
        from tianshou.algorithm.optim import AdamOptimizerFactory
        from tianshou.data import Collector, PrioritizedVectorReplayBuffer
        from tianshou.env import DummyVectorEnv
        from tianshou.utils.net.common import Net
        from tianshou.utils.net.discrete import NoisyLinear

        env = StubEnv()
        stream = {
            "hidden_sizes": NET_ARCH[-1:],
            "linear_layer": partial(NoisyLinear, noisy_std=SIGMA0),
        }
        net = Net(
            state_shape=(N_INPUTS,),
            action_shape=N_ACTIONS,
            hidden_sizes=NET_ARCH[:-1],
            softmax=True,
            num_atoms=N_ATOMS,
            dueling_param=(stream, stream),
        )
        policy = C51Policy(
            model=net,
            action_space=env.action_space,
            observation_space=env.observation_space,
            num_atoms=N_ATOMS,
            v_min=SUPPORT[0],
            v_max=SUPPORT[1],
        )
        self.algorithm = RainbowDQN(
            policy=policy,
            optim=AdamOptimizerFactory(lr=LEARNING_RATE),
            gamma=GAMMA,
            n_step_return_horizon=N_STEPS,
            target_update_freq=1000,
        )
        self.buffer = PrioritizedVectorReplayBuffer(capacity, buffer_num=1, alpha=ALPHA, beta=BETA)
        self.collector = Collector(policy, DummyVectorEnv([StubEnv]), self.buffer)
        self.collector.reset()
        self.collector.collect(n_step=WARM_UP)
        self._fill(capacity)

    def _fill(self, capacity: int) -> None:
        contents = random_contents(capacity)
        stored = self.buffer._meta
        stored.obs[:], stored.obs_next[:] = contents["obs"], contents["next_obs"]
        stored.act[:], stored.rew[:] = contents["action"], REWARD
        self.buffer.buffers[0]._size = self.buffer._lengths[0] = capacity
        self.buffer.weight[np.arange(capacity)] = contents["priority"]
        assert len(self.buffer) == capacity

    def step(self) -> None:
        """One step of the env."""
        self.collector.collect(n_step=1)

    def update(self) -> None:
        """One update."""
        from tianshou.utils.torch_utils import policy_within_training_step

        with policy_within_training_step(self.algorithm.policy):
            self.algorithm.update(self.buffer, BATCH_SIZE)


class AgileRL:
    """``RainbowDQN`` with its prioritized and its n-step memory, as ``train_off_policy`` does."""

    package = "agilerl"
    net = "256-128, then 64 noisy units in each of two streams; target moved at each update"

    def __init__(self, capacity: int) -> None:
        import gymnasium as gym
        from agilerl.algorithms.dqn_rainbow import RainbowDQN
        from agilerl.components.replay_buffer import MultiStepReplayBuffer, PrioritizedReplayBuffer

        self.env = gym.vector.SyncVectorEnv([StubEnv])
        self.agent = RainbowDQN(
            self.env.single_observation_space,
            self.env.single_action_space,
            net_config={
                "latent_dim": NET_ARCH[1],
                "encoder_config": {"hidden_size": [NET_ARCH[0]]},
                "head_config": {"hidden_size": [NET_ARCH[2]]},
            },
            batch_size=BATCH_SIZE,
            lr=LEARNING_RATE,
            learn_step=1,
            gamma=GAMMA,
            tau=TAU,
            beta=BETA,
            num_atoms=N_ATOMS,
            v_min=SUPPORT[0],
            v_max=SUPPORT[1],
            noise_std=SIGMA0,
            n_step=N_STEPS,
        )
        self.agent.set_training_mode(True)
        self.memory = PrioritizedReplayBuffer(capacity, alpha=ALPHA)
        self.n_step_memory = MultiStepReplayBuffer(capacity, n_step=N_STEPS, gamma=GAMMA)
        self.obs, _ = self.env.reset()
        for _ in range(WARM_UP):
            self.step()
        self._fill(capacity)

    def _fill(self, capacity: int) -> None:
        contents = random_contents(capacity)
        for memory in (self.memory, self.n_step_memory):
            stored = memory.storage
            for name in ("obs", "next_obs"):
                stored[name][:] = th.from_numpy(contents[name])
            stored["action"][:, 0] = th.from_numpy(contents["action"])
            stored["reward"][:] = REWARD
            memory.size = capacity
            assert memory.is_full
        every = np.arange(capacity)
        self.memory.sum_tree.update_batch(every, contents["priority"])
        self.memory.min_tree.update_batch(every, contents["priority"])

    def step(self) -> None:
        """One step of the env."""
        from agilerl.components.data import Transition, transition_to_tensordict

        action = self.agent.get_action(self.obs)
        next_obs, reward, done, _, _ = self.env.step(action)
        transition = transition_to_tensordict(
            Transition(obs=self.obs, action=action, reward=reward, next_obs=next_obs, done=done)
        )
        transition.batch_size = th.Size([1])
        oldest = self.n_step_memory.add(transition)
        if oldest is not None:
            self.memory.add(oldest)
        self.obs = next_obs

    def update(self) -> None:
        """One update."""
        experiences = self.memory.sample(BATCH_SIZE, beta=self.agent.beta)
        n_step = self.n_step_memory.sample_from_indices(experiences["idxs"])
        _, indices, priorities = self.agent.learn(experiences, n_experiences=n_step, per=True)
        self.memory.update_priorities(indices, priorities)


RIVALS: Final[dict[str, type[Tianshou] | type[AgileRL]]] = {
    "tianshou": Tianshou,
    "AgileRL": AgileRL,
}


def serve(name: str, capacity: int, answer: Callable[[Any], None]) -> None:
    """Build a rival, then time what standard input asks for."""
    np.random.seed(0)  # noqa: NPY002
    th.manual_seed(0)
    th.set_num_threads(1)
    rival = RIVALS[name](capacity)

    def learn(n: int) -> None:
        for _ in range(n):
            rival.step()
            rival.update()

    def train(n: int) -> None:
        for _ in range(n):
            rival.update()

    learn(20)
    parameters = sum(p.numel() for net in _networks(rival) for p in net.parameters())
    answer(
        {
            "version": importlib.metadata.version(rival.package),
            "net": rival.net,
            "parameters": parameters,
        }
    )
    requests = {"learn": learn, "train": train}
    for line in sys.stdin:
        request, n = json.loads(line)
        answer(Seconds(*seconds_of(partial(requests[request], n))))


def _networks(rival: Any) -> list[nn.Module]:
    return [rival.agent.actor if hasattr(rival, "agent") else rival.algorithm.policy.model]


def main() -> None:
    """Answers go to the pipe alone: what the libraries print goes to standard error."""
    pipe = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    serve(sys.argv[1], int(sys.argv[2]), lambda message: print(json.dumps(message), file=pipe))


if __name__ == "__main__":
    main()
