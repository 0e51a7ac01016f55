"""From a layout to what simrun, simdesign and simverify read: the vehicle's tables, a pitch programme, a first design,
a scenario, a campaign, a case and a suite.

Every number is an estimate to begin with. What was assumed beyond the layout is listed in `Built.assumed`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from maxq.control.kernel.records import Array
from maxq.sim.files import write_whole
from maxq.sim.packing.slosh_modes import modes_over
from maxq.sim.scenario.modes import ModeTable
from maxq.sim.scenario.schema_stage import SECTIONS
from maxq.sim.scenario.schema_values import Section
from maxq.sim.scenario.tables_csv import CsvTable
from maxq.tools.vehicle.aerodynamics import Aerodynamics, aerodynamics
from maxq.tools.vehicle.beam import Beam, Mode
from maxq.tools.vehicle.layout import Layout, Tank
from maxq.tools.vehicle.masses import Rod, Stack, engine_inertia, stacks
from maxq.tools.vehicle.trajectory import Ascent, Point, ascent

MASS_ROWS, MODE_ROWS, SHAPE_STATIONS = 41, 13, 41
MOST_RIGID_HZ = 0.4
_NEAR_NODE = 0.1  # of the largest displacement
SHOWN = 0.4  # share of the sample rate up to which a mode gets a notch
SPREAD = {"thrust at equal impulse": 0.03, "normal force": 0.15, "axial force": 0.1, "frequency of mode 1": 0.05}
Table = tuple[str, Sequence[tuple[Any, ...]]]  # head and rows of a CSV file
Tables = dict[str, Table]  # by the file's name
Modes = tuple[Array, list[list[Mode]]]  # times of the stage's clock, modes at each


@dataclass(frozen=True)
class Built:
    """A layout worked out. `modes`: of each stage, at times of its clock."""

    layout: Layout
    stacks: list[Stack]
    aero: list[Aerodynamics]
    modes: list[tuple[Array, list[list[Mode]]]]
    flight: Ascent
    gains: list[tuple[float, float, float]]  # flight time, k_p, k_d
    assumed: list[str] = field(default_factory=list)  # those of `build` first: modes that are left out

    @property
    def mode_1_hz(self) -> float:
        """Of the first stage, mean over its burn; infinite without modes."""
        found = [modes[0].frequency_hz for modes in self.modes[0][1] if modes]
        return float(np.mean(found)) if found else math.inf


def build(layout: Layout) -> Built:
    """Work out a layout. Raises ValueError where it cannot fly."""
    whole = stacks(layout)
    flight = ascent(layout, whole, [aerodynamics(stack) for stack in whole])
    every = flight.stacks
    aero = [aerodynamics(stack) for stack in every]
    modes, left_out = _that_count(every, [_modes(stack) for stack in every], 1.0 / layout.control.sample_s)
    found = Built(layout, every, aero, modes, flight, [], left_out)
    rigid_hz = layout.control.rigid_hz or min(MOST_RIGID_HZ, found.mode_1_hz / 8.0)
    found.gains.extend(_gains(found, rigid_hz))
    found.assumed.extend(_assumed(found, rigid_hz))
    return found


def slosh_kg(tank: Tank, liquid_kg: float) -> float:
    """Mass of the first slosh mode of a tank's liquid."""
    scale = tank.density_kgpm3 * tank.radius_m**3
    depth = tank.profile.depth(np.array([liquid_kg / scale]))
    return float(scale * modes_over(tank.profile, depth, 1)[0].mass[0])


def _modes(stack: Stack) -> Modes:
    stage, times = stack.stage, np.linspace(0.0, stack.burn.end_s, MODE_ROWS)
    if (bending := stage.bending) is not None:
        table = bending.pitch_modes or bending.yaw_modes
        return times, [[] if table is None else _mode_of(table, t) for t in times]
    if (spatial := stage.spatial_modes) is not None:
        in_pitch = spatial.modes.lateral()[1]
        return times, [_mode_of(in_pitch, t) for t in times]
    beam = Beam.of(stack)
    found = [beam.modes(beam_load(stack, float(t)), stage.modes) if stage.modes else [] for t in times]
    for k in range(stage.modes):
        if min(abs(modes[k].phi[-1]) / np.abs(modes[k].phi).max() for modes in found) < _NEAR_NODE:
            _renormalise(found, k)
    return times, found


