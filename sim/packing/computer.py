"""The records of a scenario's flight computer, design, guidance and injected signals."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from maxq.control.burns import QUANTITIES, Burns, GuidedBurn, SETTLING_s
from maxq.control.computer import Computer, build_computer
from maxq.control.filter_schedule import FilterSchedule, MovingFilter, make_moving_filter
from maxq.control.filters import DiscreteFilter
from maxq.control.guidance import rate_programme
from maxq.control.kernel.limits import MAX_BURNS, MAX_INJECTIONS, MAX_TONES
from maxq.control.kernel.tables import NO_TABLE, Cubics, Method, Pool, fit
from maxq.control.laws.adaptive import Adaptive, make_adaptive
from maxq.control.laws.own import OwnLaw
from maxq.control.laws.pd import GainSchedule, gains_table
from maxq.control.loop_filters import LoopFilters, make_loop_filters
from maxq.control.orbit_guidance import OrbitGuidance
from maxq.control.roll import Roll, make_roll
from maxq.control.sensors import Sensors, make_sensors
from maxq.control.structures import GAIN_NAMES, INTEGRAL, OWN, Law
from maxq.sim.flight import injection as signals
from maxq.sim.flight.parameters import NEVER
from maxq.sim.input.remembered import cached_by_identity
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.input.values import to_ns
from maxq.sim.packing.environment import pack_earth
from maxq.sim.packing.integration import LONGEST_S
from maxq.sim.packing.own_law import own_code, pack_own_law
from maxq.sim.scenario.schema_design import AdaptiveSection, Design, FilterSection, GainsSection
from maxq.sim.scenario.schema_launch import Cutoff, OrbitTarget, Restart
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2
from maxq.sim.world.earth import FLAT, INVERSE_SQUARE, J2, UNIFORM, Earth

COAST_RATE_degps = 3.0  # limit of the commanded attitude rate without closed-loop guidance
_WHERE = {
    "gimbal_command": signals.GIMBAL_COMMAND,
    "rate_command": signals.RATE_COMMAND,
    "body_force": signals.BODY_FORCE,
    "body_torque": signals.BODY_TORQUE,
    "thrust": signals.THRUST,
}
_FORM = {
    "step": signals.STEP,
    "doublet": signals.DOUBLET,
    "sine": signals.SINE,
    "chirp": signals.CHIRP,
    "multisine": signals.MULTISINE,
    "table": signals.TABLE,
}
_AXIS = {"roll": 0, "pitch": 1, "yaw": 2, "x": 0, "y": 1, "z": 2}
_IN_RADIANS = ("gimbal_command", "rate_command")


def pack_computers(scenario: Scenario, pool: Pool) -> list[Computer]:
    """Return the computer of each stage; a stage with the computer and design of its predecessor continues with it."""
    out: list[Computer] = []
    for n, stage in enumerate(scenario.vehicle.stage):
        goes_on = scenario.design is None or not scenario.design.stage
        if n > 0 and goes_on and stage.computer == scenario.vehicle.stage[n - 1].computer:
            out.append(replace(out[-1], takes_over=0))
        else:
            out.append(replace(pack_computer(scenario, pool, n), takes_over=int(n > 0)))
    return out


def pack_computer(scenario: Scenario, pool: Pool, stage: int = 0) -> Computer:
    """Return the computer of a stage under the scenario's switches.

    Without a computer in the vehicle, the gimbal command is zero except for injected signals. It is then sampled in
    every step, or every `LONGEST_S` if run.accuracy is given and no signal is injected.
    """
    computer, switches = scenario.vehicle.computer_of(stage), scenario.switches
    design = scenario.design.of_stage(stage) if scenario.design is not None else None
    if computer is None:
        coarse = scenario.run.accuracy is not None and not scenario.injection
        return build_computer(pool, sample_ns=to_ns(LONGEST_S if coarse else scenario.run.step_s), control_on=False)
    sample_ns, external = to_ns(computer.sample_s), computer.law == "external"
    flown = design.filter if design and not external else None
    plugged = design is not None and design.law == "own"
    own = _own_law(design, computer.sample_s) if plugged and not external else None
    return build_computer(
        pool,
        sample_ns=sample_ns,
        delay_ns=to_ns(computer.delay_s) if switches.delay else 0,
        count_rad=0.0 if switches.converter == "ideal" else computer.count_rad,
        dac_step_rad=math.radians(computer.dac_step_deg),
        attitude=computer.attitude,
        angle_error_limit_rad=math.radians(computer.angle_error_limit_deg),
        command_limit_rad=math.radians(computer.command_limit_deg),
        law=design.law if design else "pd",
        gains=_gains(design.gains) if design and not (external and plugged) else None,
        over=design.gains.over if design else "time_s",
        integral_limit_rad=math.radians(design.gains.integral_limit_deg or math.inf) if design else math.inf,
        programme=_programme(scenario.guidance.programme, scenario.guidance.method),
        unrolled=scenario.guidance.axes == "unrolled",
        pitch_filter=_filter(flown, computer.sample_s) if flown and not flown.schedule else None,
        moving_filter=_moving_filter(flown, computer.sample_s, pool) if flown and flown.schedule else None,
        roll=_roll(design, sample_ns) if design else None,
        control_on=switches.control,
        guidance_on=switches.guidance,
        roll_on=switches.roll_control,
        external=external,
        sensors=_sensors(scenario, stage, design),
        relief_hz=design.load_relief.corner_hz if design and design.load_relief and not external else None,
        adaptive=_adaptive(design.adaptive, computer.sample_s, design.law) if design and not external else None,
        loops=_loop_filters(scenario.design, stage, computer.sample_s) if scenario.design and not external else None,
        own=own,
    )


@cached_by_identity
def _own_law(design: Design, sample_s: float) -> OwnLaw:
    assert design.plug_in is not None  # a check of the section
    code, gains = own_code(design.plug_in), design.gains
    if code.columns != design.gain_names:
        problem = f"the variables are {', '.join(code.names)}, the columns of the design {', '.join(design.gain_names)}"
        raise code.error("variables", problem, "a column own_NAME for each variable, in their order")
    first = tuple(float(gains.table[name][0]) for name in code.columns)
    return pack_own_law(design.plug_in, first, sample_s)


@cached_by_identity
def _loop_filters(design: Design, stage: int, sample_s: float) -> LoopFilters | None:
    given = design.of_stage(stage).loop_filters
    fade_s = (design.stage[stage].fade_s or 0.0) if 0 < stage < len(design.stage) else 0.0
    if given is None and fade_s == 0.0:
        return None
    each = () if given is None else given.each
    return make_loop_filters([_filter(f, sample_s) if f is not None else None for f in each], round(fade_s / sample_s))


@cached_by_identity
def _adaptive(given: AdaptiveSection | None, sample_s: float, law: Law) -> Adaptive | None:
    if given is None:
        return None
    values = dict(given)
    for name in ("error_gain", "damper_gain"):
        values[name] = values.pop(f"{name}_pdeg2s") * math.degrees(1.0) ** 2
    return make_adaptive(sample_s, **values, with_integral=law in INTEGRAL)


def _sensors(scenario: Scenario, stage: int, design: Design | None) -> Sensors | None:
    flown, computer = scenario.vehicle.stage[stage], scenario.vehicle.computer
    if not flown.sensors or computer is None:
        return None
    fine = scenario.switches.converter == "ideal"
    counts = [0.0 if fine else getattr(each, "count_mps", computer.count_rad) for each in flown.sensors]
    blend = design.blend.axes if design is not None and design.blend is not None else ()
    late = [each.latency_samples for each in flown.sensors]
    return make_sensors(counts, late, len(flown.accelerometers), blend)


@cached_by_identity
def _gains(gains: GainsSection) -> Cubics:
    return gains_table(*gain_schedules(gains))


def gain_schedules(gains: GainsSection) -> tuple[GainSchedule, GainSchedule]:
    """Return the gains in pitch and in yaw, which are the same object if yaw uses the gains of pitch."""
    pitch, yaw = gains.axes
    names = [name for name in GAIN_NAMES if name in pitch]
    own = [name for name in pitch.columns if name.startswith(OWN)]

    def schedule(table: CsvTable) -> GainSchedule:
        columns = {name: list(table[name]) for name in names}
        mine = {name: list(table[name]) for name in own}
        return GainSchedule(at=list(table[gains.over]), over=gains.over, **columns, own=mine)

    first = schedule(pitch)
    return first, first if yaw is pitch else schedule(yaw)


@cached_by_identity
def _filter(given: FilterSection, sample_s: float) -> DiscreteFilter:
    return given.continuous().discretize(sample_s, given.discretization, given.prewarp_hz)


def _moving_filter(given: FilterSection, sample_s: float, pool: Pool) -> MovingFilter:
    return make_moving_filter(pool, given.scheduled(), sample_s, given.discretization, given.prewarp_hz)


def bending_filter(design: Design) -> FilterSchedule:
    """Return the design's continuous bending filter over its scheduling variable."""
    return design.filter.scheduled()


