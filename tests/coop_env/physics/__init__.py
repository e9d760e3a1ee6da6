"""Tests of the twin, which need MuJoCo."""

import pytest

pytest.importorskip("mujoco", reason="needs the extra physics")