def _renormalise(found: list[list[Mode]], k: int) -> None:
    """Mode k with 1 as its largest displacement, the same way round at all times: the gimbal lies near a node."""
    before = found[0][k].phi
    for modes in found:
        mode = modes[k]
        scale = math.copysign(1.0 / float(np.abs(mode.phi).max()), float(mode.phi @ before))
        modes[k] = replace(
            mode, generalized_mass_kg=mode.generalized_mass_kg * scale**2, phi=mode.phi * scale,
            slope_pm=mode.slope_pm * scale,
        )  # fmt: skip  # two more lines otherwise
        before = modes[k].phi


def _that_count(every: Sequence[Stack], modes: list[Modes], highest_hz: float) -> tuple[list[Modes], list[str]]:
    """The beam's modes that begin below a frequency, as many in all parts of a stage; and words about the others."""
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
            above = f"from {lowest[kept]:.0f} Hz, above the computer's {highest_hz:g} samples a second"
            words.append(f"{stage.name}: bending modes from number {kept + 1} on are left out ({above})")
    return out, words


def beam_load(stack: Stack, t: float) -> list[Rod]:
    """What rides on the beam at `t` of the stage's clock: all but what sloshes."""
    rods = [*stack.dry, *stack.grains(t)]
    for tank, liquid in zip(stack.stage.tank, stack.liquids(t), strict=True):
        left = liquid.mass_kg - slosh_kg(tank, liquid.mass_kg)
        rods.append(Rod(left, liquid.front_station_m, liquid.rear_station_m, 0.0, 0.0))
    return rods


def on_the_pad(built: Built) -> list[Mode]:
    """Bending modes of the full vehicle held at its tail; none where the beam is not used."""
    stack = built.stacks[0]
    if not stack.stage.modes or stack.stage.bending is not None or stack.stage.spatial_modes is not None:
        return []
    return Beam.of(stack).modes(beam_load(stack, 0.0), min(stack.stage.modes, 3), clamped=True)


def _mode_of(table: ModeTable, t: float) -> list[Mode]:
    """Modes that are given, at the row nearest to a time."""
    k = int(np.argmin(np.abs(table.time_s - t)))
    return [
        Mode(table.station_m, float(hz), float(kg), table.phi[k, m], table.slope_pm[k, m])
        for m, (hz, kg) in enumerate(zip(table.frequency_hz[k], table.generalized_mass_kg[k], strict=True))
    ]


def m_alpha_1ps2(built: Built, p: Point) -> float:
    """Angular acceleration per incidence, positive for an unstable vehicle."""
    aero, props = built.aero[p.number], built.stacks[p.number].mass_properties(p.clock_s)
    slope, centre = aero.normal(p.mach)
    return slope * p.dynamic_pressure_Pa * aero.area_m2 * (props.x_cg_m - centre) / props.pitch_kgm2


def m_delta_1ps2(built: Built, p: Point) -> float:
    """Angular acceleration per gimbal angle."""
    stack = built.stacks[p.number]
    props = stack.mass_properties(p.clock_s)
    return p.thrust_N * (stack.stage.engine.gimbal_station_m - props.x_cg_m) / props.pitch_kgm2


def burning(built: Built) -> list[Point]:
    """Points at full thrust."""
    out = []
    for p in built.flight.points:
        begin, end = built.stacks[p.number].burn.full_s
        if begin <= p.clock_s <= end:
            out.append(p)
    return out


def _gains(built: Built, rigid_hz: float) -> list[tuple[float, float, float]]:
    """Gains that give the rigid body its frequency and damping with M_alpha in it, at a dozen times a stage."""
    omega, zeta, rows = 2.0 * math.pi * rigid_hz, built.layout.control.rigid_zeta, []
    for n in range(len(built.stacks)):
        points = [p for p in burning(built) if p.number == n]
        for k in np.unique(np.linspace(0, len(points) - 1, 12).astype(int)):
            p = points[k]
            delta, alpha = m_delta_1ps2(built, p), max(m_alpha_1ps2(built, p), 0.0)
            rows.append((round(p.time_s, 3), (omega**2 + alpha) / delta, 2.0 * zeta * omega / delta))
    return rows


