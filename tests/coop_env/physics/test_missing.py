"""Without MuJoCo: the package works, and what needs it names the extra."""

from __future__ import annotations

import subprocess
import sys

CODE = """
import sys
sys.modules["mujoco"] = None
import gymnasium, coop_env
from gymnasium.error import DependencyNotInstalled
gymnasium.make("CoopInsertion-v0")
import coop_env.physics, coop_env.physics.model
for make in (gymnasium.make, gymnasium.make_vec):
    try:
        make("CoopInsertionContact-v0")
    except DependencyNotInstalled as error:
        assert "sb3-rainbow-coop[physics]" in str(error), error
    else:
        raise AssertionError("made without MuJoCo")
"""


def test_the_extra_is_named() -> None:
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
