"""Denormal numbers count as zero while Rainbow updates, and only then."""

import runpy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th

from sb3_rainbow import Rainbow
from sb3_rainbow.learner import denormals
from sb3_rainbow.learner.denormals import denormals_are_zero, flush_denormals

DENORMAL = np.float32(1e-40)

needs_the_mode = pytest.mark.skipif(
    not th.set_flush_denormal(False), reason="the processor has no such mode"
)


@needs_the_mode
def test_inside_torch_and_numpy_see_zero_and_outside_the_number() -> None:
    assert not denormals_are_zero()
    with flush_denormals():
        assert denormals_are_zero()
        assert float((np.full(1000, DENORMAL) * np.float32(1.0)).max()) == 0.0
        assert float((th.full((1000,), float(DENORMAL)) * 1.0).max()) == 0.0
    assert not denormals_are_zero()
    assert float((np.full(1000, DENORMAL) * np.float32(1.0)).max()) > 0.0


@needs_the_mode
def test_what_was_set_while_importing_does_not_matter() -> None:
    """A user's flush mode at import time, under which a constant would be made."""
    th.set_flush_denormal(True)
    try:
        flushed = runpy.run_path(denormals.__file__)["denormals_are_zero"]
        assert flushed()
    finally:
        th.set_flush_denormal(False)
    assert not flushed()


@needs_the_mode
def test_a_users_own_setting_and_an_error_inside_are_respected() -> None:
    with pytest.raises(RuntimeError, match="inside"), flush_denormals():
        raise RuntimeError("inside")
    assert not denormals_are_zero()
    th.set_flush_denormal(True)
    try:
        with flush_denormals():
            pass
        assert denormals_are_zero()
    finally:
        th.set_flush_denormal(False)


@needs_the_mode
def test_updates_flush(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[bool] = []
    model = Rainbow("MlpPolicy", gym.make("CartPole-v1"), learning_starts=8, batch_size=4, seed=0)
    update = model._learner.update

    def spy(*args: Any, **kwargs: Any) -> Any:
        seen.append(denormals_are_zero())
        return update(*args, **kwargs)

    monkeypatch.setattr(model._learner, "update", spy)
    model.learn(24)
    assert seen
    assert all(seen)
    assert not denormals_are_zero()