def _assumed(built: Built, rigid_hz: float) -> list[str]:
    layout = built.layout
    lines = []
    if any(stage.aero is None for stage in layout.stage):
        factor = f", times {layout.axial_factor:g}" if layout.axial_factor != 1.0 else ""
        lines.append(f"axial force: a curve of a clean launcher over Mach number{factor}")
        lines.append("normal force: slender-body theory and Barrowman's fins, over Mach number by a curve of our own")
    lines += [
        "propellants drain in proportion to their load; liquids do not turn about the axis but by their roll_share",
        f"first gains: {rigid_hz:.3g} Hz and {layout.control.rigid_zeta:g} of the rigid body with M_alpha in it",
    ]
    if layout.fairing is not None:
        dropped = [n for n, stack in enumerate(built.stacks) if stack.drops_fairing]
        at = f"dropped at {built.flight.begins_s[dropped[0] + 1]:.1f} s" if dropped else "never dropped: too low"
        lines.append(f"fairing: {at}; the aerodynamics and the beam stay as with it")
    for stage in layout.stage:
        e = stage.engine
        if e.gimballed_mass_kg is None or e.cg_from_gimbal_m is None:
            mass, arm, _ = engine_inertia(e)
            lines.append(f"{stage.name}: {mass:.4g} kg of each engine move, their CG {arm:.3g} m aft of the gimbal")
    return lines


INCIDENCE_deg = 5.0


def too_weak(built: Built) -> list[str]:
    """Stages whose gimbals cannot hold `INCIDENCE_deg`; empty where all can."""
    out = []
    for n, stack in enumerate(built.stacks):
        stage, points = stack.stage, [p for p in burning(built) if p.number == n]
        worst = max(points, key=lambda p: m_alpha_1ps2(built, p) / m_delta_1ps2(built, p))
        needed = INCIDENCE_deg * m_alpha_1ps2(built, worst) / m_delta_1ps2(built, worst)
        if needed > stage.engine.angle_limit_deg:
            out.append(
                f"{stack.name}: at {worst.time_s:.0f} s {INCIDENCE_deg:g} deg of incidence need {needed:.1f} deg "
                f"of the gimbals' {stage.engine.angle_limit_deg:g}"
            )
    return out


def warnings(built: Built) -> list[str]:
    """What may be meant, but is unusual."""
    out, half_hz = [], 0.5 / built.layout.control.sample_s
    for stack, (_, modes) in zip(built.stacks, built.modes, strict=True):
        for k, mode in enumerate(modes[0]):
            if mode.frequency_hz > half_hz:
                what = f"mode {k + 1} at {mode.frequency_hz:.1f} Hz lies above half the sample rate, {half_hz:g} Hz"
                out.append(f"{stack.name}: {what}")
    for stage in built.layout.stage:
        table, e = stage.engine.thrust, stage.engine
        if table is not None and "mass_flow_kgps" in table:
            burned = len(e.positions_m) * float(np.trapezoid(table["mass_flow_kgps"], table["time_s"]))
            if abs(burned - stage.usable_kg) > 0.02 * stage.usable_kg:
                out.append(
                    f"{stage.name}: its thrust file burns {burned:.4g} kg, the stage holds {stage.usable_kg:.4g} kg"
                )
    if built.mode_1_hz < 6.0 * MOST_RIGID_HZ:
        out.append(f"mode 1 at {built.mode_1_hz:.2f} Hz is less than six times the rigid body's {MOST_RIGID_HZ:g} Hz")
    return out


# files


