"""The exact lattice optimum or a trained policy plays in the browser."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

from gymnasium.error import DependencyNotInstalled

from benchmarks.errors import BenchmarkError
from benchmarks.studies.media import player
from benchmarks.studies.robots.trials import inserter
from coop_env.env import CoopInsertionEnv
from coop_env.rendering.viewer import ViewerError, view


def _twin(results: Path, **shown: Any) -> CoopInsertionEnv:
    """The same task on the twin.

    Raises:
        BenchmarkError: MuJoCo or the script's gains are missing.
    """
    try:
        from coop_env.physics.moves import CoopInsertionPhysicsDiscreteEnv
    except DependencyNotInstalled as missing:
        raise BenchmarkError(str(missing)) from missing
    return CoopInsertionPhysicsDiscreteEnv(inserter(results, "spiral search", 0), **shown)


def watch(arguments: argparse.Namespace) -> None:
    """Play until the browser view is closed.

    Args:
        arguments: ``geometry``, ``model``, ``trust``, ``twin``, ``results``, ``host`` and ``port``.
    """
    make = partial(_twin, arguments.results) if arguments.twin else CoopInsertionEnv
    env, act = player(arguments.model, arguments.trust, make, geometry=arguments.geometry)
    try:
        view(env, act, host=arguments.host, port=arguments.port)
    except ViewerError as error:
        raise BenchmarkError(str(error)) from error
