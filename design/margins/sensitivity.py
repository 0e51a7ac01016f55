"""How each measure changes with the loop: one complex weight a measure, at one frequency.

Let lambda = ln L = a + j phi, and let p be any parameter of the loop. Every measure g here changes as

    dg/dp = Re(weight * d lambda/dp),   d lambda/dp taken at the measure's own frequency, which is held still.

The critical frequency moves with p as well; the weight has that in it. Write dg = Re(c d lambda) for g at a fixed
frequency; a = Re(1 lambda), phi = Re(-j lambda).

- Where g is least along the curve (disks, peaks, smooth parts of a zone), the frequency's own change adds nothing
  to first order (envelope theorem): weight = c.
- Where the frequency is bound by h(f, p) = 0, dh = Re(c_h d lambda), implicit differentiation gives

      df/dp = - Re(c_h d lambda/dp) / Re(c_h d lambda/df),
      weight = c - [Re(c d lambda/df) / Re(c_h d lambda/df)] c_h.

| g | c | bound by |
|---|---|---|
| gain margin -(20/ln 10) a, dB | -20/ln 10 | phi = -180 deg: c_h = -j |
| phase margin phi + 180 deg | -j 180/pi | a = 0: c_h = 1 |
| delay margin lag / (2 pi f), s | weight of the lag / (2 pi f) + lag / (2 pi f^2 Re d lambda/df) | a = 0 |
| abs(1 + L) | L conj(1 + L) / abs(1 + L) | - |
| abs(1 + 1/L) | -conj(1 + 1/L) / (L abs(1 + 1/L)) | - |
| 2 abs(1 + L)/abs(1 - L) | g 2 L / (1 - L^2) | - |
| peak, dB | 20/ln 10 | - |
| clearance of a zone | of the side that is met | smooth: -; in a kink a = 0, phi = -180 deg or the diagonal |

A limit at zero frequency or infinity, and Nyquist, stay where they are. A minimum of several such measures has the
derivative of the least; where two are equally low it has a corner, and an optimiser should be given both.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.loop.open_loop import OpenLoop
from maxq.design.margins.curve import sample
from maxq.design.margins.measure import Margins
from maxq.design.margins.nichols import Zone
from maxq.design.margins.objectives import DB
from maxq.design.model.state_space import ComplexArray

DEGREES = 180.0 / np.pi
KINK = 1e-7  # in units of a zone's axes: closer to a kink than this is in it

_STENCIL = np.array([-3.0, -2.0, -1.0, 1.0, 2.0, 3.0])
_WEIGHTS = np.array([-1.0, 9.0, -45.0, 45.0, -9.0, 1.0]) / 60.0


@runtime_checkable
class Differentiable(Protocol):
    """A loop that knows d ln L / df, 1/Hz, in closed form; others are differenced."""

    def log_derivative(self, frequencies_hz: Array) -> ComplexArray: ...


@dataclass(frozen=True)
class Measure:
    """A number to be kept above (or, a peak, below) a limit; d(value)/dp = Re(weight * d ln L/dp at `frequency_hz`).

    Where the measure is a limit at zero frequency or infinity, `frequency_hz` is the end of the curve.
    """

    name: str
    value: float
    frequency_hz: float
    weight: complex


def log_slope(loop: OpenLoop, frequency_hz: Array) -> ComplexArray:
    """d ln L / df: from the loop if it has it, else by six-point differences, 1e-9 relative.

    The step is a small share of the distance to the nearest pole, which bounds the radius of convergence, and of
    1 / |d ln L/df|, which a zero nearby makes small.
    """
    f = np.asarray(frequency_hz, float)
    if isinstance(loop, Differentiable):
        return np.asarray(loop.log_derivative(f), np.complex128)
    poles = loop.open_poles()
    poles = poles[np.isfinite(poles)]
    away = np.abs(2j * np.pi * f[:, None] - poles).min(axis=1, initial=np.inf) / (2.0 * np.pi)
    room = np.minimum(f / 4.0, (loop.highest_hz - f) / 3.0)
    step = np.minimum(0.02 * np.minimum(away, f), room)
    slope = _differences(loop, f, step)
    shorter = np.minimum(step, 0.02 / np.maximum(np.abs(slope), 1e-300))
    return np.where(shorter < 0.5 * step, _differences(loop, f, shorter), slope)


def _differences(loop: OpenLoop, f: Array, step: Array) -> ComplexArray:
    points = np.append(f[:, None] + step[:, None] * _STENCIL, f[:, None], axis=1)
    values = sample(loop, points.reshape(-1)).reshape(points.shape)
    return np.asarray(np.log(values[:, :6] / values[:, 6:]) @ _WEIGHTS / step)


def moving(c: ComplexArray, bound: ComplexArray, slope: ComplexArray) -> ComplexArray:
    """Weight of a measure whose frequency is bound by another; NaN or infinite where the two are tangential."""
    return np.asarray(c - (c * slope).real / (bound * slope).real * bound)


def gain_margin_weight(slope: ComplexArray) -> ComplexArray:
    """Of -20 lg |L| at a phase crossing."""
    return moving(np.full(slope.shape, -DB + 0j), np.full(slope.shape, -1j), slope)


def phase_margin_weight(slope: ComplexArray) -> ComplexArray:
    """Of the phase in degrees at a gain crossing."""
    return moving(np.full(slope.shape, -1j * DEGREES), np.ones(slope.shape, np.complex128), slope)


def delay_margin_weight(frequency_hz: Array, lag_deg: Array, slope: ComplexArray) -> ComplexArray:
    """Of lag / (360 f) at a gain crossing."""
    return np.asarray(
        phase_margin_weight(slope) / (360.0 * frequency_hz) + lag_deg / (360.0 * frequency_hz**2 * slope.real)
    )


def sensitivity_weight(loop: ComplexArray) -> ComplexArray:
    """Of |1 + L|."""
    return np.asarray(loop * np.conj(1.0 + loop) / np.abs(1.0 + loop))


def complementary_weight(loop: ComplexArray) -> ComplexArray:
    """Of |1 + 1/L|."""
    distance = 1.0 + 1.0 / loop
    return np.asarray(-np.conj(distance) / (loop * np.abs(distance)))


def symmetric_weight(loop: ComplexArray) -> ComplexArray:
    """Of 2 |1 + L| / |1 - L|."""
    return np.asarray(4.0 * np.abs(1.0 + loop) / np.abs(1.0 - loop) * loop / (1.0 - loop**2))


def zone_weight(zone: Zone, loop: ComplexArray, slope: ComplexArray) -> ComplexArray:
    """Of the clearance at its least points, one each."""
    x, y = zone.coordinates(loop)
    cx = np.where(x < 0.0, -1.0, 1.0) * (-1j * DEGREES / zone.phase_deg)
    cy = np.where(y < 0.0, -1.0, 1.0) * (DB / zone.gain_db + 0j)
    level, upright = np.ones(x.shape, np.complex128), np.full(x.shape, -1j)
    if zone.shape == "ellipse":
        r = np.maximum(np.hypot(x, y), 1e-300)
        return np.asarray((np.abs(x) * cx + np.abs(y) * cy) / r)
    if zone.shape == "diamond":
        out = cx + cy
        out = np.where(np.abs(y) < KINK, moving(cx, level, slope), out)
        return np.where(np.abs(x) < KINK, moving(cy, upright, slope), out)
    out = np.where(np.abs(x) > np.abs(y), cx, cy)
    return np.where(np.abs(np.abs(x) - np.abs(y)) < KINK, moving(cx, cx - cy, slope), out)


def measures(m: Margins) -> dict[str, Measure]:
    """Every finite measure of a stable loop by name, with its weight; nothing of an unstable one.

    Names are the fields of `Margins`, `sensitivity`, `complementary`, `symmetric`, `diamond` and so on for the zones
    (counted from the second of a shape on: `diamond 2`), and `peak <label>` for the lobes.
    """
    if not m.stable:
        return {}
    first, last = float(m.curve.frequency_hz[0]), float(m.curve.frequency_hz[-1])
    out: dict[str, Measure] = {}
    for name in ("gain_up_db", "gain_down_db", "aero_gain_db", "rigid_gain_db"):
        _add_gain(out, m, name, first, last)
    for name in ("phase_deg", "rigid_phase_deg", "delay_s"):
        _add_turn(out, m, name)
    for name, disk, weight in (
        ("sensitivity", m.disks.sensitivity, sensitivity_weight),
        ("complementary", m.disks.complementary, complementary_weight),
        ("symmetric", m.disks.symmetric, symmetric_weight),
    ):
        if disk.size < np.inf:
            f = min(max(disk.frequency_hz, first), last)
            here = m.curve.loop[m.curve.frequency_hz == f][:1]
            level = abs(here[0]) == 0.0 or (f != disk.frequency_hz and not _real_limit(m, f))
            out[name] = Measure(name, disk.size, f, 0j if level else complex(weight(here)[0]))
    for c in m.clearances:
        at = np.array([c.frequency_hz])
        slope = log_slope(m.curve.source, at) if first < c.frequency_hz < last else np.ones(1, np.complex128)
        same = sum(name.split()[0] == c.zone.shape for name in out)
        name = c.zone.shape if same == 0 else f"{c.zone.shape} {same + 1}"
        out[name] = Measure(name, c.value, c.frequency_hz, complex(zone_weight(c.zone, np.array([c.loop]), slope)[0]))
    for lobe in m.lobes:
        name = f"peak {lobe.label}"
        out[name] = Measure(name, lobe.peak_db, lobe.peak_hz, complex(DB))
    return out


def _real_limit(m: Margins, f: float) -> bool:
    """Whether L has a finite limit other than zero at that end."""
    return (m.curve.slope_at_zero if f == m.curve.frequency_hz[0] else m.curve.slope_at_end) == 0


def _add_gain(out: dict[str, Measure], m: Margins, name: str, first: float, last: float) -> None:
    bound = getattr(m, name)
    if not np.isfinite(bound.value):
        return
    sign = -1.0 if name in ("gain_down_db", "aero_gain_db") else 1.0
    fixed = bound.frequency_hz == 0.0 or bound.frequency_hz >= last
    f = min(max(bound.frequency_hz, first), last)
    weight = -DB + 0j if fixed else complex(gain_margin_weight(log_slope(m.curve.source, np.array([f])))[0])
    out[name] = Measure(name, bound.value, f, sign * weight)


def _add_turn(out: dict[str, Measure], m: Margins, name: str) -> None:
    bound, crossings = getattr(m, name), m.gain_crossings
    k = np.flatnonzero(crossings.frequency_hz == bound.frequency_hz)[:1]
    if not len(k):
        return
    f = crossings.frequency_hz[k]
    slope = log_slope(m.curve.source, f)
    if name == "delay_s":
        weight = delay_margin_weight(f, crossings.lag_deg[k], slope)
    else:
        weight = np.sign(crossings.phase_margin_deg[k]) * phase_margin_weight(slope)
    out[name] = Measure(name, bound.value, bound.frequency_hz, complex(weight[0]))
