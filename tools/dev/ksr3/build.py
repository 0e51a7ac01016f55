"""Rebuilds scenarios/vehicles/ksr3 from the assumptions: `python -m maxq.tools.dev.ksr3.build` (about 10
s).

Order: point-mass flight fitted to Table 1 -> mass model -> lift fitted to Table 2 -> beam scaled to 9 Hz ->
least gains -> pitch programme. The bending filter is searched apart from this (search_filter.py).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import Array
from maxq.tools.dev.ksr3 import assumptions as a
from maxq.tools.dev.ksr3 import beam, gains
from maxq.tools.dev.ksr3.aerodynamics import Lift, fit_to_table_2
from maxq.tools.dev.ksr3.fitted import TABLE_1, TABLE_2
from maxq.tools.dev.ksr3.mass_model import mass_properties
from maxq.tools.dev.ksr3.trajectory import Flight, ascent_from, fit_to_table_1, fly, forces, summarise
from maxq.tools.dev.ksr3.vehicle_file import vehicle_toml
from maxq.tools.dev.ksr3.write_files import Reconstruction, write_tables

VEHICLE_FOLDER = Path(__file__).parents[3] / "scenarios" / "vehicles" / "ksr3"


def m_delta_at_nodes(flight: Flight) -> Array:
    """Table 2's M_delta in 1/s2, with the total mass and inertia."""
    values = []
    for t in a.NODES_S:
        _, altitude, speed, _ = flight.state_at(t)
        props = mass_properties(flight.ascent.burn, t)
        thrust = forces(flight.ascent, t, altitude, speed).thrust_N
        values.append(thrust * (a.GIMBAL_STATION_M - props.x_cg_m) / props.pitch_inertia_kgm2)
    return np.array(values)


def reconstruct(ascent: Sequence[float] = TABLE_1, lift: Sequence[float] = TABLE_2) -> Reconstruction:
    """The vehicle that follows from the fitted parameters."""
    flight = fly(ascent_from(np.array(ascent)))
    return Reconstruction(
        flight=flight,
        lift=Lift(*lift),
        stiffness_scale=beam.fit_stiffness(flight.ascent.burn),
        gains=gains.least_gains(m_delta_at_nodes(flight)),
    )


def report(made: Reconstruction) -> None:
    ascent = made.flight.ascent
    print(summarise(made.flight))
    print(f"burn: end {ascent.burn.end_s:.6f} s, Isp {ascent.burn.exhaust_velocity_mps / 9.80665:.3f} s")
    print(f"{ascent.drag}, turn {np.degrees(ascent.turn_rad):.3f} deg, release {made.flight.release_s:.4f} s")
    print(made.lift, f"EI scale {made.stiffness_scale:.5f}", made.gains, sep="\n")
    print("M_delta at the nodes:", np.round(m_delta_at_nodes(made.flight), 3))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path, default=VEHICLE_FOLDER)
    parser.add_argument("--refit", action="store_true", help="fit to Tables 1 and 2 and print what fitted.py keeps")
    given = parser.parse_args()
    if given.refit:
        ascent = fit_to_table_1()
        print("TABLE_1 =", tuple(ascent.tolist()))
        print("TABLE_2 =", tuple(fit_to_table_2(fly(ascent_from(ascent))).tolist()))
        return
    folder: Path = given.folder
    folder.mkdir(parents=True, exist_ok=True)
    made = reconstruct()
    write_tables(folder, made)
    (folder / "vehicle.toml").write_text(vehicle_toml(), encoding="utf-8")
    report(made)


if __name__ == "__main__":
    main()
