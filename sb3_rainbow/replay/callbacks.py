"""Prioritized replay for algorithms that know nothing of it."""

import numpy as np
import torch as th
from stable_baselines3 import DQN
from stable_baselines3.common.callbacks import BaseCallback

from sb3_rainbow.replay.buffers import PrioritizedReplayBuffer


class PrioritizedReplayCallback(BaseCallback):
    """Feed the priorities of a ``PrioritizedReplayBuffer`` under SB3's own ``DQN``.

    DQN does not report its errors to the buffer. Before each rollout this callback computes the
    absolute TD errors of the last batch afresh and writes them back. DQN's loss cannot be weighted
    from outside, so that the importance-sampling correction stays out: keep ``alpha`` moderate, or
    use :class:`~sb3_rainbow.Rainbow`.
    """

    model: DQN

    def _on_training_start(self) -> None:
        buffer = getattr(self.model, "replay_buffer", None)
        if not (isinstance(self.model, DQN) and isinstance(buffer, PrioritizedReplayBuffer)):
            raise ValueError(
                "PrioritizedReplayCallback needs SB3's DQN with "
                "replay_buffer_class=PrioritizedReplayBuffer, "
                f"got {type(self.model).__name__} with {type(buffer).__name__}"
            )

    def _on_rollout_start(self) -> None:
        buffer = self.model.replay_buffer
        assert isinstance(buffer, PrioritizedReplayBuffer)
        indices = buffer.last_indices
        if indices is None:
            return
        # the batch may be of an earlier training, and a part of it overwritten in between
        indices = indices[buffer.tree.leaves[indices] > 0.0]
        samples = buffer.samples_at(indices, self.model.get_vec_normalize_env())
        with th.no_grad():
            next_values = self.model.q_net_target(samples.next_observations).amax(1, keepdim=True)
            target = samples.rewards + (1.0 - samples.dones) * samples.discounts * next_values
            predicted = self.model.q_net(samples.observations).gather(1, samples.actions)
            errors = (predicted - target).abs().squeeze(1)
        buffer.update_priorities(indices, errors.cpu().numpy().astype(np.float64))
        buffer.last_indices = None

    def _on_step(self) -> bool:
        return True
