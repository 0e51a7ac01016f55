"""The open loop at an operating point, prepared for drawing: a smooth curve with named lobes and crossings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.records import Array
from maxq.design.certificate.response import decibels
from maxq.design.margins.crossings import GainCrossings, PhaseCrossings
from maxq.design.margins.distances import Zone
from maxq.design.margins.lobes import Lobe
from maxq.design.margins.measured_loop import LoopAtPoint
from maxq.design.model.state_space import ComplexArray

BOTTOM_DB = -40.0  # lower limit of Bode and Nichols plots
LOWEST_HZ = 0.02


@dataclass(frozen=True)
class Mark:
    """A named point of the curve: the top of a lobe, a crossing, or the point nearest to -1.

    A crossing that sets no margin has no name.
    """

    frequency_hz: float
    loop: complex
    text: str
    what: Literal["lobe", "gain", "phase", "least"] = "lobe"


@dataclass(frozen=True)
class LoopPicture:
    """The content of a picture of a loop.

    The points of the curve are in order of frequency, and close enough to follow every resonance.
    """

    title: str
    frequency_hz: Array
    loop: ComplexArray
    marks: Sequence[Mark] = ()
    zones: Sequence[Zone] = ()


def named(lobe: Lobe) -> str:
    """Return the name of a lobe's pole as it appears in texts."""
    return lobe.label.replace("bending ", "mode ")


def picture_of(judged: LoopAtPoint, title: str, zones: Sequence[Zone] = ()) -> LoopPicture:
    """Return the picture of the loop at an operating point.

    It contains the lobes, the crossings of 0 dB and of the negative real axis, and the point nearest to -1.
    """
    margins, curve = judged.margins, judged.margins.curve
    f, loop = smooth(judged.loop.response, curve.frequency_hz, curve.loop)
    marks: list[Mark] = []
    for lobe in judged.lobes:
        at, text = np.array([lobe.peak_hz]), named(lobe)
        if marks and abs(marks[-1].frequency_hz / lobe.peak_hz - 1.0) < 1e-3:  # two pendulums with one frequency
            text = f"{marks.pop().text}, {text}"
        marks.append(Mark(lobe.peak_hz, complex(judged.loop.response(at)[0]), text))
    gain, phase = margins.gain_crossings, margins.phase_crossings
    binding = {
        margins.gain_up_db.frequency_hz: f"upper {margins.gain_up_db.value:.1f} dB",
        margins.gain_down_db.frequency_hz: f"lower {margins.gain_down_db.value:.1f} dB",
        margins.phase_deg.frequency_hz: f"{margins.phase_deg.value:.0f} deg",
    }
    inner = (phase.frequency_hz >= f[0]) & (phase.frequency_hz <= f[-1])
    every = np.ones(len(gain.frequency_hz), bool)
    crossed: tuple[tuple[Literal["phase", "gain"], GainCrossings | PhaseCrossings, NDArray[np.bool_]], ...]
    crossed = ("phase", gain, every), ("gain", phase, inner)
    for what, crossings, chosen in crossed:
        for hz, value in zip(crossings.frequency_hz[chosen], crossings.loop[chosen], strict=True):
            text = f"{binding[hz]}, {hz:.3g} Hz" if hz in binding else ""
            marks.append(Mark(float(hz), complex(value), text, what))
    nearest = margins.disks.sensitivity
    if f[0] <= nearest.frequency_hz <= f[-1]:
        value = judged.loop.response(np.array([nearest.frequency_hz]))[0]
        marks.append(Mark(nearest.frequency_hz, complex(value), f"{nearest.size:.3g}", "least"))
    return LoopPicture(title, f, loop, marks, zones)


def unwrapped_deg(picture: LoopPicture) -> Array:
    """Return the phase without jumps, in degrees. It begins between -360 and 0, where the curve is first visible."""
    turned = np.degrees(np.unwrap(np.angle(picture.loop)))
    seen = (picture.frequency_hz >= LOWEST_HZ) & (decibels(picture.loop) > BOTTOM_DB)
    if seen.any():
        turned -= 360.0 * np.ceil(np.median(turned[seen][:3]) / 360.0)
    return np.asarray(turned)


def smooth(
    response: Callable[[Array], ComplexArray], frequency_hz: Array, loop: ComplexArray
) -> tuple[Array, ComplexArray]:
    """Return the curve with points added where it is visible, until steps are at most 4 degrees and 1 dB."""
    f, values = frequency_hz, loop
    for _ in range(8):
        level = decibels(values)
        steep = (np.abs(np.diff(np.unwrap(np.angle(values)))) > np.radians(4.0)) | (np.abs(np.diff(level)) > 1.0)
        steep &= np.maximum(level[1:], level[:-1]) > BOTTOM_DB - 10.0
        k = np.flatnonzero(steep & (np.diff(f) > 1e-9 * f[1:]))
        if not len(k):
            break
        middle = np.sqrt(f[k] * f[k + 1])
        f, values = np.insert(f, k + 1, middle), np.insert(values, k + 1, response(middle))
    return f, values
