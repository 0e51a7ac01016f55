"""The response of a loop as numbers for compiled code, for sampled loops with laws on the first gyro."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
import scipy.linalg

from maxq.control.kernel.jit import entry
from maxq.control.kernel.records import Array
from maxq.design.laws.law import ANGLES, MEASUREMENTS, Controller
from maxq.design.loop.fixed_path import SampledFixedPath
from maxq.design.loop.loop import Loop, OpenLoop
from maxq.design.loop.multiloop import Multiloop, OneLoop
from maxq.design.loop.sampling import SampledPlant
from maxq.design.margins import response
from maxq.design.margins.response import LoopResponse, values_at
from maxq.design.model.state_space import ComplexArray, StateSpace, chain, channels, zeros_and_poles
from maxq.sim.input.remembered import cached_by_identity

Factors: TypeAlias = "tuple[ComplexArray, ComplexArray, float]"
_SAME = 1e-9  # relative tolerance of the law's response from its zeros and poles
_SAME_LOOP = 1e-8  # tolerance of the whole response: at 1e-4 Hz the reference method loses eight digits of z - 1
_PROBES = 40
_LOWEST_HZ = 1e-4, 2.5e-4  # of the probes; curves with other loops closed begin above the second


def controller_factors(law: Controller, period: float, controller: Callable[[Array], ComplexArray]) -> Factors:
    """Return the zeros, the poles and the gain of the law with the integrators of the angle, in w = z - 1.

    `controller` is its response from mean rate to command at frequencies in Hz. Raises ValueError if the factors do not
    reproduce this response to nine digits.
    """
    wanted = law.inputs
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
    own = law.state_space()
    zeros = zeros_and_poles(chain(integrators, own))[0] - 1.0
    poles = np.concatenate([np.ones(sums), np.linalg.eigvals(own.a)]).astype(np.complex128) - 1.0
    hz = np.append(0.3 / period, np.geomspace(1e-3, 0.499 / period, _PROBES))
    w = np.expm1(2j * np.pi * period * hz)[:, None]
    known = controller(hz)
    ratio = (w - zeros).prod(axis=1) / (w - poles).prod(axis=1)
    gain = float((known[0] / ratio[0]).real)
    if (np.abs(gain * ratio - known) > _SAME * np.abs(known)).any():
        raise ValueError("zeros and poles of the law are not known well enough")
    return zeros, poles, gain


def packed(loop: OpenLoop) -> LoopResponse | None:
    """Return the response of a loop as numbers, or None for a loop that this form does not support.

    The result is also None if the numbers do not reproduce L to eight digits.
    """
    try:
        found = _one(loop) if isinstance(loop, Loop) else _of_axis(loop) if isinstance(loop, OneLoop) else None
    except (ValueError, np.linalg.LinAlgError):
        return None
    if found is None:
        return None
    hz = np.geomspace(_LOWEST_HZ[isinstance(loop, OneLoop)], loop.highest_hz, _PROBES)
    known = loop.response(hz)
    same = np.abs(_values(hz, found) - known) <= _SAME_LOOP * np.abs(known) + 1e-13
    return found if same.all() else None


def _one(loop: Loop) -> LoopResponse | None:
    if not isinstance(loop.fixed, SampledFixedPath) or not loop.fixed.takes_rate:
        return None
    if any(name not in MEASUREMENTS for name in loop.law.inputs):
        return None
    path = loop.fixed.sampled
    zeros, poles, gain = controller_factors(loop.law, path.sample_s, loop.controller)
    pairs, singles, direct = _elements(loop.fixed.continuous, path, np.ones(1))
    whole = path.whole_periods + 1
    return LoopResponse(path.sample_s, pairs, singles, direct, zeros, poles, gain / path.sample_s, whole, 0, 0, 1)


def _of_axis(loop: OneLoop) -> LoopResponse | None:
    """Return the response of one loop with one or two others closed."""
    n = len(loop.whole.axes)
    if not isinstance(loop.whole, Multiloop) or loop.whole.sensed or loop.whole.plant is None or n not in (2, 3):
        return None
    order = [loop.axis, *(k for k in range(n) if k != loop.axis)]
    pairs, singles, direct, zeros, poles = _matrix_of(loop.whole)
    by_element = (part.reshape(n, n, -1, *part.shape[1:])[order][:, order] for part in (pairs, singles, direct))
    pairs, singles, direct = (part.reshape(-1, *part.shape[3:]) for part in by_element)
    zeros, poles = zeros[order].ravel(), poles[order].ravel()
    path = loop.whole.path
    whole = path.whole_periods + 1
    return LoopResponse(path.sample_s, pairs, singles, direct, zeros, poles, 1.0 / path.sample_s, whole, 0, 0, n)


@cached_by_identity
def _matrix_of(loop: Multiloop) -> tuple[Array, Array, Array, ComplexArray, ComplexArray]:
    """Return pairs, singles and direct parts of all elements, row by row, and zeros and poles of the laws, (axes, ...).

    Raises ValueError for laws without a common form.
    """
    assert loop.plant is not None
    period, factors = loop.path.sample_s, list[Factors]()
    for k, law in enumerate(loop.laws):

        def controller(hz: Array, k: int = k) -> ComplexArray:
            return np.asarray(loop.controllers(hz)[..., k])

        factors.append(controller_factors(law, period, controller))
    most = max(len(poles) for _, poles, _ in factors)
    # z / z pads the laws to a common order
    padded = [
        [np.append(each, np.full(most - len(poles), -1.0)) for each in (zeros, poles)] for zeros, poles, _ in factors
    ]
    plant = channels(loop.plant, loop.plant.outputs)
    elements = _elements(plant, loop.path, np.array([gain for _, _, gain in factors]))
    return *elements, np.array([zeros for zeros, _ in padded]), np.array([poles for _, poles in padded])


def _elements(plant: StateSpace, path: SampledPlant, gains: Array) -> tuple[Array, Array, Array]:
    """Return the terms of all elements of a sampled path, row by row, each row times its gain."""
    a, (scale, _) = scipy.linalg.matrix_balance(plant.a, permute=False, separate=True)
    poles, vectors = np.linalg.eig(a)
    seen = gains[:, None] * (plant.c[: len(gains)] * scale @ vectors)
    driven = np.linalg.solve(vectors, (plant.b.T / scale).T)
    found = [
        _terms(poles.astype(np.complex128), (row * column).astype(np.complex128), path.sample_s, path.rest_s)
        for row in seen
        for column in driven.T
    ]
    pairs, singles, direct = zip(*found, strict=True)
    return np.concatenate(pairs), np.concatenate(singles), np.concatenate(direct)


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


@entry
def _matrix(hz: Array, loop: LoopResponse) -> ComplexArray:
    return response.matrix_at(hz, loop)


def matrix_response(loop: Multiloop) -> Callable[[Array], ComplexArray]:
    """Return the function that computes L of several loops at frequencies in Hz, compiled if this form supports it."""
    numbers = packed(loop.one(loop.axes[0]))
    if numbers is None:
        return loop.response
    return lambda hz: np.moveaxis(_matrix(hz, numbers), -1, 0)
