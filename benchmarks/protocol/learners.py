"""The learners of all presets, of the insertion task, its teams and the public tasks: one table."""

from dataclasses import dataclass
from typing import Final

from benchmarks.errors import BenchmarkError, known


@dataclass(frozen=True)
class Learner:
    """A learning algorithm with Stable-Baselines3's interface."""

    title: str  # in tables and figures
    where: str  # its class, as ``module:Class``
    colour: int  # its number in the palette of the figures
    masks: bool = False  # it reads action masks
    discrete: bool = True  # it chooses one of n actions; else it sets the contact task's increments
    on_policy: bool = False  # it takes a track's settings ``ppo`` and has no replay buffer
    teams: bool = False  # it can command both robots at once
    cost: float = 1.0  # time of an environment step with its updates, relative to Rainbow's


LEARNERS: Final[dict[str, Learner]] = {
    "rainbow": Learner("Rainbow", "sb3_rainbow:Rainbow", 0, masks=True, teams=True),
    "dqn": Learner("DQN", "stable_baselines3:DQN", 1),
    "maskable_ppo": Learner(
        "MaskablePPO", "sb3_contrib:MaskablePPO", 2, masks=True, on_policy=True
    ),
    "qrdqn": Learner("QR-DQN", "sb3_contrib:QRDQN", 2, cost=2.0),
    "sac": Learner("SAC", "stable_baselines3:SAC", 2, discrete=False, cost=4.0),
    "crossq": Learner("CrossQ", "sb3_contrib:CrossQ", 3, discrete=False, cost=4.0),
    "td3": Learner("TD3", "stable_baselines3:TD3", 4, discrete=False, cost=3.0),
    "ppo": Learner("PPO", "stable_baselines3:PPO", 5, discrete=False, on_policy=True),
    "bc": Learner("Behaviour cloning", "benchmarks.methods.guided:Cloning", 6, discrete=False),
}


def learner_of(method: str) -> str | None:
    """The learner of a method, which is one, or ``<one>_<variant>``; None if it does not learn."""
    names = [name for name in LEARNERS if method == name or method.startswith(f"{name}_")]
    return max(names, key=len, default=None)


def algorithm_of(method: str) -> str:
    """:func:`learner_of` a method; BenchmarkError if it does not learn."""
    if (learner := learner_of(method)) is None:
        raise BenchmarkError(
            f"methods: unknown method '{method}'; known: {known(LEARNERS)}, and <one>_<variant>"
        )
    return learner
