"""The comparison of a vehicle built from a layout with a given vehicle, by their packed quantities over the burns."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import table_in
from maxq.design.model.held import HeldStage, hold_stage, table_clock_s
from maxq.design.model.vehicle_at import vehicle_at
from maxq.sim.input.files import scenarios_folder
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.quantities import number_text
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.vehicle import schedule
from maxq.sim.vehicle.air import kernel as aero
from maxq.tools.cli.terminal import aligned
from maxq.tools.vehicle.build import Built, burning, spread

ALIKE = 1e-2
TIMES = 11  # points of each burn, at full thrust
_BODY = {
    "body: core mass, kg": schedule.CORE_MASS, "body: core CG station, m": schedule.CORE_CG,
    "body: core CG rate, m/s": schedule.CG_RATE, "body: core transverse inertia, kg m2": schedule.CORE_INERTIA + 1,
    "body: core transverse inertia rate, kg m2/s": schedule.INERTIA_RATE + 1,
    "body: total mass, kg": schedule.TOTAL_MASS, "body: mass flow, kg/s": schedule.MASS_FLOW,
    "engine: thrust in vacuum, N": schedule.THRUST_VACUUM,
}  # fmt: skip  # a table
_TANK = {
    "mass, kg": schedule.TANK_MASS, "mass rate, kg/s": schedule.TANK_MASS_RATE, "length, m": schedule.TANK_LENGTH,
    "hinge station, m": schedule.TANK_HINGE, "bob station rate, m/s": schedule.TANK_TRAVEL,
    "viscous damping": schedule.TANK_VISCOUS, "ring damping": schedule.TANK_RING,
}  # fmt: skip  # a table
_MODE = {
    "frequency, rad/s": schedule.MODE_OMEGA, "generalised mass, kg": schedule.MODE_MASS,
    "shape at gimbal": schedule.MODE_PHI_GIMBAL, "slope at gimbal, 1/m": schedule.MODE_SLOPE_GIMBAL,
    "slope at gyro, 1/m": schedule.MODE_SLOPE_GYRO,
}  # fmt: skip  # a table
_SPATIAL = {"frequency, rad/s": schedule.SPATIAL_OMEGA, "generalised mass, kg": schedule.SPATIAL_MASS}
_ENGINE = {
    "exit area, m2": "exit_area_m2", "gimbal station, m": "gimbal_station_m", "exit station, m": "exit_station_m",
    "gimballed mass, kg": "gimballed_mass_kg", "CG from gimbal, m": "cg_from_gimbal_m",
    "inertia, kg m2": "inertia_kgm2",
}  # fmt: skip  # a table
_COEFFICIENTS = {"CA": aero.CA, "CD": aero.CD, "pitch damping": aero.CMQ}


@dataclasses.dataclass(frozen=True)
class Difference:
    """A quantity at the points of all burns, for the layout (`here`) and the given vehicle (`there`)."""

    name: str
    here: Array
    there: Array

    @property
    def largest(self) -> float:
        """Return the largest difference divided by the largest magnitude for the given vehicle."""
        scale = float(np.abs(self.there).max())
        return float(np.abs(self.here - self.there).max()) / (scale or 1.0)


def compared(built: Built, folder: Path, vehicle: str) -> list[Difference]:
    """Compare the files in `folder`, written from `built`, with a vehicle given by its folder or built-in name.

    Quantities that are zero throughout for the given vehicle are omitted. Raises ScenarioError for a vehicle that
    cannot be read, and ValueError for a vehicle with different stages, tanks, modes or surfaces.
    """
    path = Path(vehicle) if Path(vehicle).exists() else scenarios_folder() / vehicle
    ours = load_scenario(folder / "scenario.toml")
    theirs = load_scenario(folder / "scenario.toml", [f'vehicle="{path.resolve().as_posix()}"'])
    if len(ours.vehicle.stage) != len(theirs.vehicle.stage):
        count = len(ours.vehicle.stage)
        raise ValueError(f"{vehicle} has {len(theirs.vehicle.stage)} stages, the layout makes {count}")
    columns = [_quantities(built, loaded) for loaded in (ours, theirs)]
    if other := sorted(set(columns[0]) ^ set(columns[1])):
        raise ValueError(f"{vehicle} has other tanks, modes or surfaces: {other[0]}")
    return [Difference(name, columns[0][name], columns[1][name]) for name in columns[0] if columns[1][name].any()]


def _quantities(built: Built, loaded: LoadedScenario) -> dict[str, Array]:
    packed, found = pack_flight(loaded.scenario), dict[str, list[float]]()
    for n in range(len(built.stacks)):
        for p in spread(burning(built, n), TIMES):
            held = hold_stage(packed, table_clock_s(packed.parameters[n], p.clock_s), n)
            for name, value in _numbers(held, p.mach):
                found.setdefault(name, []).append(value)
    return {name: np.array(values) for name, values in found.items()}


def _numbers(held: HeldStage, mach: float) -> Iterator[tuple[str, float]]:
    """Yield the title and value of each quantity of a held stage, in the pitch plane."""
    row, p, sizes, whole = held.parameters[0].vehicle, held.properties[0], held.sizes, vehicle_at(held, "pitch")
    yield "vehicle: CG station, m", whole.total_cg_station_m
    yield "vehicle: transverse inertia, kg m2", whole.total_inertia_kgm2
    for title, column in _BODY.items():
        yield title, float(p[column])
    for k in range(len(held.swing_rad)):
        for title, column in _TANK.items():
            yield f"pendulum {k + 1}: {title}", float(p[schedule.tank_column(k) + column])
        yield f"pendulum {k + 1}: damping ratio", float(whole.pendulums.damping_ratio[k])
    rows = _MODE | {f"shape at hinge {k + 1}": schedule.MODE_FIRST + k for k in range(int(sizes.pendulums))}
    for s in range(int(sizes.surfaces)):
        first = int(schedule.surface_row(sizes, s))
        rows |= {f"shape at surface {s + 1}": first, f"slope at surface {s + 1}, 1/m": first + 1}
    modes = range(int(sizes.pitch_modes))
    rows |= {f"softening by mode {n + 1}, kg/m": int(schedule.softening_row(sizes, n)) for n in modes}
    for n in modes:
        for title, which in rows.items():
            yield f"mode {n + 1}: {title}", float(p[int(schedule.mode_column(sizes, schedule.PITCH, which)) + n])
    for n in range(int(sizes.spatial_modes)):
        for title, which in _SPATIAL.items():
            yield f"spatial mode {n + 1}: {title}", float(p[int(schedule.spatial_column(sizes, which)) + n])
        for title, place in (("gimbal", int(schedule.gimbal_place(sizes, 0))), ("gyro", schedule.GYRO_PLACE)):
            for component, axis in enumerate(("x", "y", "z", "about x", "about y", "about z")):
                value = float(p[int(schedule.place_column(sizes, place, component)) + n])
                yield f"spatial mode {n + 1}: shape at {title}, {axis}", value
    for title, field in _ENGINE.items():
        yield f"engine: {title}", float(row.engine[field][0])
    air = table_in(held.pool, row.aero.table)(mach)
    yield "aerodynamics: area, m2", float(row.aero.area_m2)
    yield "aerodynamics: chord, m", float(row.aero.chord_m)
    for title, column in _COEFFICIENTS.items():
        yield f"aerodynamics: {title}", float(air[column])
    for s in range(int(sizes.surfaces) - int(sizes.tables)):
        at = aero.FIRST_SURFACE + 2 * s
        yield f"surface {s + 1}: CN_alpha, 1/rad", float(air[at])
        yield f"surface {s + 1}: CN_alpha times station, m/rad", float(air[at + 1])


def comparison(found: list[Difference], vehicle: str) -> str:
    """Return the differences as a table, largest first, with the values where each difference is largest."""
    rows = [("quantity", "here", "there", "off, %")]
    alike = [d for d in found if d.largest < ALIKE]
    for d in sorted((d for d in found if d.largest >= ALIKE), key=lambda d: -d.largest):
        k = int(np.argmax(np.abs(d.here - d.there)))
        rows.append((d.name, number_text(d.here[k]), number_text(d.there[k]), f"{100.0 * d.largest:.3g}"))
    head = f"compared with {vehicle}, {TIMES} times of each burn: values where they differ most, % of the largest there"
    rest = f"  {len(alike)} more differ by less than {100.0 * ALIKE:g} %"
    return "\n".join([head, *aligned(rows, "  ", right=range(1, 4)), rest])
