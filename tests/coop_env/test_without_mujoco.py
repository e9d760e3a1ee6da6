"""Without MuJoCo: the package works, and what needs it names the extra."""

from tests.process import python

CODE = """
import itertools, sys
sys.modules["mujoco"] = None
import gymnasium, coop_env
from gymnasium.error import DependencyNotInstalled
gymnasium.make("CoopInsertion-v0")
import coop_env.physics, coop_env.physics.model
tasks = ("CoopInsertionContact", "CoopInsertionPhysics")
ids = [name for name in gymnasium.registry if name.startswith(tasks)]
assert len(ids) == 4
for make, name in itertools.product((gymnasium.make, gymnasium.make_vec), ids):
    try:
        make(name)
    except DependencyNotInstalled as error:
        assert "sb3-rainbow-coop[physics]" in str(error), error
    else:
        raise AssertionError("made without MuJoCo")
"""


def test_the_extra_is_named() -> None:
    python("-c", CODE)
