"""The parameter record of a stage's buffet: digital filters that give white noise the spectra of its table."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from maxq.control.kernel.limits import MAX_BUFFETS
from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import Pool
from maxq.sim.input.values import NS_PER_S
from maxq.sim.vehicle.buffet.kernel import HALF, Buffet

if TYPE_CHECKING:
    from maxq.sim.scenario.schema_vehicle import Stage

OVERSAMPLING = 4  # ticks per period of the highest frequency
_BINS = 1024  # frequencies up to the tick rate at which a filter is designed


def pack_buffet(stage: Stage, seed: int, pool: Pool) -> Buffet:
    """Return the stage's buffet, and add its filters to `pool`."""
    given, stations = stage.buffet, np.zeros(MAX_BUFFETS)
    if given is None:
        return Buffet(0, 1, 0, 0, 0, 0, 0.0, stations)
    frequency_hz, density, mach = given.frequency_hz, given.density, given.mach
    tick_ns = math.floor(NS_PER_S / (OVERSAMPLING * float(frequency_hz[-1])))
    taps = _filters(frequency_hz.tobytes(), density.tobytes(), density.shape[:2], tick_ns / NS_PER_S)
    stations[: len(given.stations_m)] = given.stations_m
    return Buffet(
        seed=seed,
        tick_ns=tick_ns,
        rows=len(mach),
        mach=pool.put(mach),
        taps=pool.put(taps),
        per_pressure=int(given.per_pressure),
        factor=given.factor,
        station_m=stations,
    )


@lru_cache(maxsize=8)
def _filters(frequency_bytes: bytes, density_bytes: bytes, shape: tuple[int, int], tick_s: float) -> Array:
    """Return the taps 0 to HALF of symmetric filters (Mach numbers, stations, HALF + 1) of unit white noise.

    The filtered noise is the sequence of coefficients of cubic B-splines, which multiply its one-sided spectrum
    2 T |H|^2 by sinc(f T)^8 for ticks of T. The filter, whose outer half is tapered, resolves about a hundredth of the
    highest frequency, over which it smooths the ends of the spectrum.
    """
    frequency_hz = np.frombuffer(frequency_bytes)
    density = np.frombuffer(density_bytes).reshape(*shape, len(frequency_hz))
    bins_hz = np.arange(_BINS // 2) / (_BINS * tick_s)
    inside = np.flatnonzero((bins_hz >= frequency_hz[0]) & (bins_hz <= frequency_hz[-1]))
    f = bins_hz[inside]
    cosines = [math.cos(2.0 * math.pi * k / _BINS) for k in range(_BINS)]
    waves = np.array([[cosines[int(k) * m % _BINS] for m in range(HALF + 1)] for k in inside]).reshape(-1, HALF + 1)
    waves *= np.array([0.5 - 0.5 * math.cos(2.0 * math.pi * min(1.0 - m / (HALF + 1), 0.5)) for m in range(HALF + 1)])
    spline = np.array([(math.sin(x) / x) ** 4 if x > 0.0 else 1.0 for x in (math.pi * tick_s * f).tolist()])
    out = np.zeros((*shape, HALF + 1))
    for row in np.ndindex(shape):
        gain = np.sqrt(np.interp(f, frequency_hz, density[row]) / (2.0 * tick_s)) / spline
        out[row] = np.add.reduce(gain[:, None] * waves * (2.0 / _BINS), axis=0)
    out.flags.writeable = False
    return out
