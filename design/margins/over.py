"""Margins of many loops as arrays: over a flight, or over thousands of dispersed cases."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.loop.open_loop import OpenLoop
from maxq.design.loop.resonance import Resonance
from maxq.design.margins.measure import DIAMOND, Margins, margins
from maxq.design.margins.nichols import Zone


@dataclass(frozen=True)
class MarginTable:
    """A row a loop, (loops,); margins of an unstable loop are NaN. Lobes are (loops, labels), NaN where one is not."""

    stable: NDArray[np.bool_]
    growth_1ps: Array
    gain_up_db: Array
    gain_down_db: Array
    phase_deg: Array
    delay_s: Array
    aero_gain_db: Array
    rigid_gain_db: Array
    rigid_phase_deg: Array
    crossover_hz: Array
    modulus: Array
    complementary: Array
    symmetric: Array
    clearance: Array  # (loops, zones)
    labels: tuple[str, ...]
    peak_db: Array
    peak_hz: Array
    lobe_phase_deg: Array
    lobe_gain_up_db: Array
    lobe_gain_down_db: Array


def margins_over(
    loops: Iterable[OpenLoop],
    resonances: Iterable[Sequence[Resonance]] | None = None,
    zones: Sequence[Zone] = (DIAMOND,),
) -> MarginTable:
    """Measure each loop, with its own resonances where they are given. Raises as `margins` does, naming the loop."""
    every = list(loops)
    named = [None] * len(every) if resonances is None else list(resonances)
    if len(named) != len(every):
        raise ValueError(f"{len(named)} sets of resonances for {len(every)} loops")
    found = []
    for k, (loop, own) in enumerate(zip(every, named, strict=True)):
        try:
            found.append(margins(loop, resonances=own, zones=zones))
        except ValueError as problem:
            raise ValueError(f"loop {k}: {problem}") from problem
    return tabulate(found, len(zones))


def tabulate(found: Sequence[Margins], zones: int) -> MarginTable:
    """Margins as arrays."""
    labels = tuple(dict.fromkeys(lobe.label for m in found for lobe in m.lobes))
    lobes = [{lobe.label: lobe for lobe in m.lobes} for m in found]

    def of_lobes(name: str) -> Array:
        rows = [[getattr(by.get(label), name, np.nan) for label in labels] for by in lobes]
        return np.array(rows, float).reshape(len(found), len(labels))

    def of(name: str) -> Array:
        return np.array([float(getattr(m, name)) for m in found])

    return MarginTable(
        stable=np.array([m.stable for m in found], bool),
        growth_1ps=of("growth_1ps"),
        gain_up_db=of("gain_up_db"),
        gain_down_db=of("gain_down_db"),
        phase_deg=of("phase_deg"),
        delay_s=of("delay_s"),
        aero_gain_db=of("aero_gain_db"),
        rigid_gain_db=of("rigid_gain_db"),
        rigid_phase_deg=of("rigid_phase_deg"),
        crossover_hz=of("crossover_hz"),
        modulus=of("modulus"),
        complementary=np.array([m.disks.complementary.size for m in found]),
        symmetric=np.array([m.disks.symmetric.size for m in found]),
        clearance=np.array([[c.value for c in m.clearances] for m in found]).reshape(len(found), zones),
        labels=labels,
        peak_db=of_lobes("peak_db"),
        peak_hz=of_lobes("peak_hz"),
        lobe_phase_deg=of_lobes("phase_deg"),
        lobe_gain_up_db=of_lobes("gain_up_db"),
        lobe_gain_down_db=of_lobes("gain_down_db"),
    )
