"""Where every random stream of the harness comes from.

One root per purpose, so that no test episode can coincide with a training or validation one, and a
test episode's initial state depends on (seed, episode) alone: it is the same for every method.
"""

from __future__ import annotations

from typing import Final

import numpy as np

_STREAMS: Final = {
    "train": 1,
    "test": 2,
    "validate": 3,
    "noise": 4,
    "planner": 5,
    "learner": 6,
    "fresh": 7,
    "data": 8,
    "final": 9,
    "explore": 10,
}


def derive(stream: str, *key: int) -> int:
    """A 31-bit seed of one stream; equal keys give equal seeds, other keys independent ones.

    Args:
        stream: a key of ``_STREAMS``, such as train, validate or final.
        key: what tells the seeds of a stream apart, such as (seed, episode).
    """
    sequence = np.random.SeedSequence((_STREAMS[stream], *key))
    return int(sequence.generate_state(1)[0] >> 1)


def episode_seeds(
    seed: int, episodes: int, stream: str = "test", starts: int | None = None
) -> list[int]:
    """The ``reset(seed=...)`` values of the test (or validation) episodes of one seed.

    With ``starts``, a whole number from 0, those of episodes that the number stands for.
    """
    if starts is not None:
        return [derive("fresh", starts, seed, episode) for episode in range(episodes)]
    return [derive(stream, seed, episode) for episode in range(episodes)]
