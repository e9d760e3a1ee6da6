"""A second, independent formulation of the 3-RRS in numpy and scipy, to test against.

Nothing here is shared with :mod:`coop_env.kinematics`: the pose comes from the Euler form with its
parasitic yaw and a linear solve of the limb planes, the twist from LAPACK's solver, the singular
values from batched SVD.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import label
from scipy.spatial.transform import Rotation

from coop_env.geometry import DeltaGeometry, RRSGeometry

Floats = NDArray[np.float64]

# a Delta whose limbs also reach places above its knees' plane, within the paper's bounds
FOLDING = DeltaGeometry(0.2333, 0.0439, proximal_length=0.205, distal_length=0.3132)
# a 3-RRS so low that a joint dips below the base's plane, inside of its base joint
FLAT = RRSGeometry(
    0.397, 0.2705, 0.1867, 0.4055, heave_min=0.0214, heave_max=0.06, home_heave=0.0214
)
_AZIMUTHS = np.radians([0.0, 120.0, 240.0])
RADIAL = np.stack([np.cos(_AZIMUTHS), np.sin(_AZIMUTHS), np.zeros(3)], axis=-1)
TANGENTIAL = np.stack([-np.sin(_AZIMUTHS), np.cos(_AZIMUTHS), np.zeros(3)], axis=-1)
_UP = np.array([0.0, 0.0, 1.0])


class ReferenceState(NamedTuple):
    """Poses and what follows from them; the leading axes are the batch."""

    position: Floats  # (..., 3) platform centre, m
    rotation: Floats  # (..., 3, 3)
    q: Floats  # (..., 3) actuated angles, rad; NaN if unreachable
    reachable: NDArray[np.bool_]  # (...)
    jacobian: Floats  # (..., 3, 3); NaN if unreachable
    det_a: Floats  # (...) determinant of A, m^3


def platform_pose(rph: Floats, geometry: RRSGeometry) -> tuple[Floats, Floats]:
    """Centre and rotation at (roll, pitch, heave): Rx Ry Rz(yaw), then x and y from the planes."""
    roll, pitch, heave = np.moveaxis(np.asarray(rph, dtype=float), -1, 0)
    yaw = -np.arctan2(np.sin(roll) * np.sin(pitch), np.cos(roll) + np.cos(pitch))
    angles = np.stack([roll, pitch, yaw], axis=-1).reshape(-1, 3)
    rotation = Rotation.from_euler("XYZ", angles).as_matrix().reshape(*roll.shape, 3, 3)
    joints = geometry.platform_radius * np.einsum("...ab,ib->...ia", rotation, RADIAL)
    # t_i . (P + r_i) = 0 on limbs 0 and 1 gives x and y; limb 2 is left over as a check.
    out_of_plane = np.einsum("...ia,ia->...i", joints, TANGENTIAL)
    xy = np.linalg.solve(TANGENTIAL[:2, :2], -out_of_plane[..., :2, None])[..., 0]
    return np.concatenate([xy, heave[..., None]], axis=-1), rotation


def evaluate(rph: Floats, geometry: RRSGeometry) -> ReferenceState:
    """All of it at poses ``(..., 3)`` of (roll, pitch, heave)."""
    g = geometry
    position, rotation = platform_pose(rph, g)
    r = g.platform_radius * np.einsum("...ab,ib->...ia", rotation, RADIAL)
    from_base = position[..., None, :] + r - g.base_radius * RADIAL
    reach = np.linalg.norm(from_base, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        at_base = np.arccos(
            (g.proximal_length**2 + reach**2 - g.distal_length**2) / (2 * g.proximal_length * reach)
        )
    q = np.arctan2(from_base[..., 2], np.einsum("...ia,ia->...i", from_base, RADIAL)) - at_base
    q = np.angle(np.exp(1j * q))  # where the crank points, whatever the turns
    reachable = np.isfinite(q).all(axis=-1)

    safe = np.where(reachable[..., None], q, 0.0)
    crank = np.cos(safe)[..., None] * RADIAL + np.sin(safe)[..., None] * _UP
    swing = -np.sin(safe)[..., None] * RADIAL + np.cos(safe)[..., None] * _UP
    distal = (from_base - g.proximal_length * crank) / g.distal_length
    b = g.proximal_length * np.sum(distal * swing, axis=-1)

    # Wrench rows on the twist (v, w): actuation rows [d, r x d], constraint rows [t, r x t].
    tangential = np.broadcast_to(TANGENTIAL, r.shape)
    actuation = np.concatenate([distal, np.cross(r, distal)], axis=-1)
    constraint = np.concatenate([tangential, np.cross(r, tangential)], axis=-1)
    dependent, free = [0, 1, 5], [3, 4, 2]  # (vx, vy, wz) follow from (wx, wy, vz)
    follow = -np.linalg.solve(constraint[..., dependent], constraint[..., free])
    a = actuation[..., free] + actuation[..., dependent] @ follow
    a = a * np.array([1.0, 1.0, g.characteristic_length])
    a[~reachable] = np.nan
    with np.errstate(invalid="ignore"):
        det_a = np.linalg.det(a)
    return ReferenceState(position, rotation, q, reachable, a / b[..., None], det_a)


def signed_sigma_min(state: ReferenceState, geometry: RRSGeometry) -> Floats:
    """Least singular value by LAPACK, with the sign of det A relative to home; NaN out of reach."""
    home = evaluate(np.array([0.0, 0.0, geometry.home_heave]), geometry)
    sigma = np.full(state.reachable.shape, np.nan)
    ok = state.reachable
    sigma[ok] = np.linalg.svd(state.jacobian[ok], compute_uv=False)[..., -1]
    return np.copysign(sigma, state.det_a * home.det_a)


def workspace_map(geometry: RRSGeometry, cells: int = 120) -> tuple[Floats, NDArray[np.bool_]]:
    """Signed sigma_min over the cell centres of +-60 degrees, and the cells of the component."""
    edge = np.pi / 3
    centres = (np.arange(cells) + 0.5) * (2 * edge / cells) - edge
    roll, pitch = np.meshgrid(centres, centres, indexing="ij")
    rph = np.stack([roll, pitch, np.full_like(roll, geometry.home_heave)], axis=-1)
    state = evaluate(rph, geometry)
    sigma = signed_sigma_min(state, geometry)
    with np.errstate(invalid="ignore"):
        inside = (state.q >= geometry.joint_min) & (state.q <= geometry.joint_max)
        allowed = inside.all(axis=-1) & (sigma >= 0.15)
    components, _ = label(allowed)
    home = components[cells // 2, cells // 2]
    return sigma, (components == home) & (home > 0)