def write(built: Built, folder: Path) -> list[Path]:
    """All files, into a folder; returns them."""
    layout, files = built.layout, []
    tables: Tables = {"pitch_programme.csv": _programme(built)}
    vehicle = _vehicle(built, tables)
    for name, (head, rows) in tables.items():
        text = "\n".join([head, *(",".join(f"{v:.12g}" for v in row) for row in rows)]) + "\n"
        files.append(write_whole(folder / "vehicle" / name, text))
    made = f"# {layout.name}: an estimate from a layout by simvehicle, to begin with.\n"
    documents = {
        "vehicle/vehicle.toml": vehicle, "design.toml": _design(built), "scenario.toml": _scenario(built),
        "campaign.toml": _campaign(built), "case.toml": _case(built), "suite.toml": _suite(built),
    }  # fmt: skip  # seven more lines otherwise
    for name, content in documents.items():
        files.append(write_whole(folder / name, made + tomli_w.dumps(content)))
    return files


def _prefix(built: Built, n: int) -> str:
    return f"stage{n + 1}_" if len(built.stacks) > 1 else ""


def _times_s(stack: Stack) -> Array:
    """Rows of tables of what the burn changes."""
    burn = stack.burn
    return np.unique(np.concatenate([burn.times_s, np.linspace(0.0, burn.end_s, MASS_ROWS)]).round(6))


def _mass(stack: Stack) -> Table:
    rows = []
    for t in _times_s(stack):
        p = stack.mass_properties(float(t))
        rows.append((t, p.mass_kg, p.x_cg_m, p.roll_kgm2, p.pitch_kgm2, p.pitch_kgm2))
    return "time_s,mass_kg,x_cg_m,Ixx_kgm2,Iyy_kgm2,Izz_kgm2", rows


def _copied(value: Any, name: str, tables: Tables) -> Any:
    """A section as a file holds it, its tables (into `tables`) named `name` and key."""
    if isinstance(value, CsvTable):
        tables[f"{name}.csv"] = ",".join(value.columns), list(zip(*value.columns.values(), strict=True))
        return f"{name}.csv"
    if isinstance(value, Section):
        given = [key for key in type(value).model_fields if key in value.model_fields_set]
        parts = {key: _copied(getattr(value, key), f"{name}_{key}", tables) for key in given}
        return {key: part for key, part in parts.items() if part is not None}
    if isinstance(value, tuple):
        return [_copied(item, f"{name}{n + 1}", tables) for n, item in enumerate(value)]
    return value


def _aero(built: Built, n: int, tables: Tables) -> dict[str, Any]:
    aero, given, name = built.aero[n], built.stacks[n].stage.aero, f"{_prefix(built, n)}aero"
    table = {} if given is None else dict(given.table.columns)
    damping = [aero.pitch_damping(x)[k] for k, x in enumerate(_cg_over_mach(built, n))]
    worked_out = {"CA": aero.axial, "CA_coast": aero.axial_coast, "Cmq": damping, "Clp": aero.roll_damping,
                  "C_crossflow": np.full(len(aero.mach), aero.crossflow)}  # fmt: skip  # five more lines otherwise
    if given is not None and given.coefficients:  # what stands there acts besides
        worked_out = {key: worked_out[key] for key in ("Cmq", "Clp", "C_crossflow")}
    out = {} if given is None else _copied(given, name, tables)
    if missing := {key: column for key, column in worked_out.items() if key not in table}:
        kept = {key: np.interp(aero.mach, table["mach"], column) for key, column in table.items() if key != "mach"}
        columns = {"mach": aero.mach, **kept, **missing}
        tables[f"{name}_table.csv"] = ",".join(columns), list(zip(*columns.values(), strict=True))
    out |= {"table": f"{name}_table.csv", "crossflow_station_m": aero.crossflow_station_m}
    if given is None or not (given.surface or given.coefficients or "CN_alpha_pr" in table):
        out["surface"] = []
        for surface in aero.surfaces:
            rows = list(zip(aero.mach, surface.slope_pr, surface.station_m, strict=True))
            tables[f"{name}_{surface.name}.csv"] = "mach,CN_alpha_pr,station_m", rows
            out["surface"].append({"name": surface.name, "table": f"{name}_{surface.name}.csv"})
    return out


