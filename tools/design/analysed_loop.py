"""The loop of a design at an operating point with its analyses as methods, for Python and for `simdesign open`.

    loop = maxq.loop("nominal", "ksr3-default", 40.0, plane="yaw", kind="exact")
    loop.margins().phase_deg, loop.bode().phase_deg, loop.step().attitude_rad
    loop.nichols().plot()

Each method returns arrays. Their `plot` draws into given axes or into a new figure, and returns the axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxq.control.kernel.records import Array
from maxq.design.certificate.response import decibels
from maxq.design.loop import loop as loops_of_laws
from maxq.design.loop.fixed_path import Cut, LoopKind
from maxq.design.loop.loop import Loop
from maxq.design.loop.root_locus import GAINS, RootLocus, root_locus
from maxq.design.loop.time_response import Stepped, TimeResponse, gust_response, step_response
from maxq.design.margins.measure import Margins, margins
from maxq.design.margins.measured_loop import LoopAtPoint
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.model.state_space import ComplexArray
from maxq.sim.scenario.schema_design import Design
from maxq.tools.design.open_loop import LoopPicture, picture_of, unwrapped_deg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LOWEST_HZ = 1e-3  # lower end of the default frequencies


@dataclass(frozen=True)
class BodeCurves:
    """The open loop L over frequency: `|L|` in dB and its phase in deg without jumps, all (n,).

    The phase begins between -360 and 0 deg at the lowest visible frequency.
    """

    frequency_hz: Array
    magnitude_db: Array
    phase_deg: Array
    response: ComplexArray
    picture: LoopPicture

    def plot(self, axes: Sequence[Axes] | None = None, colour: str | None = None) -> NDArray[Any]:
        """Draw gain and phase with lobes and margins. Return the two axes."""
        from maxq.tools.design.pictures_loop import draw_bode  # noqa: PLC0415  # lazy: Matplotlib, as below

        places = _axes(axes, 2, 1)
        draw_bode(self.picture, places[0], places[1], **_coloured(colour))
        return places


@dataclass(frozen=True)
class NicholsCurves:
    """The open loop L in the Nichols plane: phase in deg from -360 to 0, and `|L|` in dB, both (n,)."""

    frequency_hz: Array
    phase_deg: Array
    magnitude_db: Array
    picture: LoopPicture

    def plot(self, axes: Axes | None = None, colour: str | None = None) -> Axes:
        """Draw the Nichols plane with the contours of the closed loop. Return the axes."""
        from maxq.tools.design.pictures_loop import draw_nichols  # noqa: PLC0415  # lazy

        (place,) = _axes(None if axes is None else [axes], 1, 1, 4.2)
        draw_nichols(self.picture, place, **_coloured(colour))
        return place  # type: ignore[no-any-return]  # an array of axes


@dataclass(frozen=True)
class SensitivityCurves:
    """The closed-loop functions over frequency, all (n,).

    `s` is 1 / (1 + L) and `t` is L / (1 + L). `cs` is C S, from a rate at the gyro (rad/s) to the gimbal command (rad).
    `ps` is P S, from an angle added to the gimbal command (rad) to the mean rate (rad/s). `peak_s` and `peak_t` are the
    largest `|S|` and `|T|` over all frequencies. They are NaN for an unstable loop.
    """

    frequency_hz: Array
    s: ComplexArray
    t: ComplexArray
    cs: ComplexArray
    ps: ComplexArray
    peak_s: float
    peak_t: float

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw `|S|`, `|T|`, `|C S|` and `|P S|` in dB. Return the axes."""
        from maxq.tools.plots.style import curve, label, plain_numbers  # noqa: PLC0415  # lazy

        (place,) = _axes(None if axes is None else [axes], 1, 1, 3.2)
        parts = (("|S|", self.s), ("|T|", self.t), ("|C S|, s", self.cs), ("|P S|, 1/s", self.ps))
        for n, (name, values) in enumerate(parts):
            place.plot(self.frequency_hz, decibels(values), **curve(n), label=name)
        place.set_xscale("log")
        plain_numbers(place.xaxis)
        place.set_ylim(bottom=-60.0)
        place.legend()
        label(place, "frequency, Hz", "dB")
        return place  # type: ignore[no-any-return]  # an array of axes


class TimeCurves(TimeResponse):
    """A `TimeResponse` that can be drawn."""

    def plot(self, axes: Sequence[Axes] | None = None) -> NDArray[Any]:
        """Draw attitude and gimbal angle, and in a gust the angle of attack, over time. Return the axes, one each.

        The angles are in rad per rad of a step, and in deg in a gust.
        """
        from maxq.tools.plots.style import curve, label  # noqa: PLC0415  # lazy

        gust = len(self.alpha_rad) > 0
        unit, factor = ("deg", 180.0 / np.pi) if gust else ("rad/rad", 1.0)
        shown = [("attitude", self.attitude_rad), ("gimbal angle", self.gimbal_rad)]
        shown += [("angle of attack", self.alpha_rad)] if gust else []
        places = _axes(axes, len(shown), 1, 1.9)
        for place, (name, values) in zip(places, shown, strict=True):
            place.plot(self.time_s, factor * values, **curve(0), label=self.name)
            label(place, "time, s", f"{name}, {unit}")
        return places


