"""Vectors, quaternions and inertia of the kernels equal NumPy and SciPy's rotations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from maxq.control.kernel import vectors as v
from maxq.control.kernel.jit import entry
from maxq.control.kernel.records import Array

ROUNDING = 1e-14  # of a dozen products of numbers of order one


@entry
def _everything(out, a, b, q, p, j):  # type: ignore[no-untyped-def]  # Numba infers
    """Compile all functions at once; one row each."""
    a, b = (a[0], a[1], a[2]), (b[0], b[1], b[2])
    q, p = v.quaternion_at(q, 1), v.quaternion_at(p, 0)
    j = v.symmetric_at(j, 0)
    m = v.rotation_from_quaternion(q[0], q[1], q[2], q[3])
    sine, cosine = v.sine_cosine(a[0])
    rows = (
        v.cross(a, b),
        v.add(a, b),
        v.scaled(a[0], b),
        (v.norm(a), sine, cosine),
        v.rotate(m, a),
        v.rotate_back(m, a),
        v.inertia_times(j, a),
        v.symmetric_times(j, a),
        v.symmetric_times(v.inverse_inertia(j), v.inertia_times(j, a)),
    )
    for k in range(len(rows)):
        out[k, 0], out[k, 1], out[k, 2] = rows[k]
    fours = (v.quaternion_product(q, p), v.conjugate(q), v.quaternion_of(a))
    for k in range(len(fours)):
        out[len(rows) + k, 0], out[len(rows) + k, 1], out[len(rows) + k, 2], out[len(rows) + k, 3] = fours[k]


def _scalar_first(rotation: Rotation) -> Array:
    return np.roll(rotation.as_quat(), 1)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.2, 0.25, 1.4])
def test_kernels_equal_the_library(size: float) -> None:
    rng = np.random.default_rng(7)
    a, b = size * np.array([0.9, -0.3, 0.31]), np.array([0.4, 1.2, -0.7])
    turn, other = Rotation.from_rotvec(1.3 * size * np.array([0.3, -0.5, 0.6])), Rotation.from_rotvec([1.9, -0.8, 1.1])
    q, p = _scalar_first(turn), _scalar_first(other)
    # the tensor's products of inertia enter with a minus sign: integrals of x y, x z, y z
    j = np.array([2.0, 3.1, 4.3, 0.31, -0.42, 0.53])
    tensor = np.array([[j[0], -j[3], -j[4]], [-j[3], j[1], -j[5]], [-j[4], -j[5], j[2]]])
    symmetric = np.array([[j[0], j[3], j[4]], [j[3], j[1], j[5]], [j[4], j[5], j[2]]])
    out = rng.normal(size=(12, 4))
    _everything(out, a, b, np.append(9.0, q), p, j)
    threes = [
        np.cross(a, b),
        a + b,
        a[0] * b,
        [np.linalg.norm(a), math.sin(a[0]), math.cos(a[0])],
        turn.apply(a),
        turn.inv().apply(a),
        tensor @ a,
        symmetric @ a,
        a,
    ]
    assert out[:9, :3] == pytest.approx(np.array(threes), abs=ROUNDING)
    assert (
        np.abs(out[9] - _scalar_first(turn * other)).max() < ROUNDING
        or np.abs(out[9] + _scalar_first(turn * other)).max() < ROUNDING
    )  # either sign is the same rotation
    assert out[10] == pytest.approx([q[0], *-q[1:]], abs=0.0)
    assert out[11] == pytest.approx(_scalar_first(Rotation.from_rotvec(a)), abs=ROUNDING)


def test_no_series_is_seen_where_it_ends() -> None:
    """Sine and cosine are exact to rounding on both sides of 0.25 rad, where the series ends and the library begins."""
    out = np.zeros((12, 4))
    for x in (*np.linspace(-0.26, 0.26, 27), 0.25, math.nextafter(0.25, 1.0)):
        _everything(
            out,
            np.array([x, 0.0, 0.0]),
            np.ones(3),
            np.array([9.0, 1.0, 0.0, 0.0, 0.0]),
            np.eye(4)[0],
            np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]),
        )
        assert out[3, 1:3] == pytest.approx([math.sin(x), math.cos(x)], rel=2.3e-16, abs=0.0)
        assert out[3, 0] == abs(x)
