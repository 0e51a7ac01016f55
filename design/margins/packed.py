"""The response of a loop as numbers for compiled code, for a sampled loop with a law on the first gyro."""

from __future__ import annotations

import numpy as np
import scipy.linalg

from maxq.control.kernel.jit import entry
from maxq.control.kernel.records import Array
from maxq.design.laws.law import ANGLES, MEASUREMENTS
from maxq.design.loop.fixed_path import SampledFixedPath
from maxq.design.loop.loop import Loop, OpenLoop
from maxq.design.margins import response
from maxq.design.margins.response import LoopResponse, values_at
from maxq.design.model.state_space import ComplexArray, StateSpace, chain, zeros_and_poles

_SAME = 1e-9  # relative tolerance of the law's response from its zeros and poles
_SAME_LOOP = 1e-8  # tolerance of the whole response: at 1e-4 Hz the reference method loses eight digits of z - 1
_PROBES = 40


def controller_factors(loop: Loop) -> tuple[ComplexArray, ComplexArray, float]:
    """Return the zeros, the poles and the gain of the law with the integrators of the angle, in w = z - 1.

    Raises ValueError if they do not reproduce the law's response to nine digits.
    """
    period, wanted = loop.fixed.node.instruments.sample_s, loop.law.inputs
    sums = 1 + max((ANGLES.index(name) for name in wanted if name in ANGLES), default=-1)
    a, c = np.eye(sums), np.eye(sums)
    # an angle includes the increment of the present sample
    b, d = np.full((sums, 1), 0.0), np.full((sums, 1), 0.0)
    for k in range(sums):
        d[k] = b[k] = period ** (k + 1)
        for j in range(k):
            a[k, j] = c[k, j] = period ** (k - j)
    rows = dict(zip(ANGLES, range(sums), strict=False))
    pick_c = np.array([c[rows[name]] if name in rows else np.zeros(sums) for name in wanted])
    pick_d = np.array([d[rows[name]] if name in rows else np.ones(1) for name in wanted])
    names = tuple(f"sum_{k}" for k in range(sums))
    integrators = StateSpace(a, b, pick_c.reshape(len(wanted), sums), pick_d, names, ("rate",), wanted)
    law = loop.law.state_space()
    zeros = zeros_and_poles(chain(integrators, law))[0] - 1.0
    poles = np.concatenate([np.ones(sums), np.linalg.eigvals(law.a)]).astype(np.complex128) - 1.0
    hz = np.append(0.3 / period, np.geomspace(1e-3, 0.499 / period, _PROBES))
    w = np.expm1(2j * np.pi * period * hz)[:, None]
    known = loop.controller(hz)
    ratio = (w - zeros).prod(axis=1) / (w - poles).prod(axis=1)
    gain = float((known[0] / ratio[0]).real)
    if (np.abs(gain * ratio - known) > _SAME * np.abs(known)).any():
        raise ValueError("zeros and poles of the law are not known well enough")
    return zeros, poles, gain


def packed(loop: OpenLoop) -> LoopResponse | None:
    """Return the response of a loop as numbers, or None for a loop that this form does not support.

    The result is also None if the numbers do not reproduce L to eight digits.
    """
    if not isinstance(loop, Loop) or not isinstance(loop.fixed, SampledFixedPath) or not loop.fixed.takes_rate:
        return None
    if any(name not in MEASUREMENTS for name in loop.law.inputs):
        return None
    path, plant = loop.fixed.sampled, loop.fixed.continuous
    a, (scale, _) = scipy.linalg.matrix_balance(plant.a, permute=False, separate=True)
    poles, vectors = np.linalg.eig(a)
    try:
        zeros, law_poles, gain = controller_factors(loop)
        residues = (plant.c[0] * scale @ vectors) * np.linalg.solve(vectors, plant.b[:, 0] / scale)
    except (ValueError, np.linalg.LinAlgError):
        return None
    pairs, singles, direct = _terms(
        poles.astype(np.complex128), residues.astype(np.complex128), path.sample_s, path.rest_s
    )
    found = LoopResponse(
        path.sample_s, pairs, singles, direct, zeros, law_poles, gain / path.sample_s, path.whole_periods + 1, 0, 0
    )
    hz = np.geomspace(1e-4, loop.highest_hz, _PROBES)
    known = loop.response(hz)
    same = np.abs(_values(hz, found) - known) <= _SAME_LOOP * np.abs(known) + 1e-13
    return found if same.all() else None


@entry
def _terms(poles: ComplexArray, residues: ComplexArray, sample_s: float, rest_s: float) -> tuple[Array, Array, Array]:
    n = len(poles)
    mu, alpha, beta = np.empty(n, np.complex128), np.empty(n, np.complex128), np.empty(n, np.complex128)
    direct = np.zeros(2)
    response.terms(poles, residues, sample_s, rest_s, mu, alpha, beta, direct)
    pairs, singles = response.by_pairs(poles, mu, alpha, beta)
    return pairs, singles, direct


@entry
def _values(hz: Array, loop: LoopResponse) -> ComplexArray:
    return values_at(hz, loop)
