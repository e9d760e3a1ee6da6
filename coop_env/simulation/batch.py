"""Moving a batch in one kernel call, and turning its outcomes into ``info``."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from coop_env.compilation import njit
from coop_env.simulation import dynamics, observation
from coop_env.simulation.rewards import TERMS
from coop_env.simulation.state import (
    INFO_FIELDS,
    Record,
    configuration_status,
    filled_holes,
    open_holes,
)
from coop_env.simulation.task import unpack

_KEYS = ("success", "is_success", *INFO_FIELDS[1:])  # the latter is Gymnasium's name of success


@njit(cache=True)
def step_batch(
    states: np.ndarray, actions: np.ndarray, packed: np.ndarray, o: np.ndarray,
    outcomes: np.ndarray, rows: np.ndarray,
) -> None:  # fmt: skip
    """Move ``actions (n,)`` on ``states (n,)``; writes ``outcomes (n,)`` and ``rows (n, size)``.

    ``packed`` holds the parameters as :func:`coop_env.simulation.task.pack` gives them, ``o`` the
    observation's transform.
    """
    p = unpack(packed)
    for i in range(states.shape[0]):
        dynamics.step(states[i], actions[i], p, outcomes[i])
        observation.observe(states[i], p, o, rows[i])


@njit(cache=True)
def write_reset_outcome(s: Record, out: Record) -> None:
    """The outcome before any move, from which a reset's ``info`` is made."""
    out.success = out.inserted = out.collision = out.violation = False
    out.duplicate = out.singular = out.terminated = out.truncated = False
    out.n_filled = filled_holes(s)
    out.all_filled = open_holes(s) == 0
    out.inserted_hole = -1
    out.sigma_min, out.alignment_error, out.distance = s.sigma, s.angle, s.distance
    out.target = s.target
    out.time = out.energy = out.reward = 0.0
    out.terms[:] = 0.0


@njit(cache=True)
def status(configuration: np.ndarray, packed: np.ndarray) -> int:
    """``configuration_status`` of a configuration (6,), quick to call from Python."""
    c = configuration
    return configuration_status((c[0], c[1], c[2], c[3], c[4], c[5]), unpack(packed))


def make_infos(outcomes: NDArray[np.void]) -> list[dict[str, Any]]:
    """The ``info`` of each outcome (n,), by columns, which is faster than one by one."""
    columns = (outcomes[name].tolist() for name in (*INFO_FIELDS, "terms"))
    return [_info(row, row[-1]) for row in zip(*columns, strict=True)]


def make_info(outcome: tuple[Any, ...]) -> dict[str, Any]:
    """The ``info`` of an outcome, the tuple of its fields."""
    return _info(outcome, outcome[len(INFO_FIELDS)].tolist())


def _info(values: tuple[Any, ...], terms: list[float]) -> dict[str, Any]:
    info = dict(zip(_KEYS, (values[0], *values), strict=False))
    info["reward_terms"] = dict(zip(TERMS, terms, strict=True))
    return info


def make_columns(
    outcomes: NDArray[np.void], present: NDArray[np.bool_] | None = None
) -> dict[str, Any]:
    """The ``info`` of outcomes (n,), of the rows ``present`` (n,) or all, as :func:`masked`."""
    there = np.ones(len(outcomes), bool) if present is None else present
    columns: dict[str, Any] = {name: outcomes[name] for name in INFO_FIELDS}
    columns["is_success"] = outcomes["success"]
    columns["reward_terms"] = dict(zip(TERMS, outcomes["terms"].T, strict=True))
    return masked(columns, there)


def masked(columns: dict[str, Any], there: NDArray[np.bool_]) -> dict[str, Any]:
    """Gymnasium's vector form: zeros (or None) in rows without info, and a mask ``_key`` each."""
    result: dict[str, Any] = {}
    for name, part in columns.items():
        if isinstance(part, dict):
            result[name] = masked(part, there)
        else:
            result[name] = np.full_like(part, None if part.dtype == object else 0)
            result[name][there] = part[there]
        result[f"_{name}"] = there.copy()
    return result
