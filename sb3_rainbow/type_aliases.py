"""Types that the modules of this package exchange."""

import io
import pathlib
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
import torch as th
from numpy.typing import NDArray
from stable_baselines3.common.type_aliases import TensorDict

ObsArray: TypeAlias = NDArray | dict[str, NDArray]
NoisyLayers = Literal["last_two", "head", "all"]
# what the head of a network predicts: True is "categorical", False the Q-values themselves
Distributional = bool | Literal["categorical", "quantile"]
# sizes of the hidden layers, or of those that all streams share and those of each stream
NetArch = list[int] | dict[str, list[int]]
UseMasking = Literal["auto"] | bool
# where SB3 saves to and loads from
SaveFile = str | pathlib.Path | io.BufferedIOBase


class PrioritizedReplayBufferSamples(NamedTuple):
    """A batch of n-step transitions. B: batch size.

    The first six fields are those of SB3's ``ReplayBufferSamples``.

    Args:
        observations: at t, shape ``(B, ...)``, or a dict of such.
        actions: at t, shape ``(B, 1)``, int64.
        next_observations: at t + k, k <= n the number of rewards summed.
        dones: 1 where the episode terminated at t + k (a truncation is no end), ``(B, 1)``.
        rewards: discounted sum of the k rewards, ``(B, 1)``.
        discounts: gamma^k, each sample's own, ``(B, 1)``.
        weights: importance-sampling weights over their batch maximum, ``(B,)``.
        indices: leaves of the sum tree, for ``update_priorities``, ``(B,)``; none in an update from
            one of SB3's buffers.
        next_action_masks: allowed actions at t + k, ``(B, n_actions)``, None without masks.
    """

    observations: th.Tensor | TensorDict
    actions: th.Tensor
    next_observations: th.Tensor | TensorDict
    dones: th.Tensor
    rewards: th.Tensor
    discounts: th.Tensor
    weights: th.Tensor
    indices: NDArray[np.int64]
    next_action_masks: th.Tensor | None = None


# What an update learns from, whatever buffer it came from
Batch: TypeAlias = PrioritizedReplayBufferSamples
