"""Largest differences of the written vehicle from an earlier derivation's table, column by column:
`python -m maxq.tools.dev.studies.ksr3.compare_reference path/to/ksr3_1s.csv`.

The earlier table has one row a second, SI units, columns named after symbols (U, Iyy, f_b1, ...).
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import Array
from maxq.tools.dev.studies.ksr3.build import VEHICLE_FOLDER
from maxq.tools.dev.studies.ksr3.vehicle_at import Snapshot, VehicleFolder, snapshot


def quantities(vehicle: VehicleFolder, t: float) -> dict[str, float]:
    """Ours at time t, under the other table's names."""
    s = snapshot(vehicle, t)
    mass, x_cg, roll, pitch, _ = vehicle.mass(t)
    _, altitude, speed, path_angle, _, thrust, _, pressure, mach = vehicle.flight(t)
    aero = vehicle.aero(mach)
    lift = [surface(mach) for surface in vehicle.surfaces]
    slope = sum(row[0] for row in lift)
    values = {
        "h": altitude, "U": speed, "mach": mach, "qbar": pressure, "gamma_deg": path_angle, "T": thrust,
        "m": mass, "x_cg": x_cg, "Iyy": pitch, "Ixx": roll, "CA": aero[0], "CNa": slope,
        "x_cp": sum(row[0] * row[1] for row in lift) / slope, "Cmq": aero[2],
        "Za": -slope * s.pressure_area_N / (mass * speed), "Ma": s.m_alpha_ps2,
        "Zd": thrust / (mass * speed), "Md": s.m_delta_ps2, "Mq": s.pitch_damping_Nms / pitch,
        "m_rigid": s.core_mass_kg, "Iyy_rigid": s.core_inertia_kgm2, "ax_sensed": s.axial_mps2,
    }  # fmt: skip
    for name, tank, pendulum in zip(("lox", "fuel"), vehicle.tanks, s.pendulums, strict=True):
        row = tank(t)
        values |= {f"m_s_{name}": row[0], f"L_p_{name}": row[1], f"x_hinge_{name}": row[2]}
        values[f"f_s_{name}"] = float(np.sqrt(s.axial_mps2 / row[1]) / (2 * np.pi))
        values |= {f"phi{k + 1}_{name}": phi for k, phi in enumerate(pendulum.phi)}
    return values | _bending(s)


def _bending(s: Snapshot) -> dict[str, float]:
    b, values = s.bending, {}
    for k in range(len(b.omega_radps)):
        values[f"f_b{k + 1}"] = b.omega_radps[k] / (2 * np.pi)
        values[f"M_G{k + 1}"] = b.generalized_mass_kg[k]
        values[f"sig{k + 1}_gim"] = b.gimbal_slope_pm[k]
        values[f"sig{k + 1}_gyro"] = b.gyro_slope_pm[k]
        values[f"kg{k + 1}"] = s.axial_mps2 * b.softening[k, k]
    return values


def largest_differences(vehicle: VehicleFolder, other: dict[str, Array]) -> list[tuple[str, float, float, float]]:
    """Name, time, ours, theirs where they differ most, 5 s to 55 s; first the largest of its scale."""
    times = np.arange(5.0, 55.1, 1.0)
    ours = [quantities(vehicle, t) for t in times]
    found = []
    for name in ours[0]:
        mine = np.array([values[name] for values in ours])
        theirs = np.interp(times, other["t"], other[name])
        k = int(np.argmax(np.abs(mine - theirs)))
        share = abs(mine[k] - theirs[k]) / float(np.abs(theirs).max())
        found.append((share, (name, float(times[k]), float(mine[k]), float(theirs[k]))))
    return [entry for _, entry in sorted(found, reverse=True)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("table", type=Path)
    parser.add_argument("--vehicle", type=Path, default=VEHICLE_FOLDER)
    arguments = parser.parse_args()
    with arguments.table.open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    other = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    for name, t, ours, theirs in largest_differences(VehicleFolder(arguments.vehicle), other):
        print(f"{name:12s} at {t:4.0f} s: {ours:12.6g} here, {theirs:12.6g} there")


if __name__ == "__main__":
    main()
