"""Orbit data messages as keyword = value (CCSDS 502.0-B-2): OEM of a flight, OPM of an insertion.

The frame TEME follows from the Earth-fixed frame by the Greenwich mean sidereal time of 1982 at T0 (Vallado,
Fundamentals of Astrodynamics and Applications, 4th ed., eqs. 3-45 and 3-92). UT1 = UTC and no polar motion are assumed:
UT1 - UTC, at most 0.9 s, turns the inertial frame by at most 13.5 arc seconds, 420 m at the surface. ITRF2000 is the
Earth-fixed frame of the flight itself.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.files import write_whole
from maxq.sim.log.head import LogError
from maxq.sim.run.impact_channels import WithImpacts
from maxq.sim.run.metrics import orbit_metrics
from maxq.sim.world.earth import FLAT

MessageFrame = Literal["TEME", "ITRF2000"]
_PERIOD_s = 1.0
_THRUST_EVENTS = (
    "liftoff",
    "ignition",
    "restart",
    "burnout",
    "cutoff",
    "separation",
    "booster_ignition",
    "booster_burnout",
)
_ENDS_OF_THRUST = ("burnout", "cutoff")
_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)


def gmst_rad(ut1: datetime) -> float:
    """Return the Greenwich mean sidereal time of 1982 at a date in UT1, rad from 0 to 2 pi."""
    t = (ut1 - _J2000) / timedelta(days=36525)
    seconds = 67310.54841 + (876600.0 * 3600.0 + 8640184.812866) * t + 0.093104 * t**2 - 6.2e-6 * t**3
    return math.radians(seconds % 86400.0 / 240.0)


class OrbitMessages:
    """The orbit data messages of a flight with T0 at the date `utc` (ISO 8601; without a time zone: UTC).

    Raises LogError without a date, for a date that is not ISO 8601, and on a flat Earth.
    """

    def __init__(self, flight: WithImpacts, utc: str, frame: MessageFrame = "TEME") -> None:
        if flight.earth.figure == FLAT:
            raise LogError("orbit messages need a round Earth: earth.shape = 'wgs84' or 'sphere'")
        if not utc:
            raise LogError("the date of T0 is unknown: give --utc 2026-01-31T12:00:00Z, or site.utc in the scenario")
        try:
            date = datetime.fromisoformat(utc)
        except ValueError:
            raise LogError(f"--utc {utc}: is not a date and time; allowed: ISO 8601, as 2026-01-31T12:00:00Z") from None
        self.t0 = date.astimezone(UTC) if date.tzinfo is not None else date.replace(tzinfo=UTC)
        self.flight, self.frame = flight, frame
        scenario = flight.loaded.scenario
        self.object_name = " ".join((scenario.vehicle.name or scenario.name or "UNKNOWN").split())

    def states(self, rows: IntArray) -> tuple[Array, Array]:
        """Return position, m, and velocity, m/s, (n, 3) in the frame of the message at slow rows (n,)."""
        times, r, v = (part[rows] for part in self.flight.states)
        rate = float(self.flight.earth.rate_radps)
        if self.frame == "TEME":
            angle = np.full(len(times), gmst_rad(self.t0))
        else:
            angle = -rate * times
            v = v - rate * np.stack([-r[:, 1], r[:, 0], 0.0 * r[:, 2]], axis=1)
        return _turned(r, angle), _turned(v, angle)

    def write_oem(self, path: Path) -> None:
        """Write the ephemeris, with a state per second and a segment for each interval between thrust events."""
        lines = [*self._head("OEM")]
        for rows in self._segments():
            times, (r, v) = self.flight.states[0][rows], self.states(rows)
            lines += [
                "META_START",
                *self._metadata(),
                f"START_TIME = {self._date(times[0])}",
                f"STOP_TIME = {self._date(times[-1])}",
            ]
            if len(rows) > 2:
                lines += ["INTERPOLATION = HERMITE", f"INTERPOLATION_DEGREE = {3 if len(rows) < 5 else 7}"]
            lines.append("META_STOP")
            lines += [
                " ".join((self._date(t), *(f"{x / 1e3:.6f}" for x in place), *(f"{x / 1e3:.9f}" for x in speed)))
                for t, place, speed in zip(times, r, v, strict=True)
            ]
            lines.append("")
        write_whole(path, "\n".join(lines))

    def write_opm(self, path: Path) -> float:
        """Write the state after the last end of thrust, or at the end of a flight without one. Return its time, s.

        The message contains the osculating elements in TEME, and the mass.
        """
        times = self.flight.states[0]
        ends_s = [t for t, name in self._events() if name in _ENDS_OF_THRUST]
        row = min(int(np.searchsorted(times, ends_s[-1])) if ends_s else len(times) - 1, len(times) - 1)
        (r,), (v,) = self.states(np.array([row]))
        lines = [*self._head("OPM"), *self._metadata(), f"EPOCH = {self._date(times[row])}"]
        lines += [f"{axis} = {x / 1e3:.6f} [km]" for axis, x in zip("XYZ", r, strict=True)]
        lines += [f"{axis}_DOT = {x / 1e3:.9f} [km/s]" for axis, x in zip("XYZ", v, strict=True)]
        orbit = orbit_metrics(self.flight.earth, tuple(r.tolist()), tuple(v.tolist()))
        if self.frame == "TEME" and orbit.orbit_semimajor_m > 0.0:
            lines += [
                f"SEMI_MAJOR_AXIS = {orbit.orbit_semimajor_m / 1e3:.6f} [km]",
                f"ECCENTRICITY = {orbit.orbit_eccentricity:.9f}",
                f"INCLINATION = {orbit.orbit_inclination_deg:.9f} [deg]",
                f"RA_OF_ASC_NODE = {orbit.orbit_ascending_node_deg:.9f} [deg]",
                f"ARG_OF_PERICENTER = {orbit.orbit_argument_of_perigee_deg:.9f} [deg]",
                f"TRUE_ANOMALY = {orbit.orbit_true_anomaly_deg:.9f} [deg]",
                f"GM = {float(self.flight.earth.mu_m3ps2) / 1e9:.6f} [km**3/s**2]",
            ]
        lines.append(f"MASS = {float(self.flight.source['mass_kg'][row]):.6f} [kg]")
        write_whole(path, "\n".join([*lines, ""]))
        return float(times[row])

    def _head(self, kind: str) -> list[str]:
        now = datetime.now(UTC).replace(microsecond=0, tzinfo=None).isoformat()
        return [f"CCSDS_{kind}_VERS = 2.0", f"CREATION_DATE = {now}", "ORIGINATOR = MAXQ", ""]

    def _metadata(self) -> list[str]:
        return [
            f"OBJECT_NAME = {self.object_name}",
            "OBJECT_ID = UNKNOWN",
            "CENTER_NAME = EARTH",
            f"REF_FRAME = {self.frame}",
            "TIME_SYSTEM = UTC",
        ]

    def _date(self, time_s: float) -> str:
        date = self.t0 + timedelta(microseconds=round(1e6 * float(time_s)))
        return date.replace(tzinfo=None).isoformat(timespec="microseconds")

    def _events(self) -> list[tuple[float, str]]:
        events = self.flight.source.events
        return [(event.time_ns / 1e9, event.text.partition(":")[0].partition(" ")[0]) for event in events]

    def _segments(self) -> Iterator[IntArray]:
        """Yield the slow rows of each segment: one per second and the ends, which are not on the same instant."""
        times = self.flight.states[0]
        cuts = sorted({t for t, name in self._events() if name in _THRUST_EVENTS and times[0] < t < times[-1]})
        ends = [0, *(int(np.searchsorted(times, t)) for t in cuts), len(times)]
        for first, end in pairwise(ends):
            if end - first > 1:
                rows = np.arange(first, end)
                seconds = np.diff(np.floor(times[rows] / _PERIOD_s), prepend=-1.0) > 0.0
                seconds[[0, -1]] = True
                yield rows[seconds]


def _turned(x: Array, angle_rad: Array) -> Array:
    """Return vectors (n, 3) turned about the z axis by angles (n,)."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.stack([c * x[:, 0] - s * x[:, 1], s * x[:, 0] + c * x[:, 1], x[:, 2]], axis=1)