def _loads(stack: Stack, prefix: str, tables: Tables) -> dict[str, Any]:
    """Masses along the body, what the shells bear, and the liquids, for section loads."""
    stage, layout = stack.stage, stack.layout
    assert stage.loads is not None
    dry = sorted((r.front_station_m, r.rear_station_m, r.mass_kg) for r in stack.dry)
    tables[f"{prefix}line_mass.csv"] = "front_station_m,rear_station_m,mass_kg", dry
    out = _copied(stage.loads, f"{prefix}loads", tables) | {"line_mass": f"{prefix}line_mass.csv", "liquid": []}
    limits = []
    for x in stage.loads.stations_m:
        for above in layout.stage[stack.number :]:
            for shell in above.shell:
                if shell.front_station_m <= x < shell.rear_station_m and shell.strength_Pa and shell.modulus_Pa:
                    radius = shell.radius_m or 0.5 * above.diameter_m  # of a thin wall: EI = E pi R^3 t, area 2 pi R t
                    area = 2.0 * shell.stiffness_Nm2(x, 0.5 * above.diameter_m) / (shell.modulus_Pa * radius**2)
                    limits.append((x, radius, area * shell.strength_Pa))
    if limits:
        tables[f"{prefix}section_limits.csv"] = "station_m,radius_m,equivalent_compression_N", limits
        out["limits"] = f"{prefix}section_limits.csv"
    for k, tank in enumerate(stage.tank):
        columns = [(t, stack.liquids(float(t))[k]) for t in _times_s(stack)]
        name = f"{prefix}liquid_{tank.name}.csv"
        tables[name] = "time_s,mass_kg,front_station_m", [(t, r.mass_kg, r.front_station_m) for t, r in columns]
        out["liquid"].append({"tank": tank.name, "table": name, "bottom_station_m": tank.bottom_station_m})
    return dict(out)


def _mode_table(built: Built, n: int) -> Table:
    stack, beam, rows = built.stacks[n], Beam.of(built.stacks[n]), []
    nodes = np.unique(np.linspace(0, len(beam.nodes_m) - 1, SHAPE_STATIONS).astype(int))
    for t, modes in zip(*built.modes[n], strict=True):
        forward = beam.mass_forward_kg([*stack.dry, *stack.liquids(float(t)), *stack.grains(float(t))])
        for number, mode in enumerate(modes, start=1):
            given = (t, number, mode.frequency_hz, mode.generalized_mass_kg)
            rows += [(*given, beam.nodes_m[k], mode.phi[k], mode.slope_pm[k], forward[k]) for k in nodes]
    return "time_s,mode,frequency_hz,generalized_mass_kg,station_m,phi,slope_pm,mass_forward_kg", rows


def _cg_over_mach(built: Built, n: int) -> Array:
    """CG at the time of each Mach number in the ascent."""
    points = [p for p in built.flight.points if p.number == n]
    order = np.argsort([p.mach for p in points])
    cg = [built.stacks[n].mass_properties(p.clock_s).x_cg_m for p in points]
    return np.asarray(np.interp(built.aero[n].mach, np.array([p.mach for p in points])[order], np.array(cg)[order]))


def _lead_rad(built: Built, p: Point, k_p: float, k_d: float, rate_radps: float) -> tuple[float, float]:
    """Incidence along the path at an instant, and by how much the command leads so that the law holds it.

    Static trim: the incidence that turns the path, the gimbal angle that holds it against M_alpha and pitch damping;
    the law (-k_p error - k_d rate) has no integral and needs an error for all of that.
    """
    stack, aero = built.stacks[p.number], built.aero[p.number]
    if p.thrust_N <= 0.0 or p.excess_radps == p.incidence_rad == p.dynamic_pressure_Pa == 0.0:
        return p.incidence_rad, k_d / k_p * rate_radps
    props, (slope, centre) = stack.mass_properties(p.clock_s), aero.normal(p.mach)
    arm, normal = stack.stage.engine.gimbal_station_m - props.x_cg_m, slope * p.dynamic_pressure_Pa * aero.area_m2
    holds = normal * (centre - props.x_cg_m) / (p.thrust_N * arm)  # gimbal angle per incidence
    across = p.thrust_N * (1.0 - holds) + normal
    incidence = p.incidence_rad + props.mass_kg * p.speed_mps * p.excess_radps / across
    damping = float(np.interp(p.mach, aero.mach, aero.pitch_damping(props.x_cg_m)))
    damping *= -0.5 * p.dynamic_pressure_Pa * aero.area_m2 * aero.diameter_m**2 / max(p.speed_mps, 1.0)
    gimbal = holds * incidence + damping / (p.thrust_N * arm) * rate_radps
    return incidence, (gimbal + k_d * rate_radps) / k_p


