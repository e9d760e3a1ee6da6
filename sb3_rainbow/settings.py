"""Defaults and checks of Rainbow's settings."""

import json
import math
import warnings
import zipfile
from contextlib import nullcontext
from typing import Any

from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.save_util import open_path

from sb3_rainbow.network.rainbow_network import head_of
from sb3_rainbow.policies import RainbowPolicy
from sb3_rainbow.replay.buffers import PrioritizedReplayBuffer
from sb3_rainbow.replay.parameters import check_counts, check_numbers, check_shares
from sb3_rainbow.type_aliases import Distributional, SaveFile, UseMasking

# Constructor arguments that Rainbow hands to its policy
NETWORK_ARGUMENTS = frozenset(
    ("dueling", "noisy", "sigma0", "distributional", "n_atoms", "v_min", "v_max")
)

_SWITCHES = ("double_q", "dueling", "noisy", "cpu_kernels")
# Arguments from 0 to 1
_SHARES = (
    *("tau", "gamma", "alpha", "beta_start", "beta_end"),
    *("exploration_fraction", "exploration_initial_eps", "exploration_final_eps"),
)
_DEFAULT_SUPPORT = (-100.0, 100.0)

HESSEL: dict[str, Any] = {
    "learning_rate": 6.25e-5,
    "learning_starts": 20_000,
    "batch_size": 32,
    "train_freq": 4,
    "gradient_steps": 1,
    "target_update_interval": 8_000,
    "exploration_initial_eps": 0.0,
    "exploration_final_eps": 0.0,
    "distributional": "categorical",
    "v_min": -10.0,
    "v_max": 10.0,
    "sigma0": 0.5,
    "alpha": 0.5,
    "policy_kwargs": {"noisy_layers": "all", "optimizer_kwargs": {"eps": 1.5e-4}},
}
"""Hessel et al.'s settings (2018, table 1), for images of Atari, whose frames come four to a step
and whose rewards are clipped to [-1, 1]: ``Rainbow("CnnPolicy", env, **HESSEL)``."""


class SettingsMismatchError(ValueError, RuntimeError):
    """What is loaded was saved with other settings.

    SB3 raises ``RuntimeError`` where a tensor is missing or has another shape, and ``ValueError``
    for everything else: code written for SB3 may catch either.
    """


def served_by(
    buffer_class: type[ReplayBuffer] | None, prioritized: bool | None, n_steps: int | None
) -> tuple[bool, int]:
    """``prioritized`` and ``n_steps`` for a class of replay buffers, None for Rainbow's own.

    A setting of None means the default, or off with a warning if the class cannot do it.

    Raises:
        ValueError: if the buffer cannot do what was asked for, or nobody could.
    """
    if prioritized not in (True, False, None):
        raise ValueError(f"prioritized must be True, False or None, got {prioritized!r}")
    prioritizes = buffer_class is None or issubclass(buffer_class, PrioritizedReplayBuffer)
    sums = prioritizes or issubclass(buffer_class, NStepReplayBuffer)  # type: ignore[arg-type]
    name = getattr(buffer_class, "__name__", "")
    lacking, remedy, dropped = [], [], []
    if not prioritizes and prioritized is None:
        dropped.append("prioritized=False")
    elif not prioritizes and prioritized:
        lacking.append("no priorities")
        remedy.append("prioritized=False")
    if not sums and n_steps is None:
        dropped.append("n_steps=1")
    elif not sums and n_steps != 1:
        lacking.append("no n-step returns")
        remedy.append(f"n_steps=1 instead of {n_steps}")
    if lacking:
        raise ValueError(f"{name} keeps {' and '.join(lacking)}: pass {', '.join(remedy)}")
    if dropped:
        warnings.warn(
            f"{name} cannot do all that Rainbow does: {', '.join(dropped)} instead. Pass that "
            "yourself to silence this",
            stacklevel=3,
        )
    if n_steps is None:
        n_steps = 3 if sums else 1
    check_counts(n_steps=n_steps)
    return prioritizes if prioritized is None else prioritized, n_steps


def as_use_masking(value: Any) -> UseMasking:
    """The setting ``use_masking``, with 0, 1 and numpy's booleans as booleans."""
    if value not in ("auto", True, False):
        raise ValueError(f"use_masking must be 'auto', True or False, got {value!r}")
    return value if isinstance(value, str) else bool(value)  # type: ignore[return-value]


def default_tau(target_update_interval: int | None) -> float:
    """A small step after every update, or SB3's whole copy at every interval."""
    return 5e-3 if target_update_interval is None else 1.0


