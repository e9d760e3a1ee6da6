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
    """Write the outcome before any move, from which a reset's ``info`` is made."""
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
    return list(map(_info, *(outcomes[name].tolist() for name in ("terms", *INFO_FIELDS))))


def make_info(outcome: tuple[Any, ...]) -> dict[str, Any]:
    """The ``info`` of an outcome, the tuple of its fields."""
    n = len(INFO_FIELDS)
    return _info(outcome[n].tolist(), *outcome[:n])


def _info(
    t: list[float],
    success: bool, n_filled: int, all_filled: bool, inserted: bool, inserted_hole: int,
    collision: bool, violation: bool, duplicate: bool, singular: bool, sigma_min: float,
    alignment_error: float, distance: float, target: int, time: float, energy: float,
) -> dict[str, Any]:  # fmt: skip
    """``info`` of the reward's terms and an outcome; ``dict(zip(...))`` takes twice as long."""
    return {
        "success": success, "is_success": success, "n_filled": n_filled, "all_filled": all_filled,
        "inserted": inserted, "inserted_hole": inserted_hole, "collision": collision,
        "violation": violation, "duplicate": duplicate, "singular": singular,
        "sigma_min": sigma_min, "alignment_error": alignment_error, "distance": distance,
        "target": target, "time": time, "energy": energy,
        "reward_terms": {
            "violation": t[0], "insertion": t[1], "duplicate": t[2], "step": t[3],
            "distance": t[4], "progress": t[5], "proximity": t[6], "alignment": t[7],
        },
    }  # fmt: skip


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