def _programme(built: Built) -> Table:
    """Pitch rate that makes the law fly the point-mass path."""
    points, gains = built.flight.points, np.array(built.gains)
    t, end = np.array([p.time_s for p in points]), built.flight.points[-1].time_s
    k_p, k_d = (np.interp(t, gains[:, 0], gains[:, k]) for k in (1, 2))
    incidence = [
        _lead_rad(built, p, p_gain, d_gain, 0.0)[0] for p, p_gain, d_gain in zip(points, k_p, k_d, strict=True)
    ]
    theta = np.array([p.pitch_rad - p.incidence_rad for p in points]) + incidence
    rate = np.gradient(theta, t)
    lead = [_lead_rad(built, p, k_p[k], k_d[k], rate[k])[1] for k, p in enumerate(points)]
    spacing = 0.5 if end < 300.0 else 1.0
    rows = np.append(np.arange(0.0, end - spacing, spacing), end)
    fine = np.linspace(0.0, end, 20 * math.ceil(end) + 1)
    command = np.interp(fine, t, theta + np.array(lead))
    before, behind = np.clip(rows - spacing / 2, 0.0, end), np.clip(rows + spacing / 2, 0.0, end)
    rates = np.degrees(np.interp(behind, fine, command) - np.interp(before, fine, command)) / (behind - before)
    rates[rows < built.layout.trajectory.pitch_over_start_s] = 0.0
    table = [*zip(rows, rates.round(6), strict=True), (end + 0.1, 0.0)]
    return "time_s,pitch_rate_degps", [(float(a), float(b)) for a, b in table]


def _vehicle(built: Built, tables: Tables) -> dict[str, Any]:
    layout, widest = built.layout, max(s.diameter_m for s in built.layout.stage)
    control, first = layout.control, layout.stage[0].engine
    return {
        "schema": 1,
        "name": layout.name,
        "description": "an estimate from a layout",
        "reference": {
            "length_m": max(first.exit_station_m, layout.stage[0].rear_station_m), "diameter_m": widest,
            "area_m2": 0.25 * math.pi * widest**2,
        },
        "stage": [_stage(built, n, tables) for n in range(len(built.stacks))],
        "computer": {
            "sample_s": control.sample_s, "delay_s": control.delay_s, "count_rad": 1e-5, "dac_step_deg": 0.001,
            "attitude": "quaternion", "angle_error_limit_deg": 20.0,
            "command_limit_deg": min(s.engine.angle_limit_deg for s in layout.stage),
        },
    }  # fmt: skip  # five more lines otherwise


