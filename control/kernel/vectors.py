"""Vectors, rotations and inertia tensors as scalars and tuples, which a kernel can keep in registers."""

from __future__ import annotations

import math

from maxq.control.kernel.jit import formula, kernel
from maxq.control.kernel.records import Array

Vector = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]


@kernel
def vector_at(values: Array, first: int) -> Vector:
    """Return three adjacent components of an array."""
    return values[first], values[first + 1], values[first + 2]


@kernel
def set_vector(values: Array, first: int, a: Vector) -> None:
    """Write the three components of `a` into adjacent elements of an array."""
    values[first], values[first + 1], values[first + 2] = a[0], a[1], a[2]


@formula
def cross(a: Vector, b: Vector) -> Vector:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@formula
def dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@formula
def add(a: Vector, b: Vector) -> Vector:
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@formula
def scaled(k: float, a: Vector) -> Vector:
    return (k * a[0], k * a[1], k * a[2])


@formula
def norm(a: Vector) -> float:
    return math.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


_S = (-1 / 6, 1 / 120, -1 / 5040, 1 / 362880, -1 / 39916800)  # Taylor coefficients of sin(x)/x and cos(x)
_C = (-1 / 2, 1 / 24, -1 / 720, 1 / 40320, -1 / 3628800, 1 / 479001600)


@kernel
def sine_cosine(x: float) -> tuple[float, float]:
    """Return sin(x) and cos(x) of `x` in rad.

    For |x| <= 0.25, the range of a gimbal, they are Taylor series accurate to rounding; beyond, they are library
    functions.
    """
    if abs(x) > 0.25:
        return math.sin(x), math.cos(x)
    t = x * x
    sine = 1.0 + t * (_S[0] + t * (_S[1] + t * (_S[2] + t * (_S[3] + t * _S[4]))))
    cosine = 1.0 + t * (_C[0] + t * (_C[1] + t * (_C[2] + t * (_C[3] + t * (_C[4] + t * _C[5])))))
    return x * sine, cosine


@kernel
def rotation_from_quaternion(w: float, x: float, y: float, z: float) -> Matrix:
    """Return the rotation matrix from B to I; its error is of first order in the deviation of the norm from one."""
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@kernel
def rotate(m: Matrix, a: Vector) -> Vector:
    """Return m a, which for the matrix of an attitude transforms `a` from B to I."""
    return (
        m[0] * a[0] + m[1] * a[1] + m[2] * a[2],
        m[3] * a[0] + m[4] * a[1] + m[5] * a[2],
        m[6] * a[0] + m[7] * a[1] + m[8] * a[2],
    )


@kernel
def rotate_back(m: Matrix, a: Vector) -> Vector:
    """Return m' a, which for the matrix of an attitude transforms `a` from I to B."""
    return (
        m[0] * a[0] + m[3] * a[1] + m[6] * a[2],
        m[1] * a[0] + m[4] * a[1] + m[7] * a[2],
        m[2] * a[0] + m[5] * a[1] + m[8] * a[2],
    )


Quaternion = tuple[float, float, float, float]


@kernel
def quaternion_at(values: Array, first: int) -> Quaternion:
    """Return four adjacent components of an array, scalar first."""
    return values[first], values[first + 1], values[first + 2], values[first + 3]


@kernel
def quaternion_product(a: Quaternion, b: Quaternion) -> Quaternion:
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@kernel
def conjugate(q: Quaternion) -> Quaternion:
    return (q[0], -q[1], -q[2], -q[3])


@kernel
def quaternion_of(rotation_vector: Vector) -> Quaternion:
    """Return the unit quaternion of a rotation vector in rad."""
    half = 0.5 * norm(rotation_vector)
    if half == 0.0:
        return (1.0, 0.0, 0.0, 0.0)
    sine, cosine = sine_cosine(half)
    k = 0.5 * sine / half
    return (cosine, k * rotation_vector[0], k * rotation_vector[1], k * rotation_vector[2])


@kernel
def roll_and_tilt(q: Quaternion) -> Vector:
    """Return roll and tilt (about y and z) of a unit quaternion from B to C, rad.

    The roll is about x. The tilt is the rotation vector, in axes y and z of B, that turns x of C to x of B. The result
    equals the rotation vector in B for small angles, and for rotations about x or about an axis perpendicular to x.
    """
    w, x, y, z = q
    sine_y, sine_z = 2.0 * (x * z + w * y), 2.0 * (w * z - x * y)
    sine, cosine = math.sqrt(sine_y * sine_y + sine_z * sine_z), w * w + x * x - y * y - z * z
    if sine < 1e-4 and cosine > 0.0:
        k = 1.0 + sine * sine / 6.0  # the series of asin(x)/x, here exact to rounding
    else:
        k = math.atan2(sine, cosine) / max(sine, 1e-9)  # opposite axes: any axis of rotation is valid
    return (2.0 * math.atan2(x, w) if w >= 0.0 else 2.0 * math.atan2(-x, -w), k * sine_y, k * sine_z)


Symmetric = tuple[float, float, float, float, float, float]  # xx, yy, zz, xy, xz, yz (of an inertia, its *integrals*)


@kernel
def symmetric_at(values: Array, first: int) -> Symmetric:
    """Return six adjacent components of an array, in the order of `Symmetric`."""
    i = first
    return values[i], values[i + 1], values[i + 2], values[i + 3], values[i + 4], values[i + 5]


@kernel
def inertia_times(j: Symmetric, w: Vector) -> Vector:
    """Return the product of the inertia tensor and a vector; the tensor contains the products with a minus sign."""
    return (
        j[0] * w[0] - j[3] * w[1] - j[4] * w[2],
        -j[3] * w[0] + j[1] * w[1] - j[5] * w[2],
        -j[4] * w[0] - j[5] * w[1] + j[2] * w[2],
    )


@kernel
def inverse_inertia(j: Symmetric) -> Symmetric:
    """Return the inverse of the inertia tensor as a symmetric matrix.

    Its elements are in the order xx, yy, zz, xy, xz, yz, without changes of sign.
    """
    a, b, c, d, e, f = j[0], j[1], j[2], -j[3], -j[4], -j[5]
    xx, yy, zz = b * c - f * f, a * c - e * e, a * b - d * d
    xy, xz, yz = e * f - d * c, d * f - e * b, d * e - a * f
    k = 1.0 / (a * xx + d * xy + e * xz)
    return (k * xx, k * yy, k * zz, k * xy, k * xz, k * yz)


@kernel
def symmetric_times(m: Symmetric, a: Vector) -> Vector:
    return (
        m[0] * a[0] + m[3] * a[1] + m[4] * a[2],
        m[3] * a[0] + m[1] * a[1] + m[5] * a[2],
        m[4] * a[0] + m[5] * a[1] + m[2] * a[2],
    )