def head_and_support(
    distributional: Distributional | None, v_min: float | None, v_max: float | None
) -> tuple[Distributional, float, float]:
    """The head and the ends of its support; None stands for a default."""
    uses_support = distributional is None or head_of(distributional) == "categorical"
    if uses_support and (v_min is None) != (v_max is None):
        given, missing = ("v_min", "v_max") if v_max is None else ("v_max", "v_min")
        raise ValueError(
            f"{given} without {missing}: pass both for the categorical head, neither for quantiles"
        )
    if distributional is None:
        distributional = "quantile" if v_min is None else "categorical"
    low, high = _DEFAULT_SUPPORT
    return distributional, low if v_min is None else v_min, high if v_max is None else v_max


def support_of(
    distributional: Distributional, v_min: float, v_max: float
) -> tuple[float, ...] | None:
    """Ends of the support of a distribution's head; quantiles have none, scalars need none."""
    head = head_of(distributional)
    if head != "categorical":
        return None if head == "scalar" else ()
    return float(v_min), float(v_max)  # as a file has them


def support_in_file(path: SaveFile) -> tuple[float, ...] | None:
    """The :func:`support_of` a saved model; None if the file has none, or is no model."""
    file = open_path(path, "r", suffix="zip")
    with nullcontext() if file is path else file:
        if not zipfile.is_zipfile(file):
            return None
        with zipfile.ZipFile(file) as archive:
            data = json.loads(archive.read("data")) if "data" in archive.namelist() else {}
    support = data.get("_support")
    return None if support is None else tuple(support)


def check_support_of_file(
    loaded: tuple[float, ...] | None, support: tuple[float, ...] | None
) -> None:
    """Refuse weights that were trained for another :func:`support_of` than the model's."""
    if loaded is not None and support is not None and tuple(loaded) != support:
        raise SettingsMismatchError(
            f"The checkpoint's support is {list(loaded) or 'none'}, "
            f"the model's {list(support) or 'none'}"
        )


def check_settings(model: Any) -> None:
    """Raise ``ValueError`` for the first setting of a Rainbow that cannot work."""
    check_counts(batch_size=model.batch_size)
    check_shares(**{name: getattr(model, name) for name in _SHARES})
    optional = {name: getattr(model, name) for name in ("max_grad_norm", "target_update_interval")}
    check_numbers(**{name: value for name, value in optional.items() if value is not None})
    check_numbers(**{n: getattr(model, n) for n in ("sigma0", "n_atoms", "v_min", "v_max")})
    for name in _SWITCHES:
        if (value := getattr(model, name)) not in (True, False):
            raise ValueError(f"{name} must be True or False, got {value!r}")
    if model.max_grad_norm is not None and not model.max_grad_norm > 0.0:
        raise ValueError(f"max_grad_norm must be positive, or None, got {model.max_grad_norm}")
    interval = model.target_update_interval
    if interval is not None and (interval < 1 or interval % 1):
        raise ValueError(
            f"target_update_interval must be at least 1 and whole, or None, got {interval}"
        )
    if interval is not None and model.n_envs > interval:
        warnings.warn(
            "The number of environments used is greater than the target network update interval "
            f"({model.n_envs} > {interval}): the target network will be updated after each call "
            f"to env.step(), which are {model.n_envs} steps",
            stacklevel=4,
        )
    check_support_of_file(
        model._support, support_of(model.distributional, model.v_min, model.v_max)
    )
    if not 0.0 <= model.sigma0 < math.inf:
        raise ValueError(f"sigma0 must be finite and not negative, got {model.sigma0}")
    if not issubclass(model.policy_class, RainbowPolicy):
        raise ValueError(
            f"Rainbow needs a policy derived from RainbowPolicy, got {model.policy_class}; was "
            "the file saved by another algorithm?"
        )
    clashing = NETWORK_ARGUMENTS & set(model.policy_kwargs)
    if clashing:
        raise ValueError(
            f"Pass {', '.join(sorted(clashing))} to Rainbow itself, not in policy_kwargs"
        )
    kind = model.replay_buffer_class or PrioritizedReplayBuffer  # another's beta is its own
    if "beta" in model.replay_buffer_kwargs and issubclass(kind, PrioritizedReplayBuffer):
        raise ValueError(
            "Pass beta_start and beta_end to Rainbow instead of beta in replay_buffer_kwargs: it "
            "rises in training"
        )
    start = int(model.action_space.start)
    if start != 0:
        raise ValueError(f"Rainbow needs Discrete actions that start at 0, got start={start}")
