"""The files of a layout for simrun, simdesign and simverify: tables of the vehicle, a pitch programme, a first design,
a scenario, a campaign, a case and a suite.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from maxq.control.kernel.records import Array
from maxq.design.laws.design_file import design_text
from maxq.design.verify.suite import read_suite
from maxq.sim.files import write_whole
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.input.values import Section
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.actuator.section import SECTIONS
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2
from maxq.tools.vehicle.aerodynamics import aerodynamics
from maxq.tools.vehicle.beam import Beam, RigidLoad
from maxq.tools.vehicle.build import Built, burning, least_rigid_hz
from maxq.tools.vehicle.campaign import LIMIT_WIND, campaign_of
from maxq.tools.vehicle.layout import Layout, LayoutEngines, LayoutNozzles, LayoutTank, LayoutThrust, steered_boosters
from maxq.tools.vehicle.masses import Stack, engine_inertia
from maxq.tools.vehicle.trajectory import TrajectoryPoint

SUITE, CAMPAIGN = "launcher", "campaign.toml"
MASS_ROWS, SHAPE_STATIONS = 41, 41
DIGITS = ".12g"  # format of the numbers in tables, and of those in vehicle.toml
ROOM_DB, ROOM_DEG = 0.5, 2.0  # margins of a case to the limits of its suite, for other operating points and rounding
ROLL_SHARE = 0.25  # share of the gimbal angle limit available to roll
FASTER = 0.1  # share of its burn by which a part's tables continue if the next part continues the burn
FAR, LOW_PASS = 100.0, 0.15  # mode 1 / rigid body, above which a low pass is used; poles of the low pass / mode 1
QUIET, HUSH = 12.0, 0.1  # of this low pass in a case: highest poles / rigid body, and largest gain at infinity
REVOLUTION_s = 6500.0  # period of a low orbit
SHOWN = 0.4  # share of the sample rate up to which a mode has a notch
CsvFile = tuple[str, Sequence[tuple[Any, ...]]]  # head and rows of a CSV file
Tables = dict[str, CsvFile]  # by file name


def write(built: Built, folder: Path) -> list[Path]:
    """Write all files of a built vehicle into a folder, and return their paths.

    Raises ValueError, without leaving a file, if the vehicle cannot be loaded: a value of the layout that no check of
    the layout rejects, but one of the vehicle.
    """
    contents = _contents(built)
    with tempfile.TemporaryDirectory(prefix="maxq-vehicle-") as trial:
        for name, text in contents.items():
            write_whole(Path(trial) / name, text)
        try:
            load_scenario(Path(trial) / "scenario.toml")
        except ScenarioError as error:
            said = str(error).replace(f"{trial}{os.sep}", "")
            raise ValueError(f"the vehicle made from it is not valid: {said}") from None
    return [write_whole(folder / name, text) for name, text in contents.items()]


def _contents(built: Built) -> dict[str, str]:
    """Return the texts of all files of a built vehicle by name."""
    layout, texts = built.layout, dict[str, str]()
    tables: Tables = {} if layout.unguided else {"pitch_programme.csv": _programme(built)}
    vehicle = _vehicle(built, tables)
    if not layout.unguided:
        tables["limit_wind.csv"] = _limit_wind(layout.site.jet_mps)
    for name, (head, rows) in tables.items():
        texts[f"vehicle/{name}"] = "\n".join([head, *(",".join(f"{v:{DIGITS}}" for v in row) for row in rows)]) + "\n"
    made = f"# {layout.name}: an estimate from a layout by simvehicle, to begin with.\n"
    documents = {"vehicle/vehicle.toml": _rounded(vehicle), "scenario.toml": _scenario(built)}
    if not layout.unguided:
        documents |= {
            "design.toml": _design(built),
            CAMPAIGN: campaign_of(built),
            "case.toml": _case(built),
            "suite.toml": _suite(built),
        }
    texts |= {name: made + tomli_w.dumps(content) for name, content in documents.items()}
    if built.design is not None:
        texts["design.toml"] = made + design_text(built.design, ())
    return texts


def _rounded(value: Any) -> Any:
    """Return a value with all its floats rounded as in the tables.

    Otherwise, a gimbal at the last station of the modes could be behind that station.
    """
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_rounded(item) for item in value]
    return float(f"{value:{DIGITS}}") if isinstance(value, float) else value


def _limit_wind(jet_mps: float) -> CsvFile:
    """Return a preliminary wind profile from the west: a jet stream at 11 km, and light winds at the ground and above
    20 km.
    """
    rows = [(0.0, min(8.0, jet_mps)), (11e3, jet_mps), (20e3, min(10.0, jet_mps)), (30e3, min(10.0, jet_mps))]
    return "altitude_m,speed_mps,from_deg", [(*row, 270.0) for row in rows]


def _prefix(built: Built, n: int) -> str:
    return f"stage{n + 1}_" if len(built.stacks) > 1 else ""


def _of_burn(built: Built, n: int) -> str:
    """Return the file-name prefix of the tables that all parts of a burn share: that of the first part."""
    first = n
    while built.stacks[first].begins_s > 0.0:
        first -= 1
    return _prefix(built, first)


def _times_s(stack: Stack) -> list[float]:
    """Return the times (s) of the rows of tables that change during a burn."""
    burn = stack.burn
    both = np.concatenate([burn.times_s, np.linspace(0.0, burn.end_s, MASS_ROWS)])
    return [float(t) for t in np.unique(both.round(6))]


def _continued(stack: Stack, rows: list[tuple[float, ...]]) -> list[tuple[float, ...]]:
    """Return the rows of a table over time, with an extrapolated row if the burn continues in the next part.

    The additional row is for a dispersed burn that is faster.
    """
    if not stack.drops_fairing:
        return rows
    before, last = np.array(rows[-2]), np.array(rows[-1])
    further = last + (last - before) * FASTER * last[0] / (last[0] - before[0])
    return [*rows, tuple(float(x) for x in further)]


def _over_time(stack: Stack, columns: str, values: Iterable[tuple[float, ...]]) -> CsvFile:
    """Return a table of `columns` at the times `_times_s`."""
    return f"time_s,{columns}", _continued(stack, [(t, *row) for t, row in zip(_times_s(stack), values, strict=True)])


_MASS = attrgetter("mass_kg", "x_cg_m", "roll_kgm2", "pitch_kgm2", "yaw_kgm2")
_LIQUID = attrgetter("mass_kg", "front_station_m")


def _copied(value: Any, name: str, tables: Tables) -> Any:
    """Return a section as it is written in a file. Its tables are added to `tables`, named by `name` and key."""
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
    whole, given, name = built.aero[n], built.stacks[n].stage.aero, f"{_prefix(built, n)}aero"
    table = {} if given is None else dict(given.table.columns)
    damping = [whole.pitch_damping(x)[k] for k, x in enumerate(_cg_over_mach(built, n))]
    aero = aerodynamics(replace(built.stacks[n], boosters=())) if whole.boosters else whole
    worked_out = {
        "CA": aero.axial,
        "CA_coast": aero.axial_coast,
        "Cmq": damping,
        "Clp": aero.roll_damping,
        "C_crossflow": np.full(len(aero.mach), aero.crossflow),
    }
    if given is not None and given.coefficients:  # given coefficients already include the axial force
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
    """Return the section of section loads: masses along the body, strength of the shells, and liquids."""
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
                    radius = shell.radius_m or 0.5 * above.diameter_m  # of a thin wall: EI = pi E R^3 t, area 2 pi R t
                    area = 2.0 * shell.stiffness_Nm2(x, 0.5 * above.diameter_m) / (shell.modulus_Pa * radius**2)
                    limits.append((x, radius, area * shell.strength_Pa))
    if limits:
        tables[f"{prefix}section_limits.csv"] = "station_m,radius_m,equivalent_compression_N", limits
        out["limits"] = f"{prefix}section_limits.csv"
    for k, tank in enumerate(stage.tank):
        name = f"{prefix}liquid_{tank.name}.csv"
        rows = (_LIQUID(stack.liquids(t)[k]) for t in _times_s(stack))
        tables[name] = _over_time(stack, "mass_kg,front_station_m", rows)
        out["liquid"].append({"tank": tank.name, "table": name, "bottom_station_m": tank.bottom_station_m})
    return dict(out)


def _mode_table(built: Built, n: int) -> CsvFile:
    stack, beam, rows = built.stacks[n], Beam.of(built.stacks[n]), []
    nodes = np.unique(np.linspace(0, len(beam.nodes_m) - 1, SHAPE_STATIONS).astype(int))
    times, every = built.modes[n]
    if stack.drops_fairing or stack.leave_s is not None:  # `_continued`
        times, every = np.append(times, times[-1] * (1.0 + FASTER)), [*every, every[-1]]
    if stack.begins_s > 0.0:  # tables begin at zero of the clock
        times, every = np.append(0.0, times), [every[0], *every]
    for t, modes in zip(times, every, strict=True):
        now = min(max(float(t), stack.begins_s), stack.end_s) if stack.leave_s is not None else float(t)
        carried = [RigidLoad(s.booster.attachments_m, s.rods(now)) for s in stack.boosters for _ in s.booster.names]
        forward = beam.mass_forward_kg([*stack.dry, *stack.liquids(now), *stack.grains(now)], carried)
        for number, mode in enumerate(modes, start=1):
            given = (t, number, mode.frequency_hz, mode.generalized_mass_kg)
            rows += [(*given, beam.nodes_m[k], mode.phi[k], mode.slope_pm[k], forward[k]) for k in nodes]
    return "time_s,mode,frequency_hz,generalized_mass_kg,station_m,phi,slope_pm,mass_forward_kg", rows


def _cg_over_mach(built: Built, n: int) -> Array:
    """Return the CG station (m) at which the ascent passes each Mach number of the aerodynamics."""
    points = [p for p in built.flight.points if p.number == n]
    order = np.argsort([p.mach for p in points])
    cg = [built.stacks[n].mass_properties(p.clock_s).x_cg_m for p in points]
    return np.asarray(np.interp(built.aero[n].mach, np.array([p.mach for p in points])[order], np.array(cg)[order]))


def _lead_rad(built: Built, p: TrajectoryPoint, k_p: float, k_d: float, rate_radps: float) -> tuple[float, float]:
    """Return the angle of attack along the path at a point, and the lead of the pitch command that holds it, both in
    rad.

    In static trim, an angle of attack turns the path, and a gimbal angle holds it against M_alpha and pitch damping.
    The law (-k_p error - k_d rate) has no integral, so it needs an attitude error for the gimbal angle and for the
    rate.
    """
    stack, aero = built.stacks[p.number], built.aero[p.number]
    if p.steered_N <= 0.0 or p.excess_radps == p.incidence_rad == p.dynamic_pressure_Pa == 0.0:
        return p.incidence_rad, k_d / k_p * rate_radps
    props, (slope, centre) = stack.mass_properties(p.clock_s), aero.normal(p.mach)
    arm, normal = stack.stage.engine.gimbal_station_m - props.x_cg_m, slope * p.dynamic_pressure_Pa * aero.area_m2
    holds = normal * (centre - props.x_cg_m) / (p.steered_N * arm)  # gimbal angle per angle of attack
    across = p.steered_N * (1.0 - holds) + (p.thrust_N - p.steered_N) + normal
    incidence = p.incidence_rad + props.mass_kg * p.speed_mps * p.excess_radps / across
    damping = float(np.interp(p.mach, aero.mach, aero.pitch_damping(props.x_cg_m)))
    damping *= -0.5 * p.dynamic_pressure_Pa * aero.area_m2 * aero.diameter_m**2 / max(p.speed_mps, 1.0)
    gimbal = holds * incidence + damping / (p.steered_N * arm) * rate_radps
    return incidence, (gimbal + k_d * rate_radps) / k_p


def _programme(built: Built) -> CsvFile:
    """Return the pitch-rate programme with which the law flies the point-mass path."""
    every, gains = built.flight.points, np.array(built.gains)
    points = [p for p, q in pairwise(every) if p.time_s < q.time_s] + every[-1:]  # a separation may be instantaneous
    t, end = np.array([p.time_s for p in points]), built.flight.points[-1].time_s
    k_p, k_d = (np.interp(t, gains[:, 0], gains[:, k]) for k in (1, 2))
    incidence = [_lead_rad(built, p, k_p[k], k_d[k], 0.0)[0] for k, p in enumerate(points)]
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
    first = layout.stage[0].engine
    return {
        "schema": 1,
        "name": layout.name,
        "description": "an estimate from a layout",
        "reference": {
            "length_m": max(first.exit_station_m, layout.stage[0].rear_station_m),
            "diameter_m": widest,
            "area_m2": 0.25 * math.pi * widest**2,
        },
        "stage": [_stage(built, n, tables) for n in range(len(built.stacks))],
        **({} if layout.unguided else {"computer": _computer(layout)}),
    }


def _computer(layout: Layout) -> dict[str, Any]:
    return {
        "sample_s": layout.control.sample_s,
        "delay_s": layout.control.delay_s,
        "count_rad": 1e-5,
        "dac_step_deg": 0.001,
        "attitude": "quaternion",
        "angle_error_limit_deg": 20.0,
        "command_limit_deg": min(s.engine.angle_limit_deg for s in layout.stage),
    }


def _stage(built: Built, n: int, tables: Tables) -> dict[str, Any]:
    stack, prefix, control = built.stacks[n], _prefix(built, n), built.layout.control
    stage, e, last = stack.stage, stack.stage.engine, n == len(built.stacks) - 1
    shared = _of_burn(built, n)
    thrust = zip(stack.burn.times_s, stack.burn.thrust_N / len(e.positions_m), strict=True)
    tables[f"{shared}thrust.csv"] = "time_s,thrust_vacuum_N", _continued(stack, list(thrust))
    masses = (_MASS(stack.core_properties(t)) for t in _times_s(stack))
    tables[f"{shared}mass.csv"] = _over_time(stack, "mass_kg,x_cg_m,Ixx_kgm2,Iyy_kgm2,Izz_kgm2", masses)
    for tank in stage.tank:
        left = ((stack.liquid_kg(tank, t),) for t in _times_s(stack))
        tables[f"{shared}tank_{tank.name}.csv"] = _over_time(stack, "liquid_mass_kg", left)
    engine = {
        "table": f"{shared}thrust.csv",
        "exit_area_m2": e.exit_area_m2,
        "gimbal_station_m": e.gimbal_station_m,
        "exit_station_m": e.exit_station_m,
        **_swinging(e),
        **_of_motor(e),
    }
    many = len(e.positions_m) > 1
    engines = [
        engine | ({"name": f"E{k + 1}", "group": group} if many else {}) | {"offset_m": list(at)}
        for k, (at, group) in enumerate(zip(e.positions_m, e.groups, strict=True))
    ]
    out: dict[str, Any] = {"name": stack.name}
    if stack.drops_fairing:
        out["separation_s"] = stack.burn.end_s
    elif stack.leave_s is not None:
        ends = [s.burn.end_s for s in stack.boosters if s.leave_s == stack.leave_s]
        out["separation_after_burnout_s"] = round(stack.leave_s - max(ends), 9)
    elif not last:
        out["separation_after_burnout_s"] = stage.separation_after_s
    if n > 0 and built.stacks[n - 1].drops_fairing:
        out["continues"] = True
    if stack.begins_s > 0.0:
        out |= {"continues": True, "clock": "preceding"}
    if stack.burn.start_s > 0.0 and n > 0:
        out["ignition_s"] = stage.ignition_after_s
    out["mass"] = {"table": f"{shared}mass.csv"}
    out["engine"] = engines if many else engines[0]
    groups = [{"group": g} for g in dict.fromkeys(e.groups)] if many else [{}]
    moving = [
        (name, s.booster.engine) for s in stack.boosters for name in s.booster.names if name in stack.moving_boosters
    ]
    listed = steered_boosters(stage) or len(groups) > 1
    fixed = e.gimbal == "fixed"
    actuators = (
        []
        if fixed
        else [group | _actuator(e) for group in groups] + [{"group": name} | _actuator(b) for name, b in moving]
    )
    if actuators:
        out["actuator"] = actuators if listed else actuators[0]
    if e.tvc_load is not None:
        load = _copied(e.tvc_load, f"{prefix}tvc_load", tables)
        out["tvc_load"] = [group | load for group in groups] if moving else load
    out["tank"] = [_tank(t, f"{shared}tank_{t.name}.csv") for t in stage.tank]
    if stage.bending is not None or stage.spatial_modes is not None:
        key = "bending" if stage.bending is not None else "spatial_modes"
        out[key] = _copied(getattr(stage, key), f"{prefix}{key}", tables)
    elif built.modes[n][1][0]:
        tables[f"{prefix}modes.csv"] = _mode_table(built, n)
        damping = [stage.bending_damping] * len(built.modes[n][1][0])
        out["bending"] = {"pitch": f"{prefix}modes.csv", "yaw": f"{prefix}modes.csv", "damping_ratio": damping}
    out["aero"] = _aero(built, n, tables)
    if stack.boosters:
        out["booster"] = _boosters(built, n, tables)
    if stage.loads is not None:
        out["loads"] = _loads(stack, prefix, tables)
    lag = {"omega_hz": control.gyro_hz, "zeta": control.gyro_zeta}
    out["gyro"] = {"station_m": control.gyro_station_m, **lag}
    if control.accelerometer_station_m is not None:
        out["accelerometer"] = {"station_m": control.accelerometer_station_m, **lag}
    if fixed:
        return out
    roll = stage.roll_torque_Nm or math.radians(5.0) * stack.mass_properties(0.0).roll_kgm2
    out["roll_thrusters"] = {"torque_Nm": roll}
    if built.layout.trajectory.restart and stage is built.layout.stage[-1]:
        turn = stage.turn_torque_Nm or math.radians(0.5) * stack.mass_properties(0.0).pitch_kgm2
        out["roll_thrusters"]["pitch_yaw_torque_Nm"] = turn
    return out


def _of_motor(e: LayoutThrust) -> dict[str, float]:
    """Return the keys of a motor that have the same names in the layout and in the vehicle file, unless they are
    zero.
    """
    return {key: value for key in ("temperature_sensitivity_1pK", "roll_arm_m") if (value := getattr(e, key)) != 0.0}


def _actuator(e: LayoutEngines) -> dict[str, Any]:
    return {
        "model": next(model for model, count in SECTIONS.items() if count == len(e.servo_hz)),
        "omega_hz": list(e.servo_hz),
        "zeta": list(e.servo_zeta),
        "angle_limit_deg": e.angle_limit_deg,
        "rate_limit_degps": e.rate_limit_degps,
    }


def _tank(t: LayoutTank, table: str) -> dict[str, Any]:
    return {
        "name": t.name,
        "table": table,
        "damping_ratio": t.damping_ratio,
        "shape": "cylinder",
        "radius_m": t.radius_m,
        "bottom_station_m": t.bottom_station_m,
        "height_m": t.height_m,
        "dome_m": list(t.dome_m),
        "density_kgpm3": t.density_kgpm3,
        **({"position_m": list(t.position_m)} if any(t.position_m) else {}),
    }


def _swinging(e: LayoutNozzles) -> dict[str, Any]:
    """Return the keys of an engine that depend on its gimbal."""
    if e.gimbal == "fixed":
        return {"gimbal": "fixed"}
    mass, arm, inertia = engine_inertia(e)
    return {"gimballed_mass_kg": mass, "cg_from_gimbal_m": arm, "inertia_about_gimbal_kgm2": inertia}


def _boosters(built: Built, n: int, tables: Tables) -> list[dict[str, Any]]:
    """Return the sections of the attached boosters. Those of a set share their tables."""
    out, aero = [], built.aero[n]
    for k, s in enumerate(built.stacks[n].boosters):
        b, e, prefix = s.booster, s.booster.engine, f"booster_{s.booster.name}_"
        zero_s = b.ignition_after_s  # tables are over the time since ignition
        edges = np.concatenate([s.burn.times_s, np.linspace(zero_s, s.burn.end_s, MASS_ROWS)])
        times = [float(t) for t in np.unique(edges.round(6)) if t >= zero_s - 1e-6]
        thrust = zip(s.burn.times_s - zero_s, s.burn.thrust_N / len(e.positions_m), strict=True)
        tables[f"{prefix}thrust.csv"] = "time_s,thrust_vacuum_N", [row for row in thrust if row[0] >= 0.0]
        rows = [(round(t - zero_s, 6), *_MASS(s.mass_properties(t))) for t in times]
        tables[f"{prefix}mass.csv"] = "time_s,mass_kg,x_cg_m,Ixx_kgm2,Iyy_kgm2,Izz_kgm2", rows
        for tank in b.tank:
            left = [(round(t - zero_s, 6), s.liquid_kg(tank, t)) for t in times]
            tables[f"{prefix}tank_{tank.name}.csv"] = "time_s,liquid_mass_kg", left
        engine = {
            "table": f"{prefix}thrust.csv",
            **_swinging(e),
            "exit_area_m2": e.exit_area_m2,
            "gimbal_station_m": e.gimbal_station_m,
            "exit_station_m": e.exit_station_m,
            **_of_motor(e),
        }
        engines = [engine | {"offset_m": list(at)} for at in e.positions_m]
        one: dict[str, Any] = {"attachments_m": list(b.attachments_m), "mass": {"table": f"{prefix}mass.csv"}}
        one |= {"engine": engines if len(engines) > 1 else engines[0]}
        if zero_s > 0.0:
            one["ignition_s"] = zero_s
        if b.tank:
            one["tank"] = [_tank(t, f"{prefix}tank_{t.name}.csv") for t in b.tank]
        if aero.boosters:
            surface, along = aero.boosters[k]
            forces = list(zip(aero.mach, along, surface.slope_pr, surface.station_m, strict=True))
            tables[f"{prefix}aero.csv"] = "mach,CA,CN_alpha_pr,station_m", forces
            one["aero"] = {"table": f"{prefix}aero.csv"}
        out += [{"name": name, "position_m": list(at)} | one for name, at in zip(b.names, b.positions_m, strict=True)]
    return out


def _far(built: Built, n: int) -> bool:
    """Return True if mode 1 of stack `n` is far above the rigid body."""
    modes = built.modes[n][1]
    first = float(np.mean([m[0].frequency_hz for m in modes])) if modes and modes[0] else 0.0
    return first > FAR * max(built.rigid_hz(p) for p in burning(built, n))


def _filter(built: Built, n: int) -> dict[str, Any]:
    """Return a first filter of stack `n`: wide notches at its first two modes that the sampling resolves, with lower
    poles.

    If mode 1 is far above the rigid body, one notch with low poles acts as a low pass that attenuates all modes.
    """
    modes, most_hz = built.modes[n][1], SHOWN / built.layout.control.sample_s
    if not modes or not modes[0]:
        return {"structure": "none"}
    means = [float(np.mean([m[k].frequency_hz for m in modes])) for k in range(min(2, len(modes[0])))]
    far = _far(built, n)
    means, poles = (means[:1], LOW_PASS) if far else (means, 0.8)
    sections = [{"zero_hz": f, "zero_zeta": 0.4, "pole_hz": poles * f, "pole_zeta": 0.8} for f in means if f < most_hz]
    if not sections:
        return {"structure": "none"}
    return {
        "structure": "F2" if len(sections) == 1 else "F4",
        "quadratic": sections,
        "discretization": "prewarped",
        "prewarp_hz": sections[0]["zero_hz"],
    }


def _roll(built: Built, n: int) -> dict[str, Any]:
    """Return the roll control of stack `n`: by thrusters, and also by the gimbals if engines are off the axis.

    Frequency and damping of the gimbal law are those of the first gains in pitch, at the first point of full thrust.
    """
    out: dict[str, Any] = {"roll": {"k_rate_s": 0.5, "dead_band_deg": 1.0, "hysteresis_deg": 0.2, "minimum_on_s": 0.02}}
    stack, e = built.stacks[n], built.stacks[n].stage.engine
    sides = [
        np.sum([at for at, g in zip(e.positions_m, e.groups, strict=True) if g == name], axis=0)
        for name in dict.fromkeys(e.groups)
    ]
    if len(sides) > 1 and np.any(sides):
        torque_Nm = float(stack.burn.thrust_N.max()) / len(e.positions_m) * float(np.abs(sides).sum())
        omega = 2.0 * math.pi * built.rigid_hz(burning(built)[0])
        per_rad = stack.mass_properties(0.0).roll_kgm2 / torque_Nm
        k_d_s = 2.0 * built.layout.control.rigid_zeta * omega * per_rad
        gains = {"k_p": float(f"{omega**2 * per_rad:.4g}"), "k_d_s": float(f"{k_d_s:.4g}")}
        out["roll_gimbal"] = gains | {"limit_deg": ROLL_SHARE * e.angle_limit_deg}
    return out


def _design(built: Built) -> dict[str, Any]:
    table = [{"time_s": t, "k_p": float(f"{k_p:.6g}"), "k_d_s": float(f"{k_d:.6g}")} for t, k_p, k_d in built.gains]
    out: dict[str, Any] = {
        "schema": 2,
        "name": f"{built.layout.name}, first gains",
        "vehicle": built.layout.name,
        "gains": {"table": table, "yaw": "pitch"},
    }
    first, *others = ({"filter": _filter(built, n), **_roll(built, n)} for n in range(len(built.stacks)))
    out |= first
    if others:
        out["stage"] = [{}, *({key: part for key, part in own.items() if part != first.get(key)} for own in others)]
    return out


def _requirements(built: Built) -> list[dict[str, Any]]:
    """Return the requirements on control, with margin for winds."""
    stages = built.layout.stage
    limits = {
        "attitude error": ("max_attitude_error_deg", 10.0),
        "gimbal angle": ("max_gimbal_deg", 0.8 * min(s.engine.angle_limit_deg for s in stages)),
        "gimbal rate": ("max_gimbal_rate_degps", 0.5 * min(s.engine.rate_limit_degps for s in stages)),
        "gimbal at its limit": ("saturation_time_s", 0.0),
    }
    if any(stage.tank for stage in stages):
        limits["slosh angle"] = ("max_slosh_deg", 10.0)
    return [{"name": name, "metric": metric, "limit": limit} for name, (metric, limit) in limits.items()]


def _scenario(built: Built) -> dict[str, Any]:
    site, last = built.layout.site, built.flight.points[-1]
    place = {
        "latitude_deg": site.latitude_deg,
        "longitude_deg": site.longitude_deg,
        "altitude_m": site.altitude_m,
        "azimuth_deg": built.layout.azimuth_deg,
    }
    if (rail := built.layout.rail) is not None:
        rise_s = 2.0 * last.speed_mps / STANDARD_GRAVITY_mps2  # without drag, gravity falls to a half at 2600 km
        return {
            "schema": 1,
            "name": built.layout.name,
            "description": f"{built.layout.name}, unguided flight to the apogee without wind",
            "vehicle": "vehicle",
            "run": {"duration_s": float(math.ceil(last.time_s + 5.0 + rise_s)), "stop_at": ["apogee", "impact"]},
            "site": place,
            "rail": _copied(rail, "rail", {}),
        }
    return {
        "schema": 1,
        "name": built.layout.name,
        "description": f"{built.layout.name}, powered ascent without wind",
        "vehicle": "vehicle",
        "design": "design.toml",
        "run": {"duration_s": float(math.ceil(last.time_s + 5.0 + _coasts_s(built)))},
        "site": place,
        "guidance": {"programme": "vehicle/pitch_programme.csv", **_closed_loop(built)},
        "requirement": _requirements(built),
    }


def _coasts_s(built: Built) -> float:
    """Return an upper bound of the time for further burns of the last engine, with a revolution for each unlimited
    coast.
    """
    burn_s = built.flight.stacks[-1].burn.end_s
    return sum((each.coast_s or REVOLUTION_s) + burn_s for each in built.layout.trajectory.restart)


def _closed_loop(built: Built) -> dict[str, Any]:
    """Return the keys of closed-loop guidance to the layout's orbit, none without an apogee.

    Raises ScenarioError for an apogee that the point-mass ascent does not reach.
    """
    wanted, last = built.layout.trajectory, built.flight.stacks[-1].burn
    if wanted.apogee_altitude_m is None:
        return {}
    reached_m = built.flight.orbit.apogee_m
    if wanted.apogee_altitude_m > reached_m:
        raise ScenarioError(
            built.layout.name,
            "exceeds the altitude that all propellant reaches",
            "trajectory.apogee_altitude_m",
            value=wanted.apogee_altitude_m,
            allowed=f"up to {reached_m:.6g}",
        )
    spent = last.usable_kg * (last.used_shares[1] - last.used_shares[0])
    return {
        "orbit": {
            "perigee_altitude_m": wanted.orbit_altitude_m,
            "apogee_altitude_m": wanted.apogee_altitude_m,
            "isp_s": float(f"{last.impulse_Ns / spent / STANDARD_GRAVITY_mps2:.6g}"),
            **({} if wanted.inclination_deg is None else {"inclination_deg": wanted.inclination_deg}),
        },
        **({} if not wanted.restart else {"restart": [_copied(each, "restart", {}) for each in wanted.restart]}),
    }


def _case(built: Built) -> dict[str, Any]:
    low = round(min(3.0, 0.6 * built.mode_1_hz), 2)
    judged = read_suite(SUITE).suite.margins
    assert judged is not None
    asked, off, spread = dict(judged.nominal), dict(judged.dispersed), judged.three_sigma
    slope, damping = float(np.max(spread.bending_slope)), float(np.max(spread.bending_damping))
    grows_db = 20.0 * math.log10((1.0 + slope) / (1.0 - damping))  # growth of the peaks of modes
    peak_db = round(min(asked["modes_from_2_db"], off["modes_from_2_db"] - grows_db) - ROOM_DB, 1)
    times_s, hz = least_rigid_hz(built, max(asked["gain_up_db"], asked["gain_down_db"]))
    least_hz = hz[0] if len(set(hz)) == 1 else {"time_s": times_s, "value": hz}
    limits = {
        "rigid_body": "aerodynamic",
        "rigid_hz": least_hz,
        "rigid_zeta": 0.5,
        "gain_margin_db": max(asked["gain_up_db"], asked["gain_down_db"]) + ROOM_DB,
        "phase_margin_deg": asked["rigid_phase_deg"] + ROOM_DEG,
        "first_mode_phase_deg": asked["first_mode_phase_deg"] + ROOM_DEG,
        "second_mode_db": peak_db,
        "modes_from_3_db": peak_db,
    }
    orders = ["F4" if len(_filter(built, n).get("quadratic", ())) > 1 else "F2" for n in range(len(built.stacks))]
    differing: list[dict[str, Any]] = [
        {"filter": {"structure": order}} if order != orders[0] else {} for order in orders
    ]
    for n, (own, stack) in enumerate(zip(differing, built.stacks, strict=True)):
        if stack.stage.robust:
            own["robust"] = {"campaign": CAMPAIGN}
        if _far(built, n):  # a low pass of gyro noise, which would otherwise use the rate of the servos
            most_hz = round(QUIET * max(built.rigid_hz(p) for p in burning(built, n)), 2)
            own |= {
                "filter": {"structure": orders[n], "bounds": {"pole_hz": [min(low, round(0.5 * most_hz, 2)), most_hz]}},
                "limits": {"filter_gain_at_infinity": HUSH},
            }
    return {
        "schema": 2,
        "description": f"{built.layout.name}, every stage: largest least |1 + L|",
        "scenario": "scenario.toml",
        "gains": {"schedule": "free"},
        "objective": {"kind": "least-margin"},
        "filter": {"structure": orders[0], "bounds": {"zero_hz": [low, 100.0], "pole_hz": [low, 100.0]}},
        "limits": limits,
        **({"stage": differing} if any(differing) else {}),
    }


def _suite(built: Built) -> dict[str, Any]:
    campaign = {
        "file": CAMPAIGN,
        "limits": "dispersed",
        "success": 0.95,
        "why": "demonstrated by a hundred flights without failure; 99.73 % needs more runs",
    }
    why = "demonstrated by 60 vehicles with at most one failure"
    margins: dict[str, Any] = {"nodes_per_stage": 7, "cases": 60, "success": 0.95, "why": why}
    return {
        "schema": 2,
        "extends": SUITE,
        "scenario": "scenario.toml",
        "limit_wind": LIMIT_WIND,
        "description": f"{built.layout.name}: the suite of any launcher, with fewer operating points and vehicles",
        "margins": margins,
        "certificate": {"nodes_per_stage": 2},
        "campaign": [campaign],
    }
