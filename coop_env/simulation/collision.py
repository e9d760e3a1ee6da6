"""Analytic collision test of the two robots, scalar kernels.

The Delta's peg and forearms are capsules, its effector is a sphere. The 3-RRS's dome is a sphere;
both links and three spokes from the platform's centre to its spherical joints are capsules.
The peg may enter the dome through a hole's mouth, chamfer included.
"""

import math

from coop_env.compilation import njit
from coop_env.kinematics import rrs_kernels
from coop_env.kinematics.delta_kernels import DeltaParams
from coop_env.kinematics.rrs_kernels import LIMB_COS, LIMB_SIN, Pose
from coop_env.kinematics.singularity import Row, dot, minus
from coop_env.simulation.task import EnvParams, TaskParams


@njit(cache=True)
def _clamp(value: float) -> float:
    return min(max(value, 0.0), 1.0)


@njit(cache=True)
def point_segment_distance(point: Row, a: Row, b: Row) -> float:
    """Distance from a point to the segment a-b, m; a and b may coincide."""
    along, to = minus(b, a), minus(point, a)
    length2 = dot(along, along)
    t = _clamp(dot(to, along) / length2) if length2 > 0.0 else 0.0
    gap = (to[0] - t * along[0], to[1] - t * along[1], to[2] - t * along[2])
    return math.sqrt(dot(gap, gap))


@njit(cache=True)
def segment_distance(a: Row, b: Row, c: Row, d: Row) -> float:
    """Least distance between the segments a-b and c-d, m (closest points, clamped in turn)."""
    u, v, w = minus(b, a), minus(d, c), minus(a, c)
    uu, vv = dot(u, u), dot(v, v)
    if uu == 0.0:
        return point_segment_distance(a, c, d)
    if vv == 0.0:
        return point_segment_distance(c, a, b)
    uv, uw, vw = dot(u, v), dot(u, w), dot(v, w)
    det = uu * vv - uv * uv
    s = 0.0
    if det > 1e-14 * uu * vv:  # parallel otherwise: any s will do to start from
        s = _clamp((uv * vw - vv * uw) / det)
    t = (uv * s + vw) / vv
    if t < 0.0:
        t, s = 0.0, _clamp(-uw / uu)
    elif t > 1.0:
        t, s = 1.0, _clamp((uv - uw) / uu)
    gap = (w[0] + s * u[0] - t * v[0], w[1] + s * u[1] - t * v[1], w[2] + s * u[2] - t * v[2])
    return math.sqrt(dot(gap, gap))


@njit(cache=True)
def peg_tip(x: float, y: float, z: float, p: DeltaParams) -> Row:
    """Tip of the peg in the world frame, from the effector in the Delta's frame."""
    return x, y, z + p.base_height - p.peg_length


@njit(cache=True)
def hole(pose: Pose, index: int, p: EnvParams) -> tuple[Row, Row]:
    """Mouth (m) and outward unit normal of a hole, world frame."""
    n = p.layout.normals
    nx, ny, nz = n[index, 0], n[index, 1], n[index, 2]
    normal = (
        pose.r00 * nx + pose.r01 * ny + pose.r02 * nz,
        pose.r10 * nx + pose.r11 * ny + pose.r12 * nz,
        pose.r20 * nx + pose.r21 * ny + pose.r22 * nz,
    )
    r = p.layout.dome_radius
    return (pose.x + r * normal[0], pose.y + r * normal[1], pose.z + r * normal[2]), normal


@njit(cache=True)
def in_opening(tip: Row, pose: Pose, radius: float, p: EnvParams) -> bool:
    """Whether the tip lies within a radius of any hole's mouth."""
    for i in range(p.layout.n_holes):
        to_mouth = minus(tip, hole(pose, i, p)[0])
        if math.sqrt(dot(to_mouth, to_mouth)) < radius:
            return True
    return False


@njit(cache=True)
def arm_points(
    x: float, y: float, z: float, theta: Row, limb: int, p: DeltaParams
) -> tuple[Row, Row, Row]:
    """Base joint, knee and effector joint of a Delta limb, world frame, m."""
    c, s = LIMB_COS[limb], LIMB_SIN[limb]
    reach = p.base_radius + p.proximal_length * math.cos(theta[limb])
    drop = p.proximal_length * math.sin(theta[limb])
    return (
        (p.base_radius * c, p.base_radius * s, p.base_height),
        (reach * c, reach * s, p.base_height - drop),
        (x + p.effector_radius * c, y + p.effector_radius * s, z + p.base_height),
    )


@njit(cache=True)
def on_base(point: Row, t: TaskParams) -> Row:
    """A point of the 3-RRS's base frame, m, where the base really stands."""
    x, y, z = point
    return (
        t.base_x + t.cos_pitch * x + t.sin_pitch * z,
        t.base_y + t.sin_roll * t.sin_pitch * x + t.cos_roll * y - t.sin_roll * t.cos_pitch * z,
        t.base_z - t.cos_roll * t.sin_pitch * x + t.sin_roll * y + t.cos_roll * t.cos_pitch * z,
    )


