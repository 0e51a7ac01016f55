"""A vehicle built from a layout: masses, modes, aerodynamics, ascent and first gains, with assumptions and warnings.

Every number is a first estimate. `Built.assumed` lists the assumptions beyond the layout.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.model.node_times import LEAST_SHARE
from maxq.sim.scenario.schema_design import Design
from maxq.sim.vehicle.modes.tables import ModeTable
from maxq.sim.vehicle.slosh.section import Profile
from maxq.sim.vehicle.slosh.shapes import modes_over
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2
from maxq.tools.vehicle.aerodynamics import Aerodynamics, aerodynamics
from maxq.tools.vehicle.beam import Beam, BeamMode, RigidLoad
from maxq.tools.vehicle.layout import Layout, LayoutStage, LayoutTank, steered_boosters
from maxq.tools.vehicle.masses import Rod, Stack, burn_of, engine_inertia, stacks
from maxq.tools.vehicle.trajectory import Ascent, TrajectoryPoint, ascent

MODE_ROWS = 13
MOST_RIGID_HZ = 0.4
SHARE = 0.8  # share of the first gains' frequency that a design must keep
IN_TAIL = 6  # rows of gains in a long tail-off
BELOW = 8.0  # least ratio of the frequencies of mode 1 and of the actuator to that of the rigid body
BELOW_SLOSH = 2.0  # least ratio of the frequency of the slowest slosh mode to that of the rigid body
_PROPELLANT_kgpm3 = 1400.0, 2000.0  # least and greatest density of solid propellants
_NEAR_NODE = 0.1  # share of the largest displacement
TimedModes = tuple[Array, list[list[BeamMode]]]  # times on the stage's clock, and the modes at each


@dataclass(frozen=True)
class Built:
    """A vehicle built from a layout. Lists are by stack; `modes` are at times of its clock."""

    layout: Layout
    stacks: list[Stack]
    aero: list[Aerodynamics]
    modes: list[TimedModes]
    flight: Ascent
    gains: list[tuple[float, float, float]]  # flight time (s), k_p, k_d (s)
    assumed: list[str] = field(default_factory=list)  # assumptions; the first ones, from `build`, name omitted modes
    design: Design | None = None  # gains and filters found by a search, instead of `gains` and wide notches

    @property
    def mode_1_hz(self) -> float:
        """Return the mean frequency of mode 1 over the first burn, or infinity without modes."""
        found = [modes[0].frequency_hz for modes in self.modes[0][1] if modes]
        return float(np.mean(found)) if found else math.inf

    def rigid_hz(self, p: TrajectoryPoint) -> float:
        """Return the rigid-body frequency for which the first gains are computed, Hz.

        The layout may specify it. The default is an eighth of the lower of mode 1 and the actuator, or half of the
        slowest slosh mode at that time, whichever is less, and at most 0.4 Hz. In a long tail-off, the frequency falls
        with the thrust, so that the rate gain is constant. The inertia of the engine excites the modes in proportion to
        this gain, whatever the thrust.
        """
        times, modes = self.modes[p.number]
        own = [of[0].frequency_hz for of in modes if of]
        first_hz = float(np.interp(p.clock_s, times, own)) if len(own) == len(times) else math.inf
        slowest_hz = min(first_hz, *self.stacks[p.number].stage.engine.servo_hz)
        most_hz = min(MOST_RIGID_HZ, slowest_hz / BELOW, slosh_hz(self.stacks[p.number], p) / BELOW_SLOSH)
        return (self.layout.control.rigid_hz or most_hz) * self.stacks[p.number].tail_share(p.clock_s)


def build(layout: Layout, progress: Callable[[str, int, int], None] = lambda *_: None) -> Built:
    """Build a vehicle from a layout.

    `progress` receives the name of each stage of the computation, the steps done, and their number (0: unknown). Raises
    ValueError if the vehicle cannot fly.
    """
    progress("computing the ascent", 0, 0)
    whole = stacks(layout)
    flight = ascent(layout, whole, [aerodynamics(stack) for stack in whole])
    every = flight.stacks
    aero = [aerodynamics(stack) for stack in every]
    found_modes = []
    for n, stack in enumerate(every):
        progress("computing bending modes", n, len(every))
        found_modes.append(_modes(stack))
    modes, left_out = _that_count(every, found_modes, 1.0 / layout.control.sample_s)
    found = Built(layout, every, aero, modes, flight, [], left_out)
    if not layout.unguided:
        progress("computing first gains", 0, 0)
        found.gains.extend(_gains(found))
    found.assumed.extend(_assumed(found))
    return found


def _slosh(tank: LayoutTank, liquid_kg: float) -> tuple[float, float]:
    """Return the mass (kg) and the pendulum length (m) of the first slosh mode of the liquid in a tank."""
    scale = tank.density_kgpm3 * tank.radius_m**3
    mass, length = _first_slosh_mode(tank.profile, liquid_kg / scale)
    return scale * mass, tank.radius_m * length


@lru_cache(maxsize=4096)
def _first_slosh_mode(profile: Profile, volume: float) -> tuple[float, float]:
    """Return the mass and the pendulum length of the first slosh mode of a liquid with this volume.

    All quantities are in units of the tank's radius and the liquid's density. Results are cached, because filters,
    gains and their checks use the same points of the ascent.
    """
    mode = modes_over(profile, profile.depth(np.array([volume])), 1)[0]
    return float(mode.mass[0]), float(mode.length[0])


def slosh_kg(tank: LayoutTank, liquid_kg: float) -> float:
    """Return the mass of the first slosh mode of the liquid in a tank."""
    return _slosh(tank, liquid_kg)[0]


def slosh_hz(stack: Stack, p: TrajectoryPoint) -> float:
    """Return the lowest frequency of the first slosh modes of the burning stage and its boosters, Hz.

    Each is that of a pendulum under thrust / mass, without drag. Returns infinity without thrust or liquid.
    """
    load_mps2, t = p.thrust_N / stack.mass_properties(p.clock_s).mass_kg, p.clock_s
    liquids = [(tank, stack.liquid_kg(tank, t)) for tank in stack.stage.tank]
    liquids += [(tank, s.liquid_kg(tank, t)) for s in stack.boosters for tank in s.booster.tank]
    lengths_m = [_slosh(tank, liquid_kg)[1] for tank, liquid_kg in liquids if liquid_kg > 0.0]
    return math.sqrt(load_mps2 / max(lengths_m)) / (2.0 * math.pi) if lengths_m and load_mps2 > 0.0 else math.inf


def _modes(stack: Stack) -> TimedModes:
    stage, times = stack.stage, np.linspace(stack.begins_s, stack.end_s, MODE_ROWS)
    if (bending := stage.bending) is not None:
        table = bending.pitch_modes or bending.yaw_modes
        return times, [[] if table is None else _mode_of(table, t) for t in times]
    if (spatial := stage.spatial_modes) is not None:
        in_pitch = spatial.modes.lateral()[1]
        return times, [_mode_of(in_pitch, t) for t in times]
    beam = Beam.of(stack)
    found = [
        beam.modes(beam_load(stack, float(t)), stage.modes, beam_boosters(stack, float(t))) if stage.modes else []
        for t in times
    ]
    for k in range(stage.modes):
        if min(abs(modes[k].phi[-1]) / np.abs(modes[k].phi).max() for modes in found) < _NEAR_NODE:
            _renormalise(found, k)
    return times, found


def _renormalise(found: list[list[BeamMode]], k: int) -> None:
    """Scale mode k in place to a largest displacement of 1 and an equal sign at all times.

    This is for a mode with the gimbal near a node, where a displacement of 1 at the gimbal would be meaningless.
    """
    before = found[0][k].phi
    for modes in found:
        mode = modes[k]
        scale = math.copysign(1.0 / float(np.abs(mode.phi).max()), float(mode.phi @ before))
        modes[k] = replace(
            mode,
            generalized_mass_kg=mode.generalized_mass_kg * scale**2,
            phi=mode.phi * scale,
            slope_pm=mode.slope_pm * scale,
        )
        before = modes[k].phi


def _that_count(
    every: Sequence[Stack], modes: list[TimedModes], highest_hz: float
) -> tuple[list[TimedModes], list[str]]:
    """Return the modes of each stack whose frequency starts at or below `highest_hz`, and texts on the omitted modes.

    All parts of a stage keep an equal number of modes. Modes given by the layout are all kept.
    """
    out, words = list(modes), []
    for number, stage in enumerate(every[0].layout.stage):
        parts = [n for n, stack in enumerate(every) if stack.number == number]
        if stage.bending is not None or stage.spatial_modes is not None or not stage.modes:
            continue
        lowest = [min(at[k].frequency_hz for n in parts for at in modes[n][1]) for k in range(stage.modes)]
        kept = sum(hz <= highest_hz for hz in lowest)
        for n in parts:
            out[n] = modes[n][0], [at[:kept] for at in modes[n][1]]
        if kept < stage.modes:
            above = f"from {lowest[kept]:.0f} Hz, above the sample rate of {highest_hz:g} Hz"
            words.append(f"{stage.name}: bending modes {kept + 1} and above are omitted ({above})")
    return out, words


def beam_load(stack: Stack, t: float) -> list[Rod]:
    """Return the masses that the beam carries at time `t` (s) of the stage's clock: all but sloshing masses and
    boosters.
    """
    rods = [*stack.dry, *stack.grains(t)]
    for tank, liquid in zip(stack.stage.tank, stack.liquids(t), strict=True):
        left = liquid.mass_kg - slosh_kg(tank, liquid.mass_kg)
        rods.append(Rod(left, liquid.front_station_m, liquid.rear_station_m, 0.0, 0.0))
    return rods


def beam_boosters(stack: Stack, t: float) -> list[RigidLoad]:
    """Return the boosters that the beam carries at time `t` (s) of the stage's clock, without their sloshing masses."""
    out = []
    for s in stack.boosters:
        rods = s.rods(t)
        for k, tank in enumerate(s.booster.tank, start=len(s.dry)):
            rods[k] = replace(rods[k], mass_kg=rods[k].mass_kg - slosh_kg(tank, rods[k].mass_kg))
        out += [RigidLoad(s.booster.attachments_m, rods)] * len(s.booster.positions_m)
    return out


