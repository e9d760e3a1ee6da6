"""Where every random stream of the harness comes from.

One root per purpose, so that no test episode can coincide with a training or validation one, and a
test episode's initial state depends on (seed, episode) alone: it is the same for every method.
"""

from typing import Final

import numpy as np

#: a stream's number is its place, from 1
_STREAMS: Final = (
    *("train", "test", "validate", "noise", "planner"),
    *("learner", "fresh", "data", "final", "explore"),
)


def derive(stream: str, *key: int) -> int:
    """A 31-bit seed of a stream; equal keys, such as (seed, episode), give equal seeds."""
    sequence = np.random.SeedSequence((1 + _STREAMS.index(stream), *key))
    return int(sequence.generate_state(1)[0] >> 1)


def episode_seeds(
    seed: int, episodes: int, stream: str = "test", starts: int | None = None
) -> list[int]:
    """The ``reset(seed=...)`` values of one seed's episodes of a stream, or of other ``starts``."""
    if starts is not None:
        return [derive("fresh", starts, seed, episode) for episode in range(episodes)]
    return [derive(stream, seed, episode) for episode in range(episodes)]
