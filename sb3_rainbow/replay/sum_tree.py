"""Sum tree in level order: samples in proportion to a million priorities in microseconds.

Every node has eight children, so that the children of a node share one cache line and a million
leaves are seven levels deep. A batch goes down (or up) one level at a time: the memory accesses of
one level do not depend on each other, and the processor overlaps their latencies.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sb3_rainbow.replay.compilation import njit

FAN_OUT = 8
_SHIFT = 3
_CACHE_LINE = 64


@njit(cache=True)
def _find(
    tree: NDArray[np.float64],
    offsets: NDArray[np.int64],
    remainders: NDArray[np.float64],
    leaves: NDArray[np.int64],
) -> None:
    """Leaf in whose interval of the cumulated priorities each remainder lies; works in place."""
    n = remainders.shape[0]
    for i in range(n):
        leaves[i] = 0
    for level in range(offsets.shape[0] - 2, -1, -1):
        base = offsets[level]
        for i in range(n):
            first = base + (leaves[i] << _SHIFT)
            remainder = remainders[i]
            chosen = -1
            last_filled = 0
            for child in range(FAN_OUT):
                mass = tree[first + child]
                if remainder < mass:
                    chosen = child
                    break
                if mass > 0.0:
                    last_filled = child
                remainder -= mass
            if chosen < 0:
                # Rounding pushed the remainder past the node: an empty leaf must not be drawn.
                chosen = last_filled
                remainder = tree[first + chosen]
            leaves[i] = (leaves[i] << _SHIFT) + chosen
            remainders[i] = remainder


@njit(cache=True)
def _assign(
    tree: NDArray[np.float64],
    offsets: NDArray[np.int64],
    leaves: NDArray[np.int64],
    values: NDArray[np.float64],
) -> None:
    """Write leaves, then recompute (never increment) the sums above them, level by level."""
    n = leaves.shape[0]
    nodes = np.empty(n, np.int64)
    for i in range(n):
        tree[leaves[i]] = values[i]
        nodes[i] = leaves[i]
    for level in range(1, offsets.shape[0]):
        below = offsets[level - 1]
        here = offsets[level]
        previous = np.int64(-1)
        for i in range(n):
            parent = nodes[i] >> _SHIFT
            nodes[i] = parent
            if parent == previous:
                continue
            previous = parent
            first = below + (parent << _SHIFT)
            mass = 0.0
            for child in range(FAN_OUT):
                mass += tree[first + child]
            tree[here + parent] = mass


def _level_offsets(capacity: int) -> NDArray[np.int64]:
    """Start of each level in the flat array, leaves first; the last entry is the root."""
    offsets = [0]
    size = capacity
    while size > 1:
        padded = -(-size // FAN_OUT) * FAN_OUT
        offsets.append(offsets[-1] + padded)
        size = padded // FAN_OUT
    return np.asarray(offsets, dtype=np.int64)


def _aligned_zeros(size: int) -> NDArray[np.float64]:
    """Zeros whose first element starts a cache line."""
    raw = np.zeros(size + _CACHE_LINE // 8, dtype=np.float64)
    shift = (-raw.ctypes.data % _CACHE_LINE) // 8
    return raw[shift : shift + size]


class SumTree:
    """Sum tree of ``capacity`` leaves: samples indices in proportion to priority, in O(log n)."""

    def __init__(self, capacity: int) -> None:
        if capacity < 1:
            raise ValueError(f"SumTree needs a capacity of at least 1, got {capacity}")
        self.capacity = int(capacity)
        self._offsets = _level_offsets(max(self.capacity, 2))
        self._tree = _aligned_zeros(int(self._offsets[-1]) + 1)

    @property
    def total(self) -> float:
        """Sum of all leaves."""
        return float(self._tree[-1])

    @property
    def nbytes(self) -> int:
        """Bytes of all nodes."""
        return self._tree.nbytes

    @property
    def leaves(self) -> NDArray[np.float64]:
        """All priorities, shape ``(capacity,)``; a view, to read only."""
        return self._tree[: self.capacity]

    def set(self, indices: NDArray[np.int64], values: NDArray[np.float64]) -> None:
        """Write priorities and renew the sums; of a repeated index the last value counts.

        Neither leaves ``(n,)`` nor priorities ``(n,)``, finite and >= 0, are checked.
        """
        _assign(self._tree, self._offsets, indices, values)

    def find(self, prefix_sums: NDArray[np.float64]) -> NDArray[np.int64]:
        """Leaves ``(n,)`` whose intervals of the cumulated priorities hold sums ``(n,)`` in ``[0,
        total)``; never a leaf of priority zero while ``total > 0``.
        """
        leaves = np.empty(prefix_sums.shape[0], dtype=np.int64)
        _find(self._tree, self._offsets, prefix_sums.copy(), leaves)
        return leaves

    def sample(self, batch_size: int) -> NDArray[np.int64]:
        """Draw one leaf from each of ``batch_size`` equal parts of the total (Schaul et al. 2016,
        appendix B.2.1), by numpy's global generator, which SB3 seeds; shape ``(batch_size,)``.

        Raises:
            ValueError: if all priorities are zero.
        """
        if self._tree[-1] <= 0.0:
            raise ValueError("Cannot sample from a SumTree whose priorities are all zero")
        places = np.random.random_sample(batch_size) + np.arange(batch_size)  # noqa: NPY002
        return self.find(places * (self._tree[-1] / batch_size))

    def __getstate__(self) -> dict[str, Any]:
        # Trailing zeros (a buffer that is not full yet) need no room in the file.
        used = np.flatnonzero(self.leaves)
        n_used = int(used[-1]) + 1 if used.size else 0
        return {"capacity": self.capacity, "leaves": self.leaves[:n_used].copy()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        SumTree.__init__(self, state["capacity"])
        leaves = state["leaves"]
        if leaves.size:
            self.set(np.arange(leaves.size, dtype=np.int64), leaves)