def on_the_pad(built: Built) -> list[BeamMode]:
    """Return the bending modes of the full vehicle clamped at its tail, at most three, or none if the layout gives
    modes.
    """
    stack = built.stacks[0]
    if not stack.stage.modes or stack.stage.bending is not None or stack.stage.spatial_modes is not None:
        return []
    count = min(stack.stage.modes, 3)
    return Beam.of(stack).modes(beam_load(stack, 0.0), count, beam_boosters(stack, 0.0), clamped=True)


def _mode_of(table: ModeTable, t: float) -> list[BeamMode]:
    """Return the modes of a table at the row nearest to time `t` (s)."""
    k = int(np.argmin(np.abs(table.time_s - t)))
    return [
        BeamMode(table.station_m, float(hz), float(kg), table.phi[k, m], table.slope_pm[k, m])
        for m, (hz, kg) in enumerate(zip(table.frequency_hz[k], table.generalized_mass_kg[k], strict=True))
    ]


def m_alpha_1ps2(built: Built, p: TrajectoryPoint) -> float:
    """Return the angular acceleration in pitch per angle of attack, 1/s2, positive for an unstable vehicle."""
    aero, props = built.aero[p.number], built.stacks[p.number].mass_properties(p.clock_s)
    slope, centre = aero.normal(p.mach)
    return slope * p.dynamic_pressure_Pa * aero.area_m2 * (props.x_cg_m - centre) / props.pitch_kgm2