def _stage(built: Built, n: int, tables: Tables) -> dict[str, Any]:
    stack, prefix, control = built.stacks[n], _prefix(built, n), built.layout.control
    stage, e, last = stack.stage, stack.stage.engine, n == len(built.stacks) - 1
    thrust = zip(stack.burn.times_s, stack.burn.thrust_N / len(e.positions_m), strict=True)
    tables[f"{prefix}thrust.csv"] = "time_s,thrust_vacuum_N", list(thrust)
    tables[f"{prefix}mass.csv"] = _mass(stack)
    for tank in stage.tank:
        liquid = [(t, stack.liquid_kg(tank, float(t))) for t in _times_s(stack)]
        tables[f"{prefix}tank_{tank.name}.csv"] = "time_s,liquid_mass_kg", liquid
    mass, arm, inertia = engine_inertia(e)
    engine = {
        "table": f"{prefix}thrust.csv", "exit_area_m2": e.exit_area_m2, "gimbal_station_m": e.gimbal_station_m,
        "exit_station_m": e.exit_station_m, "gimballed_mass_kg": mass, "cg_from_gimbal_m": arm,
        "inertia_about_gimbal_kgm2": inertia,
    }  # fmt: skip  # three more lines otherwise
    many = len(e.positions_m) > 1
    engines = [engine | ({"name": f"E{k + 1}", "group": "all"} if many else {}) | {"offset_m": list(at)}
               for k, at in enumerate(e.positions_m)]  # fmt: skip  # one line more otherwise
    out: dict[str, Any] = {"name": stack.name}
    if stack.drops_fairing:
        out["separation_s"] = stack.burn.end_s
    elif not last:
        out["separation_after_burnout_s"] = stage.separation_after_s
    if n > 0 and built.stacks[n - 1].drops_fairing:
        out["continues"] = True
    if stack.burn.start_s > 0.0 and n > 0:
        out["ignition_s"] = stage.ignition_after_s
    out["mass"] = {"table": f"{prefix}mass.csv"}
    out["engine"] = engines if many else engines[0]
    out["actuator"] = {
        "model": next(model for model, count in SECTIONS.items() if count == len(e.servo_hz)),
        "omega_hz": list(e.servo_hz), "zeta": list(e.servo_zeta),
        "angle_limit_deg": e.angle_limit_deg, "rate_limit_degps": e.rate_limit_degps,
    }  # fmt: skip  # two more lines otherwise
    out["tank"] = [
        {"name": t.name, "table": f"{prefix}tank_{t.name}.csv", "damping_ratio": t.damping_ratio, "shape": "cylinder",
         "radius_m": t.radius_m, "bottom_station_m": t.bottom_station_m, "height_m": t.height_m,
         "dome_m": list(t.dome_m), "density_kgpm3": t.density_kgpm3}
        for t in stage.tank
    ]  # fmt: skip  # eight more lines otherwise
    if stage.bending is not None or stage.spatial_modes is not None:
        key = "bending" if stage.bending is not None else "spatial_modes"
        out[key] = _copied(getattr(stage, key), f"{prefix}{key}", tables)
    elif built.modes[n][1][0]:
        tables[f"{prefix}modes.csv"] = _mode_table(built, n)
        damping = [stage.bending_damping] * len(built.modes[n][1][0])
        out["bending"] = {"pitch": f"{prefix}modes.csv", "yaw": f"{prefix}modes.csv", "damping_ratio": damping}
    out["aero"] = _aero(built, n, tables)
    if stage.loads is not None:
        out["loads"] = _loads(stack, prefix, tables)
    out["gyro"] = {"station_m": control.gyro_station_m, "omega_hz": control.gyro_hz, "zeta": control.gyro_zeta}
    roll = stage.roll_torque_Nm or math.radians(5.0) * stack.mass_properties(0.0).roll_kgm2
    out["roll_thrusters"] = {"torque_Nm": roll}
    return out


def _filter(built: Built, n: int) -> dict[str, Any]:
    """A first filter of a stage: a wide notch at each of its first two modes that a sample shows, poles below them."""
    modes, most_hz = built.modes[n][1], SHOWN / built.layout.control.sample_s
    if not modes or not modes[0]:
        return {"structure": "none"}
    means = [float(np.mean([m[k].frequency_hz for m in modes])) for k in range(min(2, len(modes[0])))]
    sections = [{"zero_hz": f, "zero_zeta": 0.4, "pole_hz": 0.8 * f, "pole_zeta": 0.8} for f in means if f < most_hz]
    if not sections:
        return {"structure": "none"}
    return {
        "structure": "F2" if len(sections) == 1 else "F4", "quadratic": sections, "discretization": "prewarped",
        "prewarp_hz": sections[0]["zero_hz"],
    }  # fmt: skip  # two more lines otherwise


def _design(built: Built) -> dict[str, Any]:
    table = [{"time_s": t, "k_p": float(f"{k_p:.6g}"), "k_d_s": float(f"{k_d:.6g}")} for t, k_p, k_d in built.gains]
    out: dict[str, Any] = {
        "schema": 1, "name": f"{built.layout.name}, first gains", "vehicle": built.layout.name,
        "gains": {"table": table, "yaw": "pitch"},
    }  # fmt: skip  # two more lines otherwise
    first, *others = (_filter(built, n) for n in range(len(built.stacks)))
    out["filter"] = first
    if others:
        out["stage"] = [{}, *({"filter": filter_} for filter_ in others)]
    out["roll"] = {"k_rate_s": 0.5, "dead_band_deg": 1.0, "hysteresis_deg": 0.2, "minimum_on_s": 0.02}
    return out


