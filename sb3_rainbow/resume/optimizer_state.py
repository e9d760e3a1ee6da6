"""The optimizer's state of models saved by version 0.1, as torch has it."""

from typing import Any

import torch as th


def per_parameter(state_dict: dict[str, Any], optimizer: th.optim.Optimizer) -> dict[str, Any]:
    """An optimizer's state dict with one entry per parameter, as torch has it.

    Models saved by version 0.1 have one for all parameters, joined to one vector.

    Args:
        state_dict: as saved.
        optimizer: that is to take it.
    """
    groups, state = state_dict.get("param_groups"), state_dict.get("state")
    if not groups or state is None:
        return state_dict  # none of an optimizer: torch says so
    parameters = optimizer.param_groups[0]["params"]
    joined = len(groups) == 1 and len(groups[0]["params"]) == 1 < len(parameters)
    vectors = [v for v in state.get(0, {}).values() if isinstance(v, th.Tensor) and v.ndim]
    n_numbers = sum(p.numel() for p in parameters)
    if not joined or any(v.numel() != n_numbers for v in vectors):
        return state_dict
    entries: dict[int, dict[str, Any]] = {i: {} for i in range(len(parameters)) if state}
    for name, value in state.get(0, {}).items():
        for i, part in enumerate(_parts(value, parameters)):
            entries[i][name] = part
    group = {**groups[0], "params": list(range(len(parameters)))}
    return {**state_dict, "state": entries, "param_groups": [group]}


def _parts(value: Any, parameters: list[th.Tensor]) -> list[Any]:
    """An entry of the joined state for each parameter: its part of a vector, a copy of a number."""
    if isinstance(value, th.Tensor) and value.ndim:
        pieces = value.split([p.numel() for p in parameters])
        return [piece.view_as(p).clone() for piece, p in zip(pieces, parameters, strict=True)]
    return [value.clone() if isinstance(value, th.Tensor) else value for _ in parameters]