def m_delta_1ps2(built: Built, p: TrajectoryPoint) -> float:
    """Return the angular acceleration in pitch per gimbal angle, 1/s2."""
    stack = built.stacks[p.number]
    props = stack.mass_properties(p.clock_s)
    return p.steered_N * (stack.stage.engine.gimbal_station_m - props.x_cg_m) / props.pitch_kgm2


def burning(built: Built, number: int | None = None) -> list[TrajectoryPoint]:
    """Return the points of the ascent at full thrust, of all stacks or of stack `number`."""
    full_s = [stack.full_s for stack in built.stacks]
    points = [p for p in built.flight.points if number in (None, p.number)]
    return [p for p in points if full_s[p.number][0] <= p.clock_s <= full_s[p.number][1]]


def spread(points: Sequence[TrajectoryPoint], count: int) -> list[TrajectoryPoint]:
    """Return at most `count` of the points, evenly spaced from the first to the last."""
    return [points[k] for k in np.unique(np.linspace(0, len(points) - 1, count).astype(int))] if points else []


def tail_off(built: Built, number: int) -> list[TrajectoryPoint]:
    """Return the points of a stack in a long tail-off, while its thrust in vacuum is at least `LEAST_SHARE` of the
    largest.
    """
    stack = built.stacks[number]
    if not stack.has_long_tail:
        return []
    least_N = LEAST_SHARE * float(stack.burn.thrust_N.max())
    points = [p for p in built.flight.points if p.number == number and p.clock_s > stack.full_s[1]]
    return [p for p in points if stack.burn.thrust_vacuum_N(p.clock_s) >= least_N]