def _scenario(built: Built) -> dict[str, Any]:
    site, last = built.layout.site, built.flight.points[-1]
    return {
        "schema": 1, "name": built.layout.name, "description": f"{built.layout.name}, powered ascent without wind",
        "vehicle": "vehicle", "design": "design.toml",
        "run": {"duration_s": float(math.ceil(last.time_s + 5.0))},
        "site": {"latitude_deg": site.latitude_deg, "longitude_deg": site.longitude_deg,
                 "altitude_m": site.altitude_m, "azimuth_deg": site.azimuth_deg},
        "guidance": {"programme": "vehicle/pitch_programme.csv"},
        "requirement": [
            {"name": "attitude error", "metric": "max_attitude_error_deg", "limit": 10.0},
            {"name": "gimbal angle", "metric": "max_gimbal_deg",
             "limit": 0.8 * min(s.engine.angle_limit_deg for s in built.layout.stage)},
        ],
    }  # fmt: skip  # ten more lines otherwise


def _campaign(built: Built) -> dict[str, Any]:
    first = built.layout.stage[0]
    engine = "vehicle.stage.0.engine" + (".{}" if len(first.engine.positions_m) > 1 else "")
    flow = [f"{engine.format(k)}.mass_flow_factor" for k in range(len(first.engine.positions_m))]
    keys = {
        "thrust at equal impulse": flow, "normal force": ["vehicle.stage.0.aero.force_factor"],
        "axial force": ["vehicle.stage.0.aero.axial_factor"],
    }  # fmt: skip  # three more lines otherwise
    if built.modes[0][1][0] and first.spatial_modes is None:
        keys["frequency of mode 1"] = ["vehicle.stage.0.bending.frequency_factor.0"]
    spread = [
        {"keys": k, "name": name, "apply": "scale", "distribution": "normal", "three_sigma": SPREAD[name],
         "source": "assumed, to begin with"}
        for name, k in keys.items()
    ]  # fmt: skip  # five more lines otherwise
    burnout = built.flight.begins_s[0] + built.stacks[0].burn.end_s
    return {
        "schema": 1, "extends": "scenario.toml", "description": f"{built.layout.name}, first stage, dispersed",
        "campaign": {"runs": 100, "seed": 1},
        "run": {"duration_s": float(math.floor(burnout))}, "disperse": spread,
    }  # fmt: skip  # three more lines otherwise


def _case(built: Built) -> dict[str, Any]:
    hz = built.mode_1_hz
    rigid = built.layout.control.rigid_hz or min(MOST_RIGID_HZ, hz / 8.0)
    low = round(min(3.0, 0.6 * hz), 2)
    orders = ["F4" if len(_filter(built, n).get("quadratic", ())) > 1 else "F2" for n in range(len(built.stacks))]
    differing = [{"filter": {"structure": order}} if order != orders[0] else {} for order in orders]
    return {
        "schema": 1, "description": f"{built.layout.name}, every stage: largest least |1 + L|",
        "scenario": "scenario.toml",
        "gains": {"schedule": "free"}, "objective": {"kind": "least-margin"},
        "filter": {"structure": orders[0], "bounds": {"zero_hz": [low, 100.0], "pole_hz": [low, 100.0]}},
        "limits": {"rigid_body": "aerodynamic", "rigid_hz": round(0.8 * rigid, 3), "rigid_zeta": 0.5,
                   "without": ["second_mode_db"]},
        **({"stage": differing} if any(differing) else {}),
    }  # fmt: skip  # twelve more lines otherwise


def _suite(built: Built) -> dict[str, Any]:
    wanted = {"gain_up_db": 6.0, "aero_gain_db": 6.0, "phase_deg": 30.0}
    return {
        "schema": 1, "description": f"{built.layout.name}, to begin with", "scenario": "scenario.toml",
        "margins": {"cases": 20, "nominal": wanted}, "certificate": {"nodes_per_stage": 1},
        "flight": [{"name": "calm air", "why": "the ascent as planned"}],
    }  # fmt: skip  # four more lines otherwise
