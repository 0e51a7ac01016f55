"""The roll coupling of spatial modes of an asymmetric vehicle equals sums over its particles.

Fifteen sections of the axis and two engines off the axis carry the modes, which are random combinations of bending,
torsion and axial motion, orthogonal under all masses. The set is not closed: modes turned about x are not sums of
modes. Least squares over the masses of the sections alone give shares that are wrong by up to 0.028 of 0.39.
"""

from __future__ import annotations

import numpy as np
import pytest
from flightkit import Parts, rig, scenario_of
from test_oracle_spatial_modes import spatial_section

from maxq.control.kernel.records import Array
from maxq.sim.vehicle import state as layout

RNG = np.random.default_rng(8)
SECTIONS, MODES, MODAL_KG = 15, 4, 500.0
X = np.linspace(7.0, -7.0, SECTIONS)
AXIS_KG, ROLL_KGM2 = RNG.uniform(50.0, 250.0, SECTIONS), RNG.uniform(20.0, 90.0, SECTIONS)
EX = np.array([1.0, 0.0, 0.0])
ENGINES = ((13, 200.0, 0.6, (0.5, -0.2), (4.0, -5.0), 30.0), (12, 120.0, 0.45, (-0.3, 0.4), (0.0, 0.0), 12.0))
"""Section, mass (kg), length (m), offset (m), cant (deg) and inertia about the CG (kg m2) of each engine."""


def fields() -> tuple[Array, Array]:
    """Return displacements and rotations (16, 15, 3) of the sections: powers 0 to 3 of x along y, z, x and about x."""
    move, turn = np.zeros((2, 16, SECTIONS, 3))
    for power in range(4):
        value, slope = (X / 7.0) ** power, power * (X / 7.0) ** max(power - 1, 0) / 7.0
        move[power, :, 1], turn[power, :, 2] = value, slope
        move[4 + power, :, 2], turn[4 + power, :, 1] = value, -slope
        move[8 + power, :, 0], turn[12 + power, :, 0] = value, 0.3 * value
    return move, turn


def arm(engine: tuple) -> Array:  # type: ignore[type-arg]  # a row of ENGINES
    _, _, length, offset, cant, _ = engine
    pitch, yaw = np.radians(cant)
    thrust = np.array([np.cos(pitch) * np.cos(yaw), -np.sin(yaw), np.sin(pitch) * np.cos(yaw)])
    return np.array([0.0, *offset]) - length * thrust


def carried(move: Array, turn: Array, *, engines: bool) -> tuple[Array, Array, Array]:
    """Return weights (W,) and motions (n, W, 3) of all moving masses, and the motions of fields turned by 90 deg."""
    weight, motion = [*AXIS_KG, *ROLL_KGM2], [*move.transpose(1, 0, 2), *(EX * turn).transpose(1, 0, 2)]
    quarter = [np.cross(EX, each) for each in motion]
    for engine in ENGINES if engines else ():
        k, kg, *_, inertia = engine
        rigid = move[:, k] + np.cross(turn[:, k], arm(engine))
        tilted = np.cross(EX, rigid) + np.cross(np.cross(EX, turn[:, k]), arm(engine)) * EX
        weight += [kg, inertia]
        motion += [rigid, turn[:, k]]
        quarter += [tilted, np.cross(EX, turn[:, k])]
    return np.array(weight), np.array(motion).transpose(1, 0, 2), np.array(quarter).transpose(1, 0, 2)


def modes_and_shares(*, engines: bool) -> tuple[Array, Array, Array]:
    """Return the displacements and rotations of the modes, and the shares A_ij of mode i in the turned mode j."""
    move, turn = fields()
    weight, motion, _ = carried(move, turn, engines=engines)
    gram = np.einsum("w,aws,bws->ab", weight, motion, motion)
    rigid, mixed = np.zeros((6, 16)), np.random.default_rng(8).normal(size=(MODES, 16))
    rigid[range(6), [0, 1, 4, 5, 8, 12]] = 1.0
    known: list[Array] = []
    for given in np.concatenate([rigid, mixed]):
        row = given
        for _ in range(2):
            row = row - sum((other * (row @ gram @ other) for other in known), 0.0 * row)
        known.append(row / np.sqrt(row @ gram @ row))
    chosen = np.sqrt(MODAL_KG) * np.array(known[6:])
    shapes = [np.tensordot(chosen, each, axes=1) for each in (move, turn)]
    weight, motion, quarter = carried(*shapes, engines=engines)
    np.testing.assert_allclose(np.einsum("w,aws,bws->ab", weight, motion, motion), MODAL_KG * np.eye(MODES), atol=1e-6)
    exchange = np.einsum("w,iws,jws->ij", weight, motion, quarter) / MODAL_KG
    return *shapes, 0.5 * (exchange - exchange.T)


@pytest.mark.parametrize("contains", ["engines in the sections", "engines left out", "engines at their gimbals"])
def test_roll_coupling_counts_the_engines_where_they_move(contains: str) -> None:
    move, turn, share = modes_and_shares(engines=contains != "engines in the sections")
    mass, stations = AXIS_KG.copy(), 7.0 - X
    engines = []
    for n, (k, kg, length, offset, cant, inertia) in enumerate(ENGINES):
        mass[k] += kg if contains == "engines at their gimbals" else 0.0
        engines.append(
            {
                "table": [{"time_s": 0.0, "thrust_vacuum_N": 0.0}],
                "group": str(n),
                "offset_m": list(offset),
                "gimbal_station_m": float(stations[k]),
                "exit_station_m": 15.0,
                "gimballed_mass_kg": kg,
                "cg_from_gimbal_m": length,
                "inertia_about_gimbal_kgm2": kg * length**2 + inertia,
                "cant_deg": list(cant),
            }
        )
    sets = [
        (w, MODAL_KG, 0.0, np.concatenate([a, b], axis=1)) for w, a, b in zip((3, 4, 6, 9), move, turn, strict=True)
    ]
    forward = np.concatenate([[0.0], np.cumsum(mass)[:-1]])
    tree = scenario_of(Parts(gimbal_station_m=float(stations[13]), stations_m=tuple(stations)))
    stage = tree["vehicle"]["stage"][0]
    stage["engine"] = engines
    stage["spatial_modes"] = spatial_section(stations, forward, sets, mass_kg=mass, roll_inertia_kgm2=ROLL_KGM2)
    made = rig(tree)
    first, got = int(layout.spatial_index(made.sizes)), np.zeros((MODES, MODES))
    for j in range(MODES):
        y = made.y.copy()
        y[layout.W_BI_B], y[first + j] = 1.0, 1.0  # at rest in the quasi-velocities: d(eta)/dt = -p A eta
        got[:, j] = -made.derivative(y)[first : first + MODES]
    assert np.abs(share).max() > 0.2
    np.testing.assert_allclose(got, share, atol=1e-9)
