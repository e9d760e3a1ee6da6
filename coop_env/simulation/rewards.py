"""The two rewards, as named terms: the paper's equation (reward), and its repair.

``"paper"`` pays ``50 [dd]+`` for every second step of an oscillation and up to 6 a step for
hovering within 3 cm of a hole, so a learner can farm it without ever inserting. ``"progress"`` pays
the two-sided progress in distance and angle towards one hole, whose sum around any loop is nought.
"""

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from coop_env.compilation import njit
from coop_env.errors import RewardError, check_keys, check_number
from coop_env.simulation.task import RewardParams

TERMS: Final = (
    "violation", "insertion", "duplicate", "step", "distance", "progress", "proximity", "alignment",
)  # fmt: skip
"""Names of the terms, in the order of the kernel's tuple; a reward is their sum."""

Terms = tuple[float, float, float, float, float, float, float, float]

PROGRESS_DEFAULTS: Final[Mapping[str, float | None]] = MappingProxyType(
    {
        "step_cost": 0.5,
        "distance_scale": 500.0,
        "angle_scale": 150.0,
        "insertion_bonus": None,
        "violation_penalty": 3.0,
        "duplicate_penalty": 1.0,
        "gamma": None,
    }
)
"""Keys of ``reward_kwargs`` with ``reward="progress"``. None: the printed bonus; no discount."""


def make_reward(kind: str, kwargs: Mapping[str, float | None] | None = None) -> RewardParams:
    """A reward's name and scales (keys of :data:`PROGRESS_DEFAULTS`) as the kernel takes them.

    Raises:
        RewardError: an unknown name or key, or a scale that is negative, infinite or not a number.
    """
    if kwargs is not None and not isinstance(kwargs, Mapping):
        raise RewardError(f"reward_kwargs = {kwargs!r}: must be a mapping of scales or None")
    given = dict(kwargs or {})
    if kind == "paper":
        if given:
            raise RewardError(
                f"reward_kwargs = {given!r}: reward='paper' is the printed equation and takes no "
                "scales; use reward='progress'"
            )
        return RewardParams(True, 0.01, 1.0, 0.0, math.nan, 3.0, 1.0, math.nan)
    if kind != "progress":
        raise RewardError(f"reward = {kind!r}: must be 'paper' or 'progress'")
    check_keys("reward_kwargs", given, sorted(PROGRESS_DEFAULTS), RewardError)
    scales = {**PROGRESS_DEFAULTS, **given}
    return RewardParams(paper=False, **{k: _scale(k, v) for k, v in scales.items()})


def _scale(key: str, value: float | None) -> float:
    if value is None and key in ("insertion_bonus", "gamma"):
        return math.nan
    most = 1.0 if key == "gamma" else math.inf
    # costs and penalties are magnitudes
    return check_number(f"reward_kwargs[{key!r}]", value, 0.0, most, error=RewardError)


@njit(cache=True)
def insertion_bonus(n_filled: int, time: float, p: RewardParams) -> float:
    """Bonus of an insertion: ``150 + 25 N_t + 80 (1 - t / T_task)``, or the given constant."""
    if math.isnan(p.insertion_bonus):
        return 150.0 + 25.0 * n_filled + 80.0 * (1.0 - time / p.task_time)
    return p.insertion_bonus


@njit(cache=True)
def terms(
    v: bool, z: bool, u: bool, n_filled: int, time: float,
    distance: tuple[float, float], angle: tuple[float, float], p: RewardParams,
) -> Terms:  # fmt: skip
    """Terms of a move: equation (reward), or its repair; ``distance``, ``angle``: (before, after).

    Both are to one hole. With ``p.gamma`` the repair is the shaping ``gamma Phi(s') - Phi(s)`` of
    the potential ``Phi = -(distance_scale d + angle_scale angle)``.
    """
    violation = -p.violation_penalty if v else 0.0
    insertion = insertion_bonus(n_filled, time, p) if z else 0.0
    duplicate = -p.duplicate_penalty if u else 0.0
    before, after = distance
    if p.paper:
        nominal = 0.0 if v or z or u else 1.0
        step, away = -0.01 * nominal, -after * nominal
        closer = 50.0 * max(before - after, 0.0) * nominal
        near = 200.0 * max(0.03 - after, 0.0) * nominal
        return violation, insertion, duplicate, step, away, closer, near, 0.0
    step = 0.0 if v else -p.step_cost
    gamma = 1.0 if math.isnan(p.gamma) else p.gamma
    closer = p.distance_scale * (before - gamma * after)
    turned = p.angle_scale * (angle[0] - gamma * angle[1])
    return violation, insertion, duplicate, step, 0.0, closer, 0.0, turned


@njit(cache=True)
def failure_terms(terms: Terms, moves_left: int, p: RewardParams) -> Terms:
    """The repaired reward of a move that ends the episode in failure, so that ending it never pays.

    It costs what idling to the end would have cost, itself included, and the penalty.
    """
    penalty, step = -p.violation_penalty, -p.step_cost * moves_left
    return penalty, terms[1], terms[2], step, 0.0, 0.0, 0.0, 0.0
