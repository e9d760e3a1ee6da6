"""Cooperative peg-in-hole with a Delta robot and a 3-RRS, with exact kinematics.

Importing the package registers ``CoopInsertion-v0``, ``CoopInsertionJoint-v0``,
``CoopInsertionContact-v0``, ``CoopInsertionContactDiscrete-v0``, ``CoopInsertionPhysics-v0`` and
``CoopInsertionPhysicsDiscrete-v0``; kernels compile when they are first used, and the last four
need the extra ``physics``.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium

if TYPE_CHECKING:
    from coop_env.env import CoopInsertionEnv
    from coop_env.geometry import GEOMETRIES, INITIAL, OPTIMIZED, DeltaGeometry, RRSGeometry
    from coop_env.simulation.insertion_task import InsertionTask
    from coop_env.simulation.sim_to_real import SimToReal
    from coop_env.team.joint_env import CoopInsertionJointEnv
    from coop_env.team.parallel_env import CoopInsertionParallelEnv
    from coop_env.team.vec_env import CoopInsertionJointVecEnv, CoopInsertionTeamVecEnv
    from coop_env.vector.vec_env import CoopInsertionVecEnv
    from coop_env.vector.vector_env import CoopInsertionVectorEnv

_HOMES = {
    "CoopInsertionEnv": "coop_env.env",
    "CoopInsertionJointEnv": "coop_env.team.joint_env",
    "CoopInsertionJointVecEnv": "coop_env.team.vec_env",
    "CoopInsertionParallelEnv": "coop_env.team.parallel_env",
    "CoopInsertionTeamVecEnv": "coop_env.team.vec_env",
    "CoopInsertionVecEnv": "coop_env.vector.vec_env",
    "CoopInsertionVectorEnv": "coop_env.vector.vector_env",
    "DeltaGeometry": "coop_env.geometry",
    "RRSGeometry": "coop_env.geometry",
    "GEOMETRIES": "coop_env.geometry",
    "INITIAL": "coop_env.geometry",
    "OPTIMIZED": "coop_env.geometry",
    "InsertionTask": "coop_env.simulation.insertion_task",
    "SimToReal": "coop_env.simulation.sim_to_real",
}

__version__ = "0.1.0"

__all__ = [
    "GEOMETRIES",
    "INITIAL",
    "OPTIMIZED",
    "CoopInsertionEnv",
    "CoopInsertionJointEnv",
    "CoopInsertionJointVecEnv",
    "CoopInsertionTeamVecEnv",
    "CoopInsertionVecEnv",
    "CoopInsertionVectorEnv",
    "DeltaGeometry",
    "InsertionTask",
    "RRSGeometry",
    "SimToReal",
    "__version__",
    "parallel_env",
]

gymnasium.register(
    id="CoopInsertion-v0",
    entry_point="coop_env.env:CoopInsertionEnv",
    max_episode_steps=300,  # whoever gives more max_moves gives this too
    vector_entry_point="coop_env.vector.vector_env:CoopInsertionVectorEnv",
)
for _form in ("", "Discrete"):
    gymnasium.register(
        id=f"CoopInsertionContact{_form}-v0",
        entry_point=f"coop_env.physics.env:CoopInsertionContact{_form}Env",
        max_episode_steps=80,  # whoever gives more max_steps gives this too
        vector_entry_point=(f"coop_env.physics.vector_env:CoopInsertionContact{_form}VectorEnv"),
    )
gymnasium.register(
    id="CoopInsertionPhysics-v0",
    entry_point="coop_env.physics.env:CoopInsertionPhysicsEnv",
    max_episode_steps=2400,
    vector_entry_point="coop_env.physics.vector_env:CoopInsertionPhysicsVectorEnv",
)
gymnasium.register(
    id="CoopInsertionPhysicsDiscrete-v0",
    entry_point="coop_env.physics.moves:CoopInsertionPhysicsDiscreteEnv",
    max_episode_steps=300,
    vector_entry_point="coop_env.physics.vector_env:CoopInsertionPhysicsDiscreteVectorEnv",
)
gymnasium.register(
    id="CoopInsertionJoint-v0",
    entry_point="coop_env.team.joint_env:CoopInsertionJointEnv",
    max_episode_steps=300,
    vector_entry_point="coop_env.team.joint_env:CoopInsertionJointVectorEnv",
)


def parallel_env(sight: bool = False, **arguments: Any) -> CoopInsertionParallelEnv:
    """The task for two agents at once, a PettingZoo ``ParallelEnv`` (extra ``team``).

    Args:
        sight: each agent sees the other's configuration.
        arguments: as for :class:`~coop_env.team.joint_env.CoopInsertionJointEnv`.

    Raises:
        DependencyNotInstalled: PettingZoo is not installed.
        ArgumentError: an argument is wrong.
    """
    from coop_env.team.parallel_env import CoopInsertionParallelEnv

    return CoopInsertionParallelEnv(sight, **arguments)


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    """Import what is asked for, and not SB3 (so torch) unless the batched environment is."""
    import importlib

    if name not in _HOMES:
        raise AttributeError(f"module 'coop_env' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