def dozen(built: Built) -> list[TrajectoryPoint]:
    """Return points of each stack: twelve at full thrust, and `IN_TAIL` in a long tail-off."""
    every = range(len(built.stacks))
    return [p for n in every for p in (*spread(burning(built, n), 12), *spread(tail_off(built, n), IN_TAIL))]


def _gains(built: Built) -> list[tuple[float, float, float]]:
    """Return rows of flight time (s), k_p and k_d (s) that give the rigid body its frequency and damping.

    M_alpha is included: k_p = (omega^2 + M_alpha) / M_delta.
    """
    zeta, rows = built.layout.control.rigid_zeta, []
    for p in dozen(built):
        omega, delta = 2.0 * math.pi * built.rigid_hz(p), m_delta_1ps2(built, p)
        alpha = max(m_alpha_1ps2(built, p), 0.0)
        rows.append((round(p.time_s, 3), (omega**2 + alpha) / delta, 2.0 * zeta * omega / delta))
    return rows


def least_rigid_hz(built: Built, aero_gain_db: float) -> tuple[list[float], list[float]]:
    """Return flight times (s) and the least rigid-body frequency (Hz) required at each.

    The frequency is SHARE of that of the first gains, or the frequency that an unstable vehicle needs for its lower
    gain margin g, whichever is greater. From M_delta k_p = g M_alpha follows omega^2 = (g - 1) M_alpha. Rows between
    two rows of the same frequency are omitted.
    """
    factor, rows = 10.0 ** (aero_gain_db / 20.0) - 1.0, []
    for p in dozen(built):
        needed = math.sqrt(factor * max(m_alpha_1ps2(built, p), 0.0)) / (2.0 * math.pi)
        rows.append((round(p.time_s, 3), round(max(SHARE * built.rigid_hz(p), needed), 3)))
    kept = [
        row for k, row in enumerate(rows) if k in (0, len(rows) - 1) or not rows[k - 1][1] == row[1] == rows[k + 1][1]
    ]
    return [t for t, _ in kept], [hz for _, hz in kept]


def _assumed(built: Built) -> list[str]:
    layout = built.layout
    lines = []
    each_hz = [built.rigid_hz(p) for p in burning(built)]
    first_hz = " to ".join(dict.fromkeys(f"{end(each_hz):.3g}" for end in (min, max)))
    if any(stage.aero is None for stage in layout.stage):
        factor = f", times {layout.axial_factor:g}" if layout.axial_factor != 1.0 else ""
        lines.append(f"axial force: a curve of a clean launcher over Mach number{factor}")
        lines.append("normal force: slender-body theory and Barrowman's fins, with an assumed Mach correction")
    lines.append(
        "propellants drain in proportion to their load; liquids contribute to the roll inertia only via roll_share"
    )
    if layout.unguided:
        return lines
    zeta = layout.control.rigid_zeta
    lines.append(f"first gains: rigid body with {first_hz} Hz and damping ratio {zeta:g}, M_alpha included")
    jet = f"{layout.site.jet_mps:g} m/s at 11 km"
    lines.append(f"limit wind of the suite: from the west, {jet}; replace it by that of your site")
    for stack in built.stacks:
        if stack.leave_s is not None:
            words = "; their normal and axial forces add to those of the core without interference"
            words = ("rigid" if steered_boosters(stack.stage) else "rigid, fixed nozzles") + words
            lines.append(f"{stack.name}: until {stack.leave_s:.1f} s; {words}")
    if layout.fairing is not None:
        dropped = [n for n, stack in enumerate(built.stacks) if stack.drops_fairing]
        at = f"dropped at {built.flight.begins_s[dropped[0] + 1]:.1f} s" if dropped else "never dropped: too low"
        lines.append(f"fairing: {at}; aerodynamics and beam remain those with the fairing")
    for stage in layout.stage:
        e = stage.engine
        if e.gimballed_mass_kg is None or e.cg_from_gimbal_m is None:
            mass, arm, _ = engine_inertia(e)
            lines.append(f"{stage.name}: {mass:.4g} kg of each engine move with the gimbal, CG {arm:.3g} m aft of it")
    return lines