def _roll(design: Design, sample_ns: int) -> Roll | None:
    roll = design.roll
    if roll is None:
        return None
    band, play = math.radians(roll.dead_band_deg), math.radians(roll.hysteresis_deg)
    return make_roll(sample_ns, roll.k_rate_s, band, play, roll.minimum_on_s)


@cached_by_identity
def _programme(table: CsvTable | None, method: Method) -> Cubics | None:
    if table is None:
        return None
    pitch, yaw, roll = (np.radians(table.get(f"{axis}_rate_degps")) for axis in ("pitch", "yaw", "roll"))
    return rate_programme(table["time_s"], pitch, yaw, roll, method)


def pack_burns(scenario: Scenario, stage: Stage, ignition_ns: int) -> Burns:
    """Return the burns of the last engine, which is first ignited at the flight time `ignition_ns`."""
    guidance, earth = scenario.guidance, pack_earth(scenario.earth)
    if not any(guidance.ends) or ignition_ns >= NEVER:
        return Burns()
    starts = (Restart.model_construct(), *guidance.restart)
    lead_s = 0.5 * stage.cutoff_decay_s
    burns = [_burn(end, start, earth, lead_s) for end, start in zip(guidance.ends, starts, strict=True)]
    first = burns[0].orbit
    burns[0] = replace(burns[0], orbit=replace(first, start_s=max(ignition_ns / 1e9 + SETTLING_s, first.start_s)))
    thrusters = stage.roll_thrusters
    return Burns(
        count=len(burns),
        start_s=ignition_ns / 1e9,
        turns=int(len(burns) > 1 and thrusters is not None and thrusters.pitch_yaw_torque_Nm is not None),
        earth_rate_radps=earth.rate_radps,
        equator_m=earth.equatorial_radius_m,
        flat_mps2=earth.uniform_mps2 if (earth.figure, earth.gravity) == (FLAT, UNIFORM) else 0.0,
        burn=(*burns, *[GuidedBurn()] * (MAX_BURNS - len(burns))),
    )


