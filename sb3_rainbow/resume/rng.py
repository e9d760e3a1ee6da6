"""Snapshot of every random generator that a training run draws from."""

import random
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces


def get_rng_state(action_space: spaces.Space) -> dict[str, Any]:
    """States of Python's, numpy's and torch's global generators and of the model's action space,
    from which the warm-up draws; picklable.
    """
    return {
        "python": random.getstate(),
        "numpy": np.random.get_state(),  # noqa: NPY002
        "torch": th.get_rng_state(),
        # asking a GPU that nothing was drawn on would start it, which a forked process cannot
        "cuda": th.cuda.get_rng_state_all() if th.cuda.is_initialized() else [],
        "action_space": action_space.np_random.bit_generator.state,
    }


def set_rng_state(state: dict[str, Any], action_space: spaces.Space) -> None:
    """Put the generators back to a state of :func:`get_rng_state`."""
    random.setstate(state["python"])
    np.random.set_state(state["numpy"])  # noqa: NPY002
    th.set_rng_state(state["torch"])
    if state.get("cuda") and len(state["cuda"]) == th.cuda.device_count():
        th.cuda.set_rng_state_all(state["cuda"])
    action_space.np_random.bit_generator.state = state["action_space"]
