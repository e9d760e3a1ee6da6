"""Ring of observations in which each one is stored once."""

from typing import Any, TypeAlias

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from sb3_rainbow.type_aliases import ObsArray

# One store for plain observations, one per key for dicts.
_PLAIN = ""

Rows: TypeAlias = dict[str, NDArray]


class ObservationStore:
    """Observations of ``n_envs`` environments in ``n_rows`` steps, whatever their space.

    The observation after a step is the next row's, save in two cases, for which a growing boundary
    store holds it: where an episode ended (autoreset replaces its last observation) and at the
    newest step of all. ``obs_shape`` is the space's, as SB3's buffers compute it.
    """

    def __init__(
        self,
        n_rows: int,
        n_envs: int,
        observation_space: spaces.Space,
        obs_shape: tuple[int, ...] | dict[str, tuple[int, ...]],
    ) -> None:
        self.n_rows = n_rows
        self.n_envs = n_envs
        parts = {_PLAIN: observation_space}
        if isinstance(observation_space, spaces.Dict):
            parts = observation_space.spaces
        shapes = obs_shape if isinstance(obs_shape, dict) else {_PLAIN: obs_shape}
        self._layout = {key: (shapes[key], np.dtype(part.dtype)) for key, part in parts.items()}
        self._rows = self._zeros((n_rows, n_envs))
        # The first n_envs slots hold the newest observations; the others, terminal observations.
        self._boundary = self._zeros((2 * n_envs,))
        self._free_slots = list(range(n_envs, 2 * n_envs))
        self.slots = np.full((n_rows, n_envs), -1, dtype=np.int32)

    def _zeros(self, leading: tuple[int, ...]) -> Rows:
        return {
            key: np.zeros(leading + shape, dtype=dtype)
            for key, (shape, dtype) in self._layout.items()
        }

    @property
    def nbytes(self) -> int:
        """Bytes of the ring, full or not, and of the boundary store as large as it is now."""
        stores = [*self._rows.values(), *self._boundary.values(), self.slots]
        return sum(values.nbytes for values in stores)

    @property
    def rows(self) -> ObsArray:
        """What is stored, shape ``(n_rows, n_envs, ...)``, or a dict of such."""
        return self._rows.get(_PLAIN, self._rows)

    def cast(self, obs: ObsArray) -> Rows:
        """Observations of one step by store, typed as stored.

        Raises:
            ValueError: for observations of another shape than the space's.
        """
        parts = obs if isinstance(obs, dict) else {_PLAIN: obs}
        rows: Rows = {}
        for key, (shape, dtype) in self._layout.items():
            values = np.ascontiguousarray(parts[key], dtype=dtype)
            expected = (self.n_envs, *shape)
            if shape == (1,) and dtype.kind in "iu" and values.shape == (self.n_envs,):
                values = values[:, None]  # discrete ones have no axis of their own
            elif self.n_envs == 1 and values.shape == shape:
                values = values[None]  # one env's without the envs' axis, as SB3's buffers take it
            if values.shape != expected:
                name = f" {key!r}" if key else ""
                raise ValueError(
                    f"Observations{name} must have shape {expected} (envs first), got "
                    f"{values.shape}. A VecNormalize must be the outermost wrapper, around any "
                    "VecTransposeImage (the env's images have channels last) and VecFrameStack"
                )
            rows[key] = values
        return rows

    def interrupted(self, current: Rows) -> NDArray[np.bool_]:
        """Envs whose current observation is not the one that their last step led to, ``(n_envs,)``.

        Compared as bytes, so that NaN equals NaN.
        """
        result = np.zeros(self.n_envs, dtype=bool)
        for key, values in current.items():
            heads = self._boundary[key][: self.n_envs]
            differs = _as_bytes(values, self.n_envs) != _as_bytes(heads, self.n_envs)
            result |= differs.any(axis=1)
        return result

    def write(self, row: int, current: Rows, following: Rows) -> None:
        """Store a step: the observations before it, and those it led to as the newest."""
        for key, values in self._rows.items():
            values[row] = current[key]
            self._boundary[key][: self.n_envs] = following[key]

    def keep_newest(self, row: int, env: int) -> None:
        """Keep the env's newest observation as what the step in ``row`` led to."""
        if not self._free_slots:
            n_slots = len(next(iter(self._boundary.values())))
            more = min(n_slots, (self.n_rows + 1) * self.n_envs - n_slots)
            for key, values in self._boundary.items():
                self._boundary[key] = np.concatenate([values, np.zeros_like(values[:more])])
            self._free_slots = list(range(n_slots, n_slots + more))
        slot = self._free_slots.pop()
        for values in self._boundary.values():
            values[slot] = values[env]
        self.slots[row, env] = slot

    def release(self, row: int) -> None:
        """Free the boundary slots of a row that is about to be overwritten."""
        slots = self.slots[row]
        self._free_slots.extend(slots[slots >= 0].tolist())
        slots[:] = -1

    def gather(
        self, leaves: NDArray[np.int64], next_rows: NDArray[np.int64], next_slots: NDArray[np.int64]
    ) -> tuple[ObsArray, ObsArray]:
        """Observations at ``leaves``, and those ``next_slots`` (where >= 0) or ``next_rows`` name.

        Returns:
            two arrays ``(n, ...)``, or two dicts of such.
        """
        current: Rows = {}
        following: Rows = {}
        held = np.flatnonzero(next_slots >= 0)
        for key, values in self._rows.items():
            flat = values.reshape(values.shape[0] * values.shape[1], *values.shape[2:])
            current[key] = flat.take(leaves, axis=0)
            following[key] = flat.take(next_rows, axis=0)
            following[key][held] = self._boundary[key][next_slots[held]]
        return current.get(_PLAIN, current), following.get(_PLAIN, following)

    def trimmed_state(self, n_used: int) -> dict[str, Any]:
        """State for pickling, without the rows from ``n_used`` on, which were never written."""
        state = self.__dict__.copy()
        state["_rows"] = {key: values[:n_used] for key, values in self._rows.items()}
        state["slots"] = self.slots[:n_used]
        return state

    def restore_state(self, state: dict[str, Any]) -> None:
        """Undo :meth:`trimmed_state`."""
        self.__dict__.update(state)
        self._rows = {key: whole(values, self.n_rows) for key, values in self._rows.items()}
        self.slots = whole(self.slots + 1, self.n_rows) - 1  # -1 where nothing is stored


def whole(used: NDArray, n_rows: int) -> NDArray:
    """An array of ``n_rows`` rows from its used ones; the others take no memory yet."""
    result = np.zeros((n_rows, *used.shape[1:]), dtype=used.dtype)
    result[: len(used)] = used
    return result


def in_single(obs: ObsArray) -> ObsArray:
    """Observations as the networks take them: float32 in the place of float64."""
    if isinstance(obs, dict):
        return {key: in_single(part) for key, part in obs.items()}  # type: ignore[misc]
    return obs.astype(np.float32) if obs.dtype == np.float64 else obs


def _as_bytes(values: NDArray, n: int) -> NDArray[np.uint8]:
    """View of a contiguous array as ``n`` rows of bytes."""
    return values.reshape(n, -1).view(np.uint8)