class LocusCurves(RootLocus):
    """A `RootLocus` that can be drawn."""

    def plot(self, axes: Axes | None = None) -> Axes:
        """Draw the locus, with crosses at the open-loop poles and dots at the present gain. Return the axes."""
        from maxq.tools.plots.palette import BLACK, BLUE, GREY  # noqa: PLC0415  # lazy
        from maxq.tools.plots.style import label  # noqa: PLC0415  # lazy

        (place,) = _axes(None if axes is None else [axes], 1, 1, 4.2)
        hz = self.poles / (2.0 * np.pi)
        place.plot(hz.real, hz.imag, color=BLUE, linewidth=0.9)
        start, now = self.open_poles / (2.0 * np.pi), self.at(1.0) / (2.0 * np.pi)
        place.plot(start.real, start.imag, "x", color=BLACK, label="open loop")
        place.plot(now.real, now.imag, "o", color=BLUE, label="present gain")
        place.axvline(0.0, color=GREY, linewidth=0.8)
        seen = now[np.isfinite(now) & (np.abs(now) < 30.0)]
        reach = 1.2 * max(1.0, float(np.abs(seen.imag).max(initial=1.0)))
        place.set_ylim(0.0, reach)
        place.set_xlim(-0.6 * reach, 0.2 * reach)
        place.legend()
        label(place, "Re s / 2 pi, Hz", "Im s / 2 pi, Hz")
        return place  # type: ignore[no-any-return]  # an array of axes


