"""Denormal numbers count as zero while Rainbow updates, and only then."""

from typing import Any

import numpy as np
import pytest
import torch as th

from sb3_rainbow.learner.learner import flush_denormals
from tests.sb3_rainbow.small import make

needs_the_mode = pytest.mark.skipif(
    not th.set_flush_denormal(False), reason="the processor has no such mode"
)


def flushed() -> bool:
    """Whether torch and numpy, which agree, see zero."""
    small = np.full(1000, np.float32(1e-40))
    seen = {(small * np.float32(1.0)).max() == 0.0, bool((th.from_numpy(small) * 1.0).max() == 0.0)}
    assert len(seen) == 1
    return seen.pop()


@needs_the_mode
def test_only_inside_even_after_an_error_and_a_users_own_setting_stays() -> None:
    assert not flushed()
    with flush_denormals():
        assert flushed()
    with pytest.raises(RuntimeError, match="inside"), flush_denormals():
        raise RuntimeError("inside")
    assert not flushed()
    th.set_flush_denormal(True)
    try:
        with flush_denormals():
            pass
        assert flushed()
    finally:
        th.set_flush_denormal(False)


@needs_the_mode
def test_updates_flush(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[bool] = []
    model = make()
    update = model._learner.update

    def spy(*args: Any, **kwargs: Any) -> Any:
        seen.append(flushed())
        return update(*args, **kwargs)

    monkeypatch.setattr(model._learner, "update", spy)
    model.learn(28)
    assert set(seen) == {True}
    assert not flushed()
