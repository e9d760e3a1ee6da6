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
    from coop_env.env import CoopInsertionEnv as CoopInsertionEnv
    from coop_env.geometry import GEOMETRIES as GEOMETRIES
    from coop_env.geometry import INITIAL as INITIAL
    from coop_env.geometry import OPTIMIZED as OPTIMIZED
    from coop_env.geometry import DeltaGeometry as DeltaGeometry
    from coop_env.geometry import RRSGeometry as RRSGeometry
    from coop_env.simulation.insertion_task import InsertionTask as InsertionTask
    from coop_env.simulation.sim_to_real import SimToReal as SimToReal
    from coop_env.team.joint_env import CoopInsertionJointEnv as CoopInsertionJointEnv
    from coop_env.team.parallel_env import CoopInsertionParallelEnv as CoopInsertionParallelEnv
    from coop_env.team.vec_env import CoopInsertionJointVecEnv as CoopInsertionJointVecEnv
    from coop_env.team.vec_env import CoopInsertionTeamVecEnv as CoopInsertionTeamVecEnv
    from coop_env.vector.vec_env import CoopInsertionVecEnv as CoopInsertionVecEnv
    from coop_env.vector.vector_env import CoopInsertionVectorEnv as CoopInsertionVectorEnv

# what compiles at a first call, and how long it takes
_KERNELS = "kinematics, collisions, moves: up to a minute"
_NAMES = {
    "env": ("CoopInsertionEnv",),
    "geometry": ("GEOMETRIES", "INITIAL", "OPTIMIZED", "DeltaGeometry", "RRSGeometry"),
    "simulation.insertion_task": ("InsertionTask",),
    "simulation.sim_to_real": ("SimToReal",),
    "team.joint_env": ("CoopInsertionJointEnv",),
    "team.parallel_env": ("CoopInsertionParallelEnv",),
    "team.vec_env": ("CoopInsertionJointVecEnv", "CoopInsertionTeamVecEnv"),
    "vector.vec_env": ("CoopInsertionVecEnv",),
    "vector.vector_env": ("CoopInsertionVectorEnv",),
}
_HOMES = {name: f"coop_env.{home}" for home, names in _NAMES.items() for name in names}

__version__ = "0.1.0"

# ``import *`` must not need PettingZoo
__all__ = sorted({*_HOMES, "__version__", "parallel_env"} - {"CoopInsertionParallelEnv"})

for _name, _steps, _home, _vector_home in (
    # whoever gives more max_moves or max_steps gives max_episode_steps too
    ("", 300, "env", "vector.vector_env"),
    ("Joint", 300, "team.joint_env", "team.joint_env"),
    ("Contact", 80, "physics.env", "physics.vector_env"),
    ("ContactDiscrete", 80, "physics.env", "physics.vector_env"),
    ("Physics", 2400, "physics.env", "physics.vector_env"),
    ("PhysicsDiscrete", 300, "physics.moves", ""),  # many of them by Gymnasium's own vector forms
):
    _class = f"CoopInsertion{_name}"
    gymnasium.register(
        id=f"{_class}-v0",
        entry_point=f"coop_env.{_home}:{_class}Env",
        max_episode_steps=_steps,
        vector_entry_point=f"coop_env.{_vector_home}:{_class}VectorEnv" if _vector_home else None,
    )


def parallel_env(sight: bool = False, **arguments: Any) -> CoopInsertionParallelEnv:
    """:class:`~coop_env.team.parallel_env.CoopInsertionParallelEnv`, as PettingZoo names it.

    Raises:
        DependencyNotInstalled: PettingZoo is not installed (extra ``team``).
        ArgumentError: an argument is wrong.
    """
    from coop_env.team.parallel_env import CoopInsertionParallelEnv

    return CoopInsertionParallelEnv(sight, **arguments)


def __dir__() -> list[str]:
    return __all__


def __getattr__(name: str) -> Any:
    """Import names at first use; SB3, and so torch, only for the three ``VecEnv`` classes."""
    import importlib

    if name not in _HOMES:
        raise AttributeError(f"module 'coop_env' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)