class AnalysedLoop(Loop):
    """The open loop L of a design at one operating point and in one plane, with its analyses as methods.

    `fixed.node` is the operating point, `law` the law with its gains, and `fixed.kind` the kind of loop. Frequencies
    are in Hz, poles in rad/s, angles in rad with the signs of the plane's model (docs/design.md, section 1). L has a
    positive sign for negative feedback.
    """

    def __repr__(self) -> str:
        node, gains = self.fixed.node, ", ".join(f"{name} {value:.4g}" for name, value in self.law.gains.items())
        return f"<AnalysedLoop {node.time_s:g} s, {node.plane}, {self.fixed.kind}: {gains}>"

    @cached_property
    def measured(self) -> LoopAtPoint:
        """Return the loop with its margins and named lobes."""
        return LoopAtPoint(self, margins(self, resonances=self.fixed.resonances()))

    def margins(self) -> Margins:
        """Return the margins, with lobes named after modes and tanks. Equal to `maxq.margins` with `resonances`."""
        return self.measured.margins

    def frequencies(self) -> Array:
        """Return frequencies (Hz) that resolve every resonance, from 1 mHz to the end of the loop's curve."""
        f = self.measured.margins.curve.frequency_hz
        return np.asarray(f[f >= min(LOWEST_HZ, f[-1])])

    def bode(self, frequencies_hz: ArrayLike | None = None) -> BodeCurves:
        """Return gain and phase at frequencies, by default at points that resolve every resonance.

        Raises ValueError for a frequency that is not above 0, or above half the sample rate.
        """
        picture = self._picture(frequencies_hz)
        level = decibels(picture.loop)
        return BodeCurves(picture.frequency_hz, level, unwrapped_deg(picture), picture.loop, picture)

    def nichols(self, frequencies_hz: ArrayLike | None = None) -> NicholsCurves:
        """Return the curve in the Nichols plane at frequencies, with the arguments of `bode`."""
        picture = self._picture(frequencies_hz)
        phase = np.degrees(np.angle(-picture.loop)) - 180.0
        return NicholsCurves(picture.frequency_hz, phase, decibels(picture.loop), picture)

    def sensitivity(self, frequencies_hz: ArrayLike | None = None) -> SensitivityCurves:
        """Return S, T, C S and P S at frequencies, and the peaks of S and T, with the arguments of `bode`."""
        f = self._checked(self.frequencies() if frequencies_hz is None else frequencies_hz)
        loop, path, found = self.response(f), self.fixed.response(f), self.margins().disks
        s = 1.0 / (1.0 + loop)
        peaks = [1.0 / found.sensitivity.size, 1.0 / found.complementary.size]
        return SensitivityCurves(f, s, loop * s, self.controller(f) * s, path * s, *peaks)

    def step(self, duration_s: float | None = None, *, of: Stepped = "attitude") -> TimeCurves:
        """Return the response to a step of 1 rad in the commanded attitude, or in the gimbal angle (`of="gimbal"`).

        The default duration is four time constants of the slowest pole, from 2 s to 60 s. Times are the samples of a
        sampled loop. The result has no step error; for the kind `exact`, delays are approximated to 1e-6.
        """
        return TimeCurves(**vars(step_response(self, of, duration_s)))

    def gust(self, speed_mps: float = 9.0, length_m: float = 300.0, *, duration_s: float | None = None) -> TimeCurves:
        """Return the response to a 1 - cos gust with the peak `speed_mps` over a length of the path.

        The air moves equally along the vehicle. Raises ValueError for an operating point without wind.
        """
        return TimeCurves(**vars(gust_response(self, speed_mps, length_m, duration_s)))

    def rlocus(self, gains: ArrayLike | None = None) -> LocusCurves:
        """Return the closed-loop poles (rad/s) over factors on all gains of the law, by default 0 and -26 to 26 dB."""
        factors = GAINS if gains is None else np.atleast_1d(np.asarray(gains, float))
        return LocusCurves(**vars(root_locus(self, factors)))

    def to_control(self, frequencies_hz: ArrayLike | None = None) -> Any:
        """Return L for python-control: a `StateSpace`, or for the kind `exact` an `FRD` at frequencies.

        The `dt` of a sampled loop is its period. python-control must be installed.
        """
        if self.fixed.kind != "exact" and frequencies_hz is None:
            return self.to_state_space()
        return self.to_frd(self.frequencies() if frequencies_hz is None else frequencies_hz)

    def to_mat(self, path: str | Path, frequencies_hz: ArrayLike | None = None) -> Path:
        """Write plant, path, law and loop as a MATLAB file, as `simdesign export --format mat`. Return its path.

        The struct `nodes` also contains `frequency_hz` and L as `response`. A loop of the kind `exact` has no matrices
        of path and loop. Raises FileError.
        """
        from maxq.tools.design.export import described, write_matrices  # noqa: PLC0415  # lazy

        f = self._checked(self.frequencies() if frequencies_hz is None else frequencies_hz)
        out = Path(path)
        write_matrices(out, "mat", [described(self) | {"frequency_hz": f, "response": self.response(f)}])
        return out

    def _picture(self, frequencies_hz: ArrayLike | None) -> LoopPicture:
        if frequencies_hz is None:
            picture = self._whole
            keep = picture.frequency_hz >= min(LOWEST_HZ, picture.frequency_hz[-1])
            f, values = picture.frequency_hz[keep], picture.loop[keep]
        else:
            f = self._checked(frequencies_hz)
            values = self.response(f)
        return LoopPicture("", f, values, self._whole.marks, self._whole.zones)

    @cached_property
    def _whole(self) -> LoopPicture:
        return picture_of(self.measured, "")

    def _checked(self, frequencies_hz: ArrayLike) -> Array:
        f = np.atleast_1d(np.asarray(frequencies_hz, float))
        bad = f[~((f > 0.0) & (f <= self.highest_hz) & np.isfinite(f))]
        if f.ndim != 1 or len(bad):
            end = f"to {self.highest_hz:g} Hz" if np.isfinite(self.highest_hz) else "without limit"
            raise ValueError(f"frequencies_hz: {bad[:1]} is outside the loop; allowed is a list above 0 {end}")
        return f


def analysed(loop: Loop) -> AnalysedLoop:
    """Return a loop with its analyses."""
    return AnalysedLoop(loop.fixed, loop.law)


def loops(
    where: Iterable[OperatingPoint], design: Design, *, kind: LoopKind = "sampled", cut: Cut = "gimbal_command"
) -> list[AnalysedLoop]:
    """Return the loop of a design at each operating point, opened at `cut`.

    `kind` is `sampled` (as in the flight computer), `pade` (continuous, with the paper's approximations) or `exact`
    (continuous, with exact factors and no aliasing).
    """
    return [analysed(one) for one in loops_of_laws.loops(where, design, kind=kind, cut=cut)]


def _axes(axes: Any, rows: int, columns: int, height_in: float = 2.4) -> NDArray[Any]:
    """Return the given axes as an array, or those of a new figure. Raises ValueError for another number of axes."""
    if axes is None:
        from maxq.tools.plots.style import drawing, sheet  # noqa: PLC0415  # lazy

        with drawing():
            return sheet(rows, columns, height_in)[1]  # type: ignore[no-any-return]  # an array of axes
    given = np.atleast_1d(np.asarray(axes, object)).ravel()
    if len(given) != rows * columns:
        raise ValueError(f"axes: {len(given)} given; allowed are {rows * columns}")
    return given


def _coloured(colour: str | None) -> dict[str, str]:
    return {} if colour is None else {"colour": colour}