def _burn(end: OrbitTarget | Cutoff | None, start: Restart, earth: Earth, lead_s: float) -> GuidedBurn:
    """Return a burn from its target `end`, its `start` after a coast, and the lead of the cutoff command, s."""
    orbit = OrbitGuidance(
        rate_limit_radps=math.radians(COAST_RATE_degps),
        mu_m3ps2=_central_mu_m3ps2(earth),
        j2=earth.j2 if earth.gravity == J2 else 0.0,
        j2_radius_m=earth.gravity_radius_m,
        lead_s=lead_s,
    )
    burn = GuidedBurn(
        orbit if not isinstance(end, OrbitTarget) else _orbit_guidance(end, orbit, earth),
        coast_s=-1.0 if start.coast_s is None else start.coast_s,
        before_apogee_s=start.before_apogee_s or 0.0,
        settling_s=start.settling_s,
        settling_N=start.settling_thrust_N,
    )
    if not isinstance(end, Cutoff):
        return burn
    assert end.wanted is not None
    name, value = end.wanted
    return replace(burn, quantity=QUANTITIES.index(name), wanted=value)


def _central_mu_m3ps2(earth: Earth) -> float:
    """Return the gravitational parameter of a central field, or 0 without one."""
    if earth.gravity in (INVERSE_SQUARE, J2):
        return earth.mu_m3ps2
    round_uniform = earth.gravity == UNIFORM and earth.figure != FLAT
    return earth.uniform_mps2 * earth.equatorial_radius_m**2 if round_uniform else 0.0


