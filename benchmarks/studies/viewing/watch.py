"""Watch the lattice optimum or a trained policy play, in the browser.

    python -m benchmarks watch

The exact lattice optimum plays, or with --model a policy; with --twin in the simulated machine,
where the spiral search inserts.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium.error import DependencyNotInstalled

from benchmarks.errors import BenchmarkError
from benchmarks.methods.oracle import LatticeOracle
from benchmarks.studies.robots.trials import inserter
from benchmarks.studies.viewing.media import parser, policy_moves
from coop_env.env import CoopInsertionEnv
from coop_env.rendering.browser import ViewerError
from coop_env.rendering.viewer import Act, view


class Optimum:
    """Plays the lattice optimum to the next hole; plans anew wherever the robots are put.

    Args:
        env: the environment whose moves it chooses.
    """

    def __init__(self, env: CoopInsertionEnv) -> None:
        self._env = env
        self._oracle = LatticeOracle()
        self._moves: list[int] = []
        self._expected: npt.NDArray[np.float64] | None = None

    def __call__(self, observation: Any, masks: npt.NDArray[np.bool_]) -> int:
        """The next move from where the environment is.

        Raises:
            BenchmarkError: no sequence of moves inserts the peg in the current target.
        """
        env = self._env
        if not self._moves or self._lost():
            plan = self._oracle.plan(env)
            if plan.moves is None:
                raise BenchmarkError(f"no plan from here to hole {env.scene().target}")
            self._moves = [int(move) for move in plan.moves]
        move = self._moves.pop(0)
        self._expected = env.configuration
        self._expected[move // 2] += env.task.steps[move // 2] * (1.0 - 2.0 * (move % 2))
        return move

    def _lost(self) -> bool:
        here = self._env.configuration
        return self._expected is None or not np.allclose(here, self._expected, atol=1e-9)


def _kinematic(arguments: argparse.Namespace) -> CoopInsertionEnv:
    return CoopInsertionEnv(geometry=arguments.geometry, render_mode="rgb_array")


def _twin(arguments: argparse.Namespace) -> CoopInsertionEnv:
    """The same task on the twin.

    Raises:
        BenchmarkError: MuJoCo or the script's gains are missing.
    """
    try:
        from coop_env.physics.whole.moves import CoopInsertionPhysicsDiscreteEnv
    except DependencyNotInstalled as missing:
        raise BenchmarkError(str(missing)) from missing
    finish = inserter(arguments.results, "spiral search", 0)
    shown = {"geometry": arguments.geometry, "render_mode": "rgb_array"}
    return CoopInsertionPhysicsDiscreteEnv(finish, **shown)


def main(words: Sequence[str]) -> int:
    """Play until the browser view is closed."""
    line = parser("watch", __doc__)
    line.add_argument("--host", default="127.0.0.1", help="address to listen on")
    line.add_argument("--port", type=int, default=8080)
    line.add_argument("--twin", action="store_true", help="masses, servos and contact (MuJoCo)")
    line.add_argument("--results", type=Path, default=Path("results"), help="of the twin's script")
    arguments = line.parse_args(words)
    env = _twin(arguments) if arguments.twin else _kinematic(arguments)
    act: Act = (
        Optimum(env)
        if arguments.model is None
        else policy_moves(arguments.model, env, arguments.trust)
    )
    try:
        view(env, act, host=arguments.host, port=arguments.port)
    except ViewerError as error:
        raise BenchmarkError(str(error)) from error
    return 0
