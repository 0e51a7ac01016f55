"""The wave at which slosh ends that the control loop excites: predicted, and flown.

A ring baffle damps the more the higher the wave (Miles, J. Aero. Sci. 25, 1958; NASA SP-106, eq. 4.10),

    zeta = 2.83 exp(-4.6 d / R) a^(3/2) sqrt(eta / R)

with d the depth of the ring below the surface, a the share of the surface that it covers, eta the height of the wave at
the wall. A loop that needs the damping zeta lets slosh grow while the wave is lower than that and damps it above: the
wave where the formula gives zeta is a limit cycle. Equal moments of liquid and pendulum about the axis,
rho pi R^3 eta / xi^2 and m L theta, turn the wave of the first mode (xi = 1.841) into the swing of the pendulum,

    theta = (xi^2 - 1) / 2  eta / R

whatever the depth. The simulator's pendulums keep their damping; in `fly_cycle` it follows the swing of the second that
has gone by, which is what an equivalent viscous damping means. Nothing else in a loop of ours ends slosh before the
model does: without baffles, gimbal and servo stay far from their limits until the liquid has swung through a right
angle (tests/test_oracle_slosh_cycle.py), where waves would long have broken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from maxq.design.certificate.held_flight import HeldFlight
from maxq.design.certificate.loudness import burst_rad
from maxq.sim.flight.telemetry import FAST
from maxq.sim.packing.flight import Packed
from maxq.sim.run.fly import KeptRows
from maxq.sim.scenario.schema_injection import Injection

SWING_PER_WAVE = (1.8412**2 - 1.0) / 2.0  # rad of the pendulum for a wave at the wall as high as the radius
WATCHED_S = 400.0  # some time constants of a cycle that settles within a minute
SETTLED = 0.03  # share by which the last two quarters' swings may differ


@dataclass(frozen=True)
class Baffle:
    """A ring `depth_r` radii below the surface that covers the share `cover` of it."""

    depth_r: float
    cover: float

    def damping(self, swing_rad: float) -> float:
        """Damping ratio that it gives a pendulum swinging so far."""
        return self._per_root * math.sqrt(abs(swing_rad) / SWING_PER_WAVE)

    def wave_m(self, damping: float, radius_m: float) -> float:
        """Height of the wave at the wall at which it gives this damping ratio."""
        return radius_m * (damping / self._per_root) ** 2

    def swing_deg(self, damping: float) -> float:
        """The same as the swing of the pendulum."""
        return math.degrees(SWING_PER_WAVE * self.wave_m(damping, 1.0))

    @property
    def _per_root(self) -> float:
        return 2.83 * math.exp(-4.6 * self.depth_r) * math.pow(self.cover, 1.5)


@dataclass(frozen=True)
class Cycle:
    """How a tank's liquid swings in flight at last: half of what lies between the extremes, deg. `settled` says whether
    it still changed; NaN where the flight ended early."""

    swing_deg: float
    settled: bool
    gimbal_deg: float


def fly_cycle(
    held: HeldFlight,
    tank: int,
    baffle: Baffle,
    frequency_hz: float,
    loudness: float = 1.0,
    watched_s: float = WATCHED_S,
) -> Cycle:
    """Kick the held flight at the slosh frequency and let the baffle's damping follow the swing.

    `loudness` times the burst of design/certificate/loudness.py: the cycle is reached from above or from below.
    """
    burst = Injection.model_validate(
        {
            "at": "gimbal_command", "axis": held.plane, "kind": "sine", "frequency_hz": frequency_hz,
            "amplitude_deg": loudness * math.degrees(burst_rad(held, frequency_hz)),
            "stop_s": round(3.0 / frequency_hz, 6),
        }
    )  # fmt: skip

    def undamped(packed: Packed) -> None:
        packed.parameters[0].vehicle.slosh.damping_ratio[tank] = 0.0

    run = held.run(WATCHED_S, (burst,), undamped)
    names = [c.name for c in run.table.columns(FAST)]
    column = [n for n, name in enumerate(names) if name.startswith("slosh") and name.endswith(f"{held.plane}_deg")][
        tank
    ]
    damping, kept = run.packed.parameters[0].vehicle.slosh.damping_ratio, KeptRows()
    while not run.finished:
        rows = run.fly_segment()
        kept.add(rows)
        swing = rows[FAST][1][:, column]
        if len(swing):
            damping[tank] = baffle.damping(math.radians(0.5 * float(np.ptp(swing))))
    _, values = kept.rows()[FAST]
    quarter = len(values) // 4
    if run.now_s < WATCHED_S - 1.0 or quarter < 8:
        return Cycle(math.nan, False, math.nan)
    command = values[3 * quarter :, run.table.index(f"gimbal_{held.plane}_command_deg")]
    before, after = (
        0.5 * float(np.ptp(values[part, column]))
        for part in (slice(2 * quarter, 3 * quarter), slice(3 * quarter, None))
    )
    return Cycle(after, abs(after / before - 1.0) < SETTLED, 0.5 * float(np.ptp(command)))
