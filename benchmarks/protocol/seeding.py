"""Where every random stream of the harness comes from.

One root per purpose, so that no test episode can coincide with a training or validation one, and a
test episode's initial state depends on (seed, episode) alone: it is the same for every method.
"""

from functools import lru_cache
from typing import Final

import numpy as np

_STREAMS: Final = {
    **{"train": 1, "test": 2, "validate": 3, "noise": 4, "planner": 5},
    **{"learner": 6, "fresh": 7, "data": 8, "final": 9, "explore": 10},
}


@lru_cache(maxsize=100_000)  # every run of a seed is held against the same episodes
def derive(stream: str, *key: int) -> int:
    """A 31-bit seed of a stream; equal keys, such as (seed, episode), give equal seeds."""
    sequence = np.random.SeedSequence((_STREAMS[stream], *key))
    return int(sequence.generate_state(1)[0] >> 1)


def episode_seeds(
    seed: int, episodes: int, stream: str = "test", starts: int | None = None
) -> list[int]:
    """The ``reset(seed=...)`` values of one seed's episodes of a stream, or of other ``starts``."""
    if starts is not None:
        return [derive("fresh", starts, seed, episode) for episode in range(episodes)]
    return [derive(stream, seed, episode) for episode in range(episodes)]