INCIDENCE_deg = 5.0


def too_weak(built: Built) -> list[str]:
    """Return a line for each stack whose gimbals cannot hold an angle of attack of `INCIDENCE_deg` at full thrust."""
    out = list[str]()
    if built.layout.unguided:
        return out
    for n, stack in enumerate(built.stacks):
        worst = max(burning(built, n), key=lambda p: m_alpha_1ps2(built, p) / m_delta_1ps2(built, p))
        needed = INCIDENCE_deg * m_alpha_1ps2(built, worst) / m_delta_1ps2(built, worst)
        if needed > (limit := stack.stage.engine.angle_limit_deg):
            held = f"{INCIDENCE_deg:g} deg angle of attack need {needed:.1f} deg of the gimbals' {limit:g}"
            out.append(f"{stack.name}: at {worst.time_s:.0f} s {held}")
    return out


def warnings(built: Built) -> list[str]:
    """Return a line for each value that is possible, but unusual."""
    out, half_hz = [], 0.5 / built.layout.control.sample_s
    for stack, (_, modes) in zip(built.stacks, built.modes, strict=True):
        for k, mode in enumerate([] if built.layout.unguided else modes[0]):
            if mode.frequency_hz > half_hz:
                what = f"mode {k + 1} at {mode.frequency_hz:.1f} Hz is above half the sample rate, {half_hz:g} Hz"
                out.append(f"{stack.name}: {what}")
    for stage in built.layout.stage:
        e = stage.engine
        if e.thrust is not None:
            burn = burn_of(stage, 0.0)
            burned = burn.burned_kg
            if burned is None and e.isp_vacuum_s is not None:
                burned = burn.impulse_Ns / (STANDARD_GRAVITY_mps2 * e.isp_vacuum_s)
            if burned is not None and abs(burned - stage.usable_kg) > 0.02 * stage.usable_kg:
                holds = f"the stage holds {stage.usable_kg:.4g} kg"
                out.append(f"{stage.name}: its thrust file burns {burned:.4g} kg, {holds}")
        out += [f"{stage.name}: {line}" for line in _unusual_grains(stage)]
    out += [f"{built.stacks[n].name}: {line}" for n, line in _unstable(built)]
    if not built.layout.unguided and built.mode_1_hz < 6.0 * MOST_RIGID_HZ:
        out.append(f"mode 1 at {built.mode_1_hz:.2f} Hz is less than six times the rigid body's {MOST_RIGID_HZ:g} Hz")
    return out


def static_margin(built: Built, p: TrajectoryPoint) -> float:
    """Return the distance of the centre of pressure behind the CG at a point of the ascent, in largest diameters."""
    aero = built.aero[p.number]
    return (aero.normal(p.mach)[1] - built.stacks[p.number].mass_properties(p.clock_s).x_cg_m) / aero.diameter_m


def _unstable(built: Built) -> list[tuple[int, str]]:
    """Return the stacks of an unguided vehicle with a static margin below one diameter, with its least value."""
    out = []
    for n in range(len(built.stacks) if built.layout.unguided else 0):
        points = burning(built, n)
        worst = min(points, key=lambda p: static_margin(built, p))
        if (margin := static_margin(built, worst)) < 1.0:
            out.append((n, f"static margin {margin:.2f} diameters at {worst.time_s:.1f} s, usual are 1 and more"))
    return out


def _unusual_grains(stage: LayoutStage) -> list[str]:
    """Return a line for each grain whose density, by its mass and shape, is not that of a solid propellant."""
    out = []
    for grain in stage.grain:
        if grain.burns != "uniform":
            across = (grain.radius_m or 0.5 * stage.diameter_m) ** 2 - (grain.port_radius_m or 0.0) ** 2
            density = grain.mass_kg / (math.pi * across * (grain.rear_station_m - grain.front_station_m))
            if not _PROPELLANT_kgpm3[0] <= density <= _PROPELLANT_kgpm3[1]:
                usual = f"{_PROPELLANT_kgpm3[0]:g} to {_PROPELLANT_kgpm3[1]:g}"
                out.append(f"the grain has {density:.0f} kg/m3 by its mass and shape, usual are {usual}")
    return out
