"""Stability derivatives imposed on an operating point, such as those of the paper's Table 2.

No plausible arrangement of masses reaches the ends of Table 2's M_delta (scenarios/vehicles/ksr3/NOTES.md). An
operating point therefore keeps its mass, speed, pendulums, modes and instruments, and its held stage is changed until
eqs 4 to 8 give the required derivatives:

- thrust, for Z_delta (5), with a change of drag that keeps the axial load and the slosh frequencies
- inertia, for M_delta (8), with a change of Cmq that keeps M_q (7)
- CN_alpha of all surfaces by one factor, for Z_alpha (4), and their stations by one shift, for M_alpha (6).
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import scipy  # its submodules are imported at first use

from maxq.control.kernel.records import Array
from maxq.design.model.node import Node
from maxq.sim.input.files import scenarios_folder
from maxq.sim.vehicle import schedule

COLUMNS = ("z_alpha_1ps", "m_alpha_1ps2", "z_delta_1ps", "m_delta_1ps2")
N = TypeVar("N", bound=Node)
TABLE_2_FILE = "vehicles/ksr3-table2/derivatives.csv"


@dataclass(frozen=True)
class DerivativeTable:
    """A table of derivatives over vehicle time, with monotone cubic interpolation.

    `values` has the shape (times, 4), in the order of COLUMNS.
    """

    time_s: Array
    values: Array
    source: str = ""

    def at(self, time_s: float) -> dict[str, float]:
        """Return the derivatives at a time. Raises ValueError for a time outside the table."""
        first, last = float(self.time_s[0]), float(self.time_s[-1])
        if not first <= time_s <= last:
            holds = f"{self.source or 'the table'} holds {first:g} s to {last:g} s"
            raise ValueError(f"operating point at {time_s:g} s: {holds}")
        row = (
            self.values[0]
            if len(self.time_s) == 1
            else scipy.interpolate.PchipInterpolator(self.time_s, self.values)(time_s)
        )
        return dict(zip(COLUMNS, (float(x) for x in row), strict=True))


def read_derivatives(file: str | Path = TABLE_2_FILE) -> DerivativeTable:
    """Read a CSV file with the columns time_s and COLUMNS.

    A relative name is also searched for among the built-in scenarios. Raises ValueError, with the file name, for other
    content.
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


def imposed(nodes: Iterable[N], table: DerivativeTable) -> list[N]:
    """Return each operating point with the table's derivatives at its time.

    Raises ValueError for a time outside the table and for impossible derivatives.
    """
    return [impose(node, **table.at(node.time_s)) for node in nodes]


def impose(node: N, z_alpha_1ps: float, m_alpha_1ps2: float, z_delta_1ps: float, m_delta_1ps2: float) -> N:
    """Return the operating point with the given `Node.derivatives` and its own M_q.

    Raises ValueError for impossible derivatives.
    """
    before, vehicle = node.derivatives, node.vehicle
    if min(before.z_delta_1ps, before.m_delta_1ps2, -before.z_alpha_1ps, z_delta_1ps, m_delta_1ps2) <= 0.0:
        raise ValueError(f"operating point at {node.time_s:g} s: imposed derivatives need thrust and lift")
    push, lift = z_delta_1ps / before.z_delta_1ps, z_alpha_1ps / before.z_alpha_1ps
    old, core = vehicle.total_inertia_kgm2, vehicle.core_inertia_kgm2
    inertia = push * before.m_delta_1ps2 * old / m_delta_1ps2
    if core + inertia - old <= 0.0:
        raise ValueError(f"operating point at {node.time_s:g} s: M_delta = {m_delta_1ps2:g} leaves the core no inertia")
    lift_Nprad = -z_alpha_1ps * vehicle.total_mass_kg * node.condition.airspeed_mps
    aft_m = (lift * before.m_alpha_1ps2 * old - m_alpha_1ps2 * inertia) / lift_Nprad
    vacuum_N, net_N = _axial_thrust(node)
    drag_N = net_N - node.axial_load_mps2 * float(node.held.properties[0, schedule.TOTAL_MASS])
    held = node.with_(
        thrust=1.0 + (push - 1.0) * net_N / vacuum_N,
        normal_force=lift,
        centre_of_pressure_m=aft_m,
        inertia=inertia / old,
        rate_damping=inertia / old,
    ).held
    held.vehicle["aero"]["axial_factor"] *= 1.0 + (push - 1.0) * net_N / drag_N  # negative if thrust is added
    return dataclasses.replace(node, held=held)


def _axial_thrust(node: Node) -> tuple[float, float]:
    """Return the axial thrust of all engines in vacuum, and in the air of the operating point, N."""
    held, vacuum_N, net_N = node.held, 0.0, 0.0
    engine = held.vehicle["engine"][0]
    for k in range(int(held.sizes.engines)):
        column = int(schedule.thrust_column(held.sizes, int(engine["curve"][k])))
        thrust_N = float(engine["thrust_factor"][k] * held.properties[0, column])
        vacuum_N += float(engine["rest_x"][k]) * thrust_N
        lost_N = node.condition.pressure_Pa * float(engine["exit_area_m2"][k])
        net_N += float(engine["rest_x"][k]) * max(thrust_N - lost_N, 0.0)
    return vacuum_N, net_N
