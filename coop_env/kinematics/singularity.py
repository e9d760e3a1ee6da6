"""Linear algebra on vectors and 3 x 3 matrices as tuples, and measures of Jacobians.

Singular values come from one-sided Jacobi rotations. The closed form through the
characteristic polynomial of J^T J is faster by a little but loses half the digits at a repeated
singular value, which every symmetric pose of a 3-RRS has. Jacobi keeps them all, and converges here
in three or four sweeps.
"""

import math

from coop_env.compilation import njit

Row = tuple[float, float, float]
Matrix3 = tuple[Row, Row, Row]

_MAX_SWEEPS = 30
_ORTHOGONAL = 1e-30  # squared cosine between columns


@njit(cache=True)
def minus(a: Row, b: Row) -> Row:
    """a - b."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True)
def dot(a: Row, b: Row) -> float:
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(cache=True)
def cross(a: Row, b: Row) -> Row:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(cache=True)
def _rotate(a: Row, b: Row) -> tuple[Row, Row, bool]:
    """Rotate columns ``a`` and ``b`` within their plane until they are orthogonal."""
    aa, bb, ab = dot(a, a), dot(b, b), dot(a, b)
    if ab * ab <= _ORTHOGONAL * (aa * bb):
        return a, b, False
    # tan of the angle from the Gram entries; this form has one root and one quotient to wait for
    d, h = bb - aa, 2.0 * ab
    t = math.copysign(1.0, d) * h / (abs(d) + math.sqrt(d * d + h * h))
    c = 1.0 / math.sqrt(1.0 + t * t)
    s = c * t
    new_a = (c * a[0] - s * b[0], c * a[1] - s * b[1], c * a[2] - s * b[2])
    new_b = (s * a[0] + c * b[0], s * a[1] + c * b[1], s * a[2] + c * b[2])
    return new_a, new_b, True


@njit(cache=True)
def singular_values_3x3(rows: Matrix3) -> Row:
    """Singular values, descending, of the matrix with the given rows."""
    c0 = (rows[0][0], rows[1][0], rows[2][0])
    c1 = (rows[0][1], rows[1][1], rows[2][1])
    c2 = (rows[0][2], rows[1][2], rows[2][2])
    for _ in range(_MAX_SWEEPS):
        c0, c1, r01 = _rotate(c0, c1)
        c0, c2, r02 = _rotate(c0, c2)
        c1, c2, r12 = _rotate(c1, c2)
        if not (r01 or r02 or r12):
            break
    s0, s1, s2 = math.sqrt(dot(c0, c0)), math.sqrt(dot(c1, c1)), math.sqrt(dot(c2, c2))
    high, low = max(s0, s1, s2), min(s0, s1, s2)
    return high, s0 + s1 + s2 - high - low, low


@njit(cache=True)
def determinant_3x3(rows: Matrix3) -> float:
    """Determinant of the matrix with the given rows."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


@njit(cache=True)
def manipulability(a: Matrix3, b: Row, sign: float) -> tuple[Matrix3, float, float]:
    """J = B^-1 A by rows, its least singular value with the sign of ``sign det A``, and kappa.

    A is given by rows, B by its diagonal. All but J are NaN at a type I (serial) singularity,
    where J is infinite.
    """
    if b[0] == 0.0 or b[1] == 0.0 or b[2] == 0.0:
        inf, nan = (math.inf, math.inf, math.inf), math.nan
        return (inf, inf, inf), nan, nan
    (a00, a01, a02), (a10, a11, a12), (a20, a21, a22) = a
    j = (
        (a00 / b[0], a01 / b[0], a02 / b[0]),
        (a10 / b[1], a11 / b[1], a12 / b[1]),
        (a20 / b[2], a21 / b[2], a22 / b[2]),
    )
    most, _, least = singular_values_3x3(j)
    kappa = most / least if least != 0.0 else math.inf
    return j, math.copysign(least, determinant_3x3(a) * sign), kappa


@njit(cache=True)
def is_manipulable(a: Matrix3, b: Row, sign: float, threshold: float) -> bool:
    """Whether the signed sigma_min of :func:`manipulability` is at least a positive threshold.

    That is so if det A has the given sign and ``J^T J - threshold^2`` is positive definite, which
    its leading minors show in a fraction of the time.
    """
    (a00, a01, a02), (a10, a11, a12), (a20, a21, a22) = a
    if b[0] == 0.0 or b[1] == 0.0 or b[2] == 0.0 or determinant_3x3(a) * sign <= 0.0:
        return False
    x = (a00 / b[0], a10 / b[1], a20 / b[2])
    y = (a01 / b[0], a11 / b[1], a21 / b[2])
    z = (a02 / b[0], a12 / b[1], a22 / b[2])
    least, xy, xz, yz = threshold * threshold, dot(x, y), dot(x, z), dot(y, z)
    xx, yy, zz = dot(x, x) - least, dot(y, y) - least, dot(z, z) - least
    gram = (xx, xy, xz), (xy, yy, yz), (xz, yz, zz)
    return xx > 0.0 and xx * yy - xy * xy > 0.0 and determinant_3x3(gram) >= 0.0


@njit(cache=True)
def solve_3x3(m: Matrix3, b: Row) -> Row:
    """The x of ``m x = b`` by Cramer's rule; NaN where m is singular."""
    det = determinant_3x3(m)
    if det == 0.0:
        return math.nan, math.nan, math.nan
    (a00, a01, a02), (a10, a11, a12), (a20, a21, a22) = m
    d0 = determinant_3x3(((b[0], a01, a02), (b[1], a11, a12), (b[2], a21, a22)))
    d1 = determinant_3x3(((a00, b[0], a02), (a10, b[1], a12), (a20, b[2], a22)))
    d2 = determinant_3x3(((a00, a01, b[0]), (a10, a11, b[1]), (a20, a21, b[2])))
    return d0 / det, d1 / det, d2 / det