@njit(cache=True)
def _capsule_hits_limbs(a: Row, b: Row, radius: float, pose: Pose, q: Row, p: EnvParams) -> bool:
    """Whether a capsule touches a platform spoke or a link of the 3-RRS."""
    centre = (pose.x, pose.y, pose.z)
    spoke, link = radius + p.layout.spoke_radius, radius + p.layout.limb_radius
    for limb in range(3):
        base, elbow, joint = rrs_kernels.limb_points(pose, q[limb], limb, p.rrs)
        if p.task.imperfect:  # the pose is already displaced
            base, elbow = on_base(base, p.task), on_base(elbow, p.task)
        if segment_distance(a, b, centre, joint) < spoke:
            return True
        if segment_distance(a, b, elbow, joint) < link:
            return True
        if segment_distance(a, b, base, elbow) < link:
            return True
    return False


@njit(cache=True)
def ceiling(heave: float, p: EnvParams) -> float:
    """A height above every part of the 3-RRS, m."""
    thick = max(p.layout.spoke_radius, p.layout.limb_radius)  # both end at the platform's joints
    above = max(p.layout.dome_radius, p.rrs.platform_radius + thick)
    lean = abs(p.task.sin_roll) + abs(p.task.sin_pitch)
    rise = abs(p.task.base_z) + lean * (p.rrs.base_radius + p.rrs.proximal_length)
    return max(heave + above, p.rrs.proximal_length + p.layout.limb_radius + rise)


@njit(cache=True)
def _lowest_arm(z: float, p: EnvParams) -> float:
    """A height below every part of the Delta but the peg, m; knees may hang lowest."""
    height, forearm = p.delta.base_height, p.layout.forearm_radius
    effector = z + height - max(p.layout.effector_radius, forearm)
    return min(effector, height - p.delta.proximal_length - forearm)


@njit(cache=True)
def lowest(z: float, p: EnvParams) -> float:
    """A height below every part of the Delta, m: the tip's, unless the peg is short."""
    return min(peg_tip(0.0, 0.0, z, p.delta)[2], _lowest_arm(z, p))


@njit(cache=True)
def below_ceiling(c: tuple[float, float, float, float, float, float], p: EnvParams) -> bool:
    """Whether anything of the Delta reaches low enough to touch anything of the 3-RRS."""
    return lowest(c[2], p) < ceiling(c[5], p)


@njit(cache=True)
def collides(x: float, y: float, z: float, theta: Row, pose: Pose, q: Row, p: EnvParams) -> bool:
    """Whether the two robots touch; ``theta`` and ``q`` must be the joint angles of the poses."""
    if lowest(z, p) >= ceiling(pose.z, p):
        return False
    tip = peg_tip(x, y, z, p.delta)
    # The bore takes the peg, and the chamfer is as much wider all round as its width.
    opening = p.task.chamfer + p.delta.peg_radius
    if peg_meets_dome(x, y, z, pose, p) and not in_opening(tip, pose, opening, p):
        return True
    return collides_elsewhere(x, y, z, theta, pose, q, p)


@njit(cache=True)
def _peg(x: float, y: float, z: float, p: EnvParams) -> tuple[Row, Row]:
    """Ends of the peg's capsule, m: the cap about the lower one ends at the tip."""
    tip = peg_tip(x, y, z, p.delta)
    return (tip[0], tip[1], tip[2] + p.delta.peg_radius), (x, y, z + p.delta.base_height)


@njit(cache=True)
def peg_meets_dome(x: float, y: float, z: float, pose: Pose, p: EnvParams) -> bool:
    """Whether the peg reaches into the dome, through a hole or not."""
    end, effector = _peg(x, y, z, p)
    near = p.layout.dome_radius + p.delta.peg_radius
    return point_segment_distance((pose.x, pose.y, pose.z), end, effector) < near


@njit(cache=True)
def collides_elsewhere(
    x: float, y: float, z: float, theta: Row, pose: Pose, q: Row, p: EnvParams
) -> bool:
    """Whether the robots touch otherwise than with the peg on the dome."""
    end, effector = _peg(x, y, z, p)
    if _capsule_hits_limbs(end, effector, p.delta.peg_radius, pose, q, p):
        return True
    if _lowest_arm(z, p) >= ceiling(pose.z, p):
        return False
    centre = (pose.x, pose.y, pose.z)
    dome, body, forearm = p.layout.dome_radius, p.layout.effector_radius, p.layout.forearm_radius
    if point_segment_distance(centre, effector, effector) < dome + body:
        return True
    if _capsule_hits_limbs(effector, effector, body, pose, q, p):
        return True
    for limb in range(3):
        _, knee, joint = arm_points(x, y, z, theta, limb, p.delta)
        if point_segment_distance(centre, knee, joint) < dome + forearm:
            return True
        if _capsule_hits_limbs(knee, joint, forearm, pose, q, p):
            return True
    return False
