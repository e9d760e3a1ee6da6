"""tianshou's and AgileRL's Rainbow as their users run them, in an interpreter that has them.

``make rivals`` builds that interpreter; :mod:`benchmarks.studies.speed.contest` starts this
module in it and drives it by one JSON line per request, ``["learn", n]`` or ``["train", n]``.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import sys
from functools import partial
from typing import Any, Final

import numpy as np
import torch as th

from benchmarks.studies.speed import setting as at
from benchmarks.studies.speed.setting import BATCH_SIZE, StubEnv, random_contents, seconds_of

WARM_UP: Final = 2 * BATCH_SIZE
ATOMS: Final[dict[str, Any]] = {
    "num_atoms": at.N_ATOMS, "v_min": at.SUPPORT[0], "v_max": at.SUPPORT[1]
}  # fmt: skip


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

        env, noisy = StubEnv(), partial(NoisyLinear, noisy_std=at.SIGMA0)
        stream = {"hidden_sizes": at.NET_ARCH[-1:], "linear_layer": noisy}
        self.network = Net(
            state_shape=(at.N_INPUTS,),
            action_shape=at.N_ACTIONS,
            hidden_sizes=at.NET_ARCH[:-1],
            softmax=True,
            num_atoms=at.N_ATOMS,
            dueling_param=(stream, stream),
        )
        spaces = {"action_space": env.action_space, "observation_space": env.observation_space}
        policy = C51Policy(model=self.network, **spaces, **ATOMS)
        self.algorithm = RainbowDQN(
            policy=policy,
            optim=AdamOptimizerFactory(lr=at.LEARNING_RATE),
            gamma=at.GAMMA,
            n_step_return_horizon=at.N_STEPS,
            target_update_freq=1000,
        )
        priorities = {"alpha": at.ALPHA, "beta": at.BETA}
        self.buffer = PrioritizedVectorReplayBuffer(capacity, buffer_num=1, **priorities)
        self.collector = Collector(policy, DummyVectorEnv([StubEnv]), self.buffer)
        self.collector.reset()
        self.collector.collect(n_step=WARM_UP)
        contents, stored = random_contents(capacity), self.buffer._meta
        stored.obs[:], stored.obs_next[:] = contents["obs"], contents["next_obs"]
        stored.act[:], stored.rew[:] = contents["action"], at.REWARD
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
        first, latent, head = at.NET_ARCH
        self.agent = RainbowDQN(
            self.env.single_observation_space,
            self.env.single_action_space,
            net_config={
                "latent_dim": latent,
                "encoder_config": {"hidden_size": [first]},
                "head_config": {"hidden_size": [head]},
            },
            batch_size=BATCH_SIZE,
            lr=at.LEARNING_RATE,
            learn_step=1,
            gamma=at.GAMMA,
            tau=at.TAU,
            beta=at.BETA,
            noise_std=at.SIGMA0,
            n_step=at.N_STEPS,
            **ATOMS,
        )
        self.network = self.agent.actor
        self.agent.set_training_mode(True)
        self.memory = PrioritizedReplayBuffer(capacity, alpha=at.ALPHA)
        self.n_step_memory = MultiStepReplayBuffer(capacity, n_step=at.N_STEPS, gamma=at.GAMMA)
        self.obs, _ = self.env.reset()
        for _ in range(WARM_UP):
            self.step()
        contents = random_contents(capacity)
        for memory in (self.memory, self.n_step_memory):
            for name in ("obs", "next_obs"):
                memory.storage[name][:] = th.from_numpy(contents[name])
            memory.storage["action"][:, 0] = th.from_numpy(contents["action"])
            memory.storage["reward"][:] = at.REWARD
            memory.size = capacity
            assert memory.is_full
        for tree in (self.memory.sum_tree, self.memory.min_tree):
            tree.update_batch(np.arange(capacity), contents["priority"])

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


RIVALS: Final[dict[str, Any]] = {"tianshou": Tianshou, "AgileRL": AgileRL}


def main() -> None:
    """Build a rival, say what it is, then time what standard input asks for."""
    # answers go to the pipe alone: what the libraries print goes to standard error
    pipe = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)
    np.random.seed(0)  # noqa: NPY002
    th.manual_seed(0)
    th.set_num_threads(1)
    rival = RIVALS[sys.argv[1]](int(sys.argv[2]))

    def step_and_update() -> None:
        rival.step()
        rival.update()

    seconds_of(step_and_update, 20)
    parameters = sum(p.numel() for p in rival.network.parameters())
    version = importlib.metadata.version(rival.package)
    print(json.dumps({"version": version, "net": rival.net, "parameters": parameters}), file=pipe)
    requests = {"learn": step_and_update, "train": rival.update}
    for line in sys.stdin:
        request, n = json.loads(line)
        print(json.dumps([n * s for s in seconds_of(requests[request], n)]), file=pipe)


if __name__ == "__main__":
    main()