def _orbit_guidance(target: OrbitTarget, orbit: OrbitGuidance, earth: Earth) -> OrbitGuidance:
    perigee_m, apogee_m = (earth.equatorial_radius_m + a for a in (target.perigee_altitude_m, target.apogee_altitude_m))
    semimajor_m, inclination_deg = 0.5 * (perigee_m + apogee_m), target.inclination_deg
    radius_m = perigee_m if target.cutoff_at == "perigee" else apogee_m
    return replace(
        orbit,
        on=1,
        start_s=target.start_s or SETTLING_s,
        cycle_s=target.cycle_s,
        rate_limit_radps=math.radians(target.rate_limit_degps),
        radius_m=radius_m,
        speed_mps=math.sqrt(earth.mu_m3ps2 * (2.0 / radius_m - 1.0 / semimajor_m)),
        semimajor_m=semimajor_m,
        cos_inclination=2.0 if inclination_deg is None else math.cos(math.radians(inclination_deg)),
        exhaust_mps=target.isp_s * STANDARD_GRAVITY_mps2,
    )


def pack_injections(scenario: Scenario, pool: Pool) -> signals.Injections:
    given = scenario.injection
    # linear, because steps are given by two rows close together, or by start_s and stop_s
    tables = {k: fit(i.table["time_s"], i.table["value"], "linear") for k, i in enumerate(given) if i.table is not None}
    tones = np.zeros((2, MAX_INJECTIONS, MAX_TONES))
    for k, i in enumerate(given):
        tone_hz = np.array(i.frequencies_hz or ())
        # Schroeder phases keep the peak of the sum low (IEEE Trans. Information Theory 16(1), 1970, p. 85)
        number = np.arange(1, len(tone_hz) + 1)
        tones[:, k, : len(tone_hz)] = tone_hz, -np.pi * number * (number - 1) / max(len(tone_hz), 1)
    unit = [math.radians(1.0) if i.at in _IN_RADIANS else 1.0 for i in given]
    return signals.Injections(
        count=len(given),
        where=_padded(_WHERE[i.at] for i in given),
        axis=_padded(_AXIS[i.axis] for i in given),
        form=_padded(_FORM[i.kind] for i in given),
        replaces=_padded(int(i.replaces) for i in given),
        start_ns=_padded(to_ns(i.start_s) for i in given),
        stop_ns=_padded(to_ns(i.stop_s) if i.stop_s is not None else NEVER for i in given),
        amplitude=_padded((u * i.amplitude for u, i in zip(unit, given, strict=True)), float),
        frequency_hz=_padded((i.frequency_hz or 0.0 for i in given), float),
        stop_frequency_hz=_padded((i.stop_frequency_hz or 0.0 for i in given), float),
        tones=_padded(len(i.frequencies_hz or ()) for i in given),
        tone_hz=tones[0],
        tone_phase=tones[1],
        column=_padded(list(tables).index(k) if k in tables else 0 for k in range(len(given))),
        table=pool.add(*tables.values()) if tables else NO_TABLE,
    )


def _padded(values: Iterable[float], kind: type = int) -> np.ndarray:
    given = list(values)
    return np.array(given + [0] * (MAX_INJECTIONS - len(given)), kind)
