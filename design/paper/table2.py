"""Stability derivatives imposed on a node: those of the paper's Table 2.

No plausible arrangement of masses reaches the ends of Table 2's M_delta (scenarios/vehicles/ksr3/NOTES.md), so a node
keeps its mass, speed, pendulums, modes and instruments, and five parameters are changed until eqs 4 to 8 give the
derivatives that are wanted; what is coupled to them follows:

- thrust, for Z_delta (5); drag makes up for it, so that the axial load and with it the slosh frequencies stay
- inertia of the core, for M_delta (8); Cmq, so that M_q (7) stays
- CN_alpha of all surfaces by one factor, for Z_alpha (4); their stations by one shift, for M_alpha (6).
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.interpolate import PchipInterpolator

from maxq.control.kernel.records import Array
from maxq.design.model.held import FlightCondition
from maxq.design.paper.nodes import PaperNode
from maxq.design.paper.vehicle_at import PlanarVehicle
from maxq.sim.scenario.files import scenarios_folder

COLUMNS = ("z_alpha_1ps", "m_alpha_1ps2", "z_delta_1ps", "m_delta_1ps2")
TABLE_2_FILE = "vehicles/ksr3-table2/derivatives.csv"


@dataclass(frozen=True)
class DerivativeTable:
    """Derivatives over vehicle time: `values` (times, 4) in the order of COLUMNS; monotone cubics between."""

    time_s: Array
    values: Array
    source: str = ""

    def at(self, time_s: float) -> dict[str, float]:
        """Raises ValueError outside the table."""
        first, last = float(self.time_s[0]), float(self.time_s[-1])
        if not first <= time_s <= last:
            raise ValueError(f"node at {time_s:g} s: {self.source or 'the table'} holds {first:g} s to {last:g} s")
        row = self.values[0] if len(self.time_s) == 1 else PchipInterpolator(self.time_s, self.values)(time_s)
        return dict(zip(COLUMNS, (float(x) for x in row), strict=True))


def read_derivatives(file: str | Path = TABLE_2_FILE) -> DerivativeTable:
    """A CSV file with columns time_s and COLUMNS; a relative name is also looked for among the built-in scenarios.

    Raises ValueError, naming the file, if it is not such a table.
    """
    path = Path(file) if Path(file).exists() else scenarios_folder() / file
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line and not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    wanted = ("time_s", *COLUMNS)
    try:
        numbers = np.array([[float(row[name]) for name in wanted] for row in rows]).reshape(-1, len(wanted))
    except (KeyError, TypeError, ValueError) as problem:
        raise ValueError(f"{path}: allowed are columns {', '.join(wanted)} of numbers ({problem})") from problem
    if not len(numbers) or not np.isfinite(numbers).all() or (np.diff(numbers[:, 0]) <= 0.0).any():
        raise ValueError(f"{path}: allowed are one row or more of finite numbers, time_s rising")
    return DerivativeTable(numbers[:, 0], numbers[:, 1:], str(file))


def imposed(nodes: Iterable[PaperNode], table: DerivativeTable) -> list[PaperNode]:
    """Each node with the table's derivatives at its time. Raises ValueError outside the table and where impossible."""
    return [impose(node, **table.at(node.time_s)) for node in nodes]


def impose(
    node: PaperNode, z_alpha_1ps: float, m_alpha_1ps2: float, z_delta_1ps: float, m_delta_1ps2: float
) -> PaperNode:
    """The node with these `stability_derivatives` and its own M_q."""
    condition = node.condition
    before = node.derivatives
    if min(before.z_delta_1ps, before.m_delta_1ps2, -before.z_alpha_1ps, z_delta_1ps, m_delta_1ps2) <= 0.0:
        raise ValueError(f"node at {node.time_s:g} s: derivatives can be imposed on a thrusting vehicle with lift only")
    vehicle = with_lateral_thrust(node.planar, condition, z_delta_1ps / before.z_delta_1ps)
    old = vehicle.total_inertia_kgm2
    arm = vehicle.engine.gimbal_station_m - vehicle.total_cg_station_m
    inertia = vehicle.engine.thrust_N(condition.pressure_Pa) * arm / m_delta_1ps2
    core = vehicle.body.core_inertia_kgm2 + inertia - old
    if core <= 0.0:
        raise ValueError(f"node at {node.time_s:g} s: M_delta = {m_delta_1ps2:g} leaves the core no inertia")
    air = vehicle.aerodynamics
    slope = air.slope_pr * (z_alpha_1ps / before.z_alpha_1ps)
    moment = air.moment_slope_mpr * (z_alpha_1ps / before.z_alpha_1ps)
    force_area = condition.dynamic_pressure_Pa * air.area_m2
    wanted = float(slope.sum()) * vehicle.total_cg_station_m - m_alpha_1ps2 * inertia / force_area
    shift = (wanted - float(moment.sum())) / float(slope.sum())
    return dataclasses.replace(
        node,
        planar=dataclasses.replace(
            vehicle,
            body=dataclasses.replace(vehicle.body, core_inertia_kgm2=core),
            aerodynamics=dataclasses.replace(
                air,
                slope_pr=slope,
                moment_slope_mpr=moment + slope * shift,
                rate_damping=air.rate_damping * inertia / old,
                rate_slope_m=air.rate_slope_m * inertia / old,
                rate_moment_m2=air.rate_moment_m2 * inertia / old,
            ),
        ),
    )


def with_lateral_thrust(vehicle: PlanarVehicle, condition: FlightCondition, factor: float) -> PlanarVehicle:
    """Return the vehicle with `factor` times the thrust of all engines; drag makes up for it, so that the axial load
    stays. Where there is no air the axial load changes with the thrust.
    """
    air = vehicle.aerodynamics
    own = [(engine, (factor - 1.0) * engine.thrust_N(condition.pressure_Pa)) for engine in vehicle.engines]
    more = sum(engine.rest[0] * push for engine, push in own)
    engines = tuple(dataclasses.replace(e, vacuum_thrust_N=e.vacuum_thrust_N + push) for e, push in own)
    if condition.dynamic_pressure_Pa * air.area_m2 > 0.0:
        air = dataclasses.replace(air, axial=air.axial + more / (condition.dynamic_pressure_Pa * air.area_m2))
    return dataclasses.replace(vehicle, engines=engines, aerodynamics=air)
