"""Slosh: the positions at which it destabilises the control loop, the required damping, and its limit cycle.

Slosh extracts energy from the control loop if the pendulum bob is between the vehicle's CG and its centre of
percussion. This centre is I / (m l_c) forward of the CG, with the distance l_c from the CG to the gimbal. At other
positions it returns energy to the loop (Bauer, NASA TR R-187; SP-8031). The magnitude of the effect depends on the
loop. The required damping is found by lowering the damping of a tank until the closed loop is marginally stable
(`advise`).

The damping of a ring baffle increases with the wave height (Miles, J. Aero. Sci. 25, 1958; NASA SP-106, eq. 4.10),

    zeta = 2.83 exp(-4.6 d / R) a^(3/2) sqrt(eta / R)

with the depth d of the ring below the surface, the fraction a of the surface that it covers, and the wave height eta at
the wall. The simulator's baffles have this law (docs/model.md, section 5). In a loop that requires the damping zeta,
slosh grows while the wave is lower than the height with this damping, and decays above it. That height is the amplitude
of a limit cycle. The wave of the first mode (xi = 1.841) corresponds to a pendulum swing of

    theta = (xi^2 - 1) / 2  eta / R

at any depth (sim/vehicle/slosh/packing.py). The worst tank is confirmed in flight (`confirm`). With the required
damping, a burst neither grows nor decays. With the baffle's law, the swing ends at the predicted amplitude
(`fly_cycle`).

No other effect limits slosh within the range of the model. Without baffles, gimbal and servo remain far from their
limits until the liquid has swung through a right angle (tests/test_oracle_slosh_cycle.py). Real waves would break at a
much smaller swing.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.certificate import measured_margins
from maxq.design.certificate.excitation import sine_burst
from maxq.design.certificate.held_flight import CodeDiffers, CodeLost, HeldFlight, hold
from maxq.design.certificate.measured_margins import amplitude
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop, close_loop, loops
from maxq.design.model.node import Node, slosh_columns
from maxq.design.model.state_space import ComplexArray
from maxq.sim.packing.flight import Packed
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_design import Design
from maxq.sim.vehicle.slosh.packing import WAVE_PER_SWING, ring_damping

SWING_PER_WAVE = 1.0 / WAVE_PER_SWING[0]  # swing, rad, for a wave height at the wall of one radius
WATCHED_S = 400.0  # several time constants of a limit cycle that settles within a minute
SETTLED = 0.03  # allowed relative difference between the amplitudes of the last two quarters
_HALVINGS = 12
_BAND_RADPS = (0.5, 31.0)  # slosh and rigid body, up to 5 Hz


@dataclass(frozen=True)
class Baffle:
    """A ring baffle at a depth of `depth_r` radii below the surface, which covers the fraction `cover` of it."""

    depth_r: float
    cover: float

    def damping(self, swing_rad: float) -> float:
        """Return the damping ratio of a pendulum with a given swing."""
        return ring_damping(self.depth_r, self.cover, abs(swing_rad) / SWING_PER_WAVE)

    def wave_m(self, damping: float, radius_m: float) -> float:
        """Return the wave height at the wall for which the baffle has a given damping ratio."""
        return radius_m * (damping / ring_damping(self.depth_r, self.cover, 1.0)) ** 2

    def swing_deg(self, damping: float) -> float:
        """Return the pendulum swing for which the baffle has a given damping ratio."""
        return math.degrees(SWING_PER_WAVE * self.wave_m(damping, 1.0))


@dataclass(frozen=True)
class SloshCycle:
    """The final amplitudes (deg) of a tank's swing and of the gimbal command in flight.

    `settled` is True if the swing amplitude is constant. The amplitudes are NaN if the flight ended early.
    """

    swing_deg: float
    settled: bool
    gimbal_deg: float


def fly_cycle(held: HeldFlight, tank: int, baffle: Baffle, frequency_hz: float, level: float = 1.0) -> SloshCycle:
    """Fly the held flight with an excitation at the slosh frequency, with only the baffle's damping in the tank.

    `level` scales the burst of the certificate (`burst_rad`), so that the limit cycle is reached from above or below.
    """

    def baffled(packed: Packed) -> None:
        slosh = packed.parameters[0].vehicle.slosh
        _damp(slosh, tank, 0.0)
        slosh.law, slosh.ring_damping[tank] = 1, baffle.damping(1.0)

    run, values = held.fly(WATCHED_S, (sine_burst(held, frequency_hz, level),), baffled)
    column = slosh_columns(run, held.plane)[tank]
    quarter = len(values) // 4
    if run.now_s < WATCHED_S - 1.0 or quarter < 8:
        return SloshCycle(math.nan, False, math.nan)
    command = values[3 * quarter :, run.table.index(f"gimbal_{held.plane}_command_deg")]
    before, after = amplitude(values[2 * quarter : 3 * quarter, column]), amplitude(values[3 * quarter :, column])
    return SloshCycle(after, abs(after / before - 1.0) < SETTLED, amplitude(command))


def _damp(slosh: Any, tank: int, ratio: float) -> None:
    """Replace all damping of a packed pendulum by a constant damping ratio."""
    slosh.damping_ratio[tank], slosh.law_factor[tank] = ratio, 0.0


NEAR, MIDWAY = Baffle(0.1, 0.25), Baffle(0.5, 0.25)
"""Rings with a width of an eighth of the radius: just below the surface, and with the surface midway between two."""


@dataclass(frozen=True)
class SloshAdvice:
    """The required damping of one tank at one time, and the baffles that provide it.

    Stations are in m aft of the nose. Damping ratios are those of the pendulum. `needed` is the damping at which the
    closed loop is marginally stable, or 0 if none is needed. `wave_m` and `midway_wave_m` are the wave heights at which
    the baffles `NEAR` and `MIDWAY` provide this damping. `midway_deg` is the swing of the latter, which is the
    amplitude of the limit cycle. `flown_growth_1ps` is the growth rate of a burst in flight with the damping needed.
    `flown_deg` is the amplitude of the limit cycle in flight with the midway ring. Both are NaN if they were not flown;
    `flown_deg` also if it did not settle.
    """

    time_s: float
    stage: int  # from 0
    tank: int
    bob_station_m: float
    cg_station_m: float
    percussion_station_m: float
    damping: float
    needed: float
    wave_m: float
    midway_wave_m: float
    midway_deg: float
    flown_growth_1ps: float = math.nan
    flown_deg: float = math.nan

    @property
    def in_band(self) -> bool:
        """Return True if the bob is between the centre of percussion and the CG."""
        return self.percussion_station_m < self.bob_station_m < self.cg_station_m


def percussion_station_m(node: Node) -> float:
    """Return the centre of percussion for lateral thrust, where the onset of thrust causes no lateral acceleration."""
    d = node.derivatives
    return node.vehicle.total_cg_station_m - d.z_delta_1ps * node.condition.airspeed_mps / d.m_delta_1ps2


def advise(nodes: Sequence[Node], design: Design) -> list[SloshAdvice]:
    """Return the required damping of every tank with liquid at every operating point."""
    out = []
    for node in nodes:
        bobs = node.vehicle.pendulums
        for k in range(len(bobs.mass_kg)):
            if bobs.mass_kg[k] <= 0.0:
                continue
            needed = _needed(node, design, k)
            radius = node.surface_radius_m[k] if k < len(node.surface_radius_m) else math.nan
            out.append(
                SloshAdvice(
                    node.time_s,
                    node.stage,
                    k,
                    float(bobs.bob_station_m[k]),
                    node.vehicle.total_cg_station_m,
                    percussion_station_m(node),
                    float(_has(node)[k]),
                    needed,
                    NEAR.wave_m(needed, radius),
                    MIDWAY.wave_m(needed, radius),
                    MIDWAY.swing_deg(needed),
                )
            )
    return out


def _has(node: Node) -> Array:
    """Return the damping ratios of the tanks for small waves."""
    return node.vehicle.pendulums.small_wave_damping(node.axial_load_mps2)


def _needed(node: Node, design: Design, tank: int) -> float:
    """Return the damping ratio of one tank below which the closed loop is unstable, or 0 if it is always stable."""
    have = float(_has(node)[tank]) or 0.01  # baffles alone provide no damping for small waves
    if _growth(node, design, tank, 0.0) < 0.0:
        return 0.0
    low, high = 0.0, 1.0
    while _growth(node, design, tank, have * high) >= 0.0:
        low, high = high, 2.0 * high
        if high > 64.0:
            return math.inf
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _growth(node, design, tank, have * middle) >= 0.0 else (low, middle)
    return have * high


def _growth(node: Node, design: Design, tank: int, ratio: float) -> float:
    """Return the greatest real part (1/s) of the oscillatory closed-loop poles in the slosh band.

    The damping of the tank is replaced by `ratio`.
    """
    loop = close_loop(fixed_path(_damped(node, tank, ratio)), design)
    return float(_oscillating(loop).real.max(initial=-math.inf))


def _damped(node: Node, tank: int, ratio: float) -> Node:
    held = node.held.copied()
    for name, value in (("damping_ratio", ratio), ("law_factor", 0.0), ("ring_damping", 0.0)):
        held.vehicle["slosh"][name][:, tank] = value
    return dataclasses.replace(node, held=held)


def _oscillating(loop: Loop) -> ComplexArray:
    """Return the closed-loop poles in the slosh band, one of each conjugate pair, rad/s."""
    poles = loop.closed_poles()
    return poles[(poles.imag > _BAND_RADPS[0]) & (poles.imag < _BAND_RADPS[1])]


def confirm(loaded: LoadedScenario, node: Node, advice: SloshAdvice) -> SloshAdvice:
    """Fly the held vehicle excited at the slosh frequency, with the required damping and with the midway ring.

    External flight code that loses control before the operating point, or fails the replay check, leaves the advice
    unconfirmed.
    """
    if not 0.0 < advice.needed < math.inf:
        return advice
    with suppress(CodeDiffers, CodeLost):
        return _confirmed(loaded, node, advice)
    return advice


def _confirmed(loaded: LoadedScenario, node: Node, advice: SloshAdvice) -> SloshAdvice:

    def fault(packed: Packed) -> None:
        _damp(packed.parameters[0].vehicle.slosh, advice.tank, advice.needed)

    held = hold(loaded, node, fault)
    assert loaded.design is not None
    loop = loops([held.node], loaded.design)[0]
    edge = loops([_damped(held.node, advice.tank, advice.needed)], loaded.design)[0]
    poles = _oscillating(edge)
    hz = float(poles[int(np.argmax(poles.real))].imag) / (2.0 * math.pi)
    burst = measured_margins.burst_test(hz, measured_margins.build_up_rate(edge, hz))
    growth = measured_margins.measured_growth(held, loop, burst)
    known = growth not in (measured_margins.SATURATED, measured_margins.DECAYED)
    cycle = fly_cycle(hold(loaded, node), advice.tank, MIDWAY, hz)
    return dataclasses.replace(
        advice,
        flown_growth_1ps=growth if known else math.copysign(9.99, growth),
        flown_deg=cycle.swing_deg if cycle.settled else math.nan,
    )
