"""A batch moves in one piece, and nothing of it is lost on the way."""

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_rainbow import PrioritizedReplayBuffer
from sb3_rainbow.replay import transfer

ARRAYS = {
    "floats": np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32),
    "masks": np.random.default_rng(1).random((5, 7)) < 0.5,
    "image": np.random.default_rng(2).integers(0, 256, (5, 2, 3), dtype=np.uint8),
    "actions": np.arange(5)[:, None],
    "doubles": np.linspace(0.0, 1.0, 5),
}


def test_packed_arrays_come_out_as_they_went_in() -> None:
    places, size = transfer.place(ARRAYS)
    assert size < sum(array.nbytes for array in ARRAYS.values()) + 16 * len(ARRAYS)
    found = transfer.unpack(transfer.pack(places, size, pinned=False).clone(), places)
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        assert found[name].dtype == th.from_numpy(array).dtype
        np.testing.assert_array_equal(found[name].numpy(), array)


@pytest.mark.parametrize("is_dict", [False, True])
def test_a_sample_needs_one_copy_to_another_device(
    monkeypatch: pytest.MonkeyPatch, is_dict: bool
) -> None:
    box = spaces.Box(-1, 1, (3,), np.float32)
    space = spaces.Dict({"a": box, "b": spaces.Discrete(4)}) if is_dict else box
    buffer = PrioritizedReplayBuffer(10, space, spaces.Discrete(6), device="cpu")
    for step in range(5):
        obs = {"a": np.full((1, 3), step, np.float32), "b": np.array([step % 4])}
        given = obs if is_dict else obs["a"]
        mask = np.arange(6)[None] <= step
        buffer.add(given, given, np.array([step]), np.ones(1), np.zeros(1), [{}], mask, ~mask)
    indices = np.arange(4)
    expected = buffer.samples_at(indices)
    copies = []
    pack = transfer.pack

    def counted(places: transfer.Places, size: int, pinned: bool) -> th.Tensor:
        copies.append(size)
        return pack(places, size, pinned=False)

    monkeypatch.setattr(transfer, "pack", counted)
    # A device without memory: whatever is not in the one copy would show.
    buffer.device = th.device("meta")
    elsewhere = buffer.samples_at(indices)
    assert len(copies) == 1
    for name, value in expected._asdict().items():
        moved = getattr(elsewhere, name)
        if name == "indices":
            np.testing.assert_array_equal(moved, value)
            continue
        parts = value if isinstance(value, dict) else {"": value}
        moved_parts = moved if isinstance(moved, dict) else {"": moved}
        assert parts.keys() == moved_parts.keys()
        for key, here in parts.items():
            there = moved_parts[key]
            assert there.device.type == "meta"
            assert (there.shape, there.dtype) == (here.shape, here.dtype)


def test_loss_and_priorities_come_back_together() -> None:
    loss, priorities = transfer.from_device(th.tensor(2.0), th.arange(3.0))
    assert loss == 2.0
    np.testing.assert_array_equal(priorities, [0.0, 1.0, 2.0])
