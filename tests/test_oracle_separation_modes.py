"""Modal motion at a separation equals a finite-element beam cut in two whose front part continues to move."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import tomli_w
from numpy.typing import NDArray
from oracles.beam_frame import Beam
from scipy.linalg import eigh

from maxq import FlightRun
from maxq.sim.packing.separation import RIGID, StageModes, modal_transfer
from maxq.sim.scenario.loader import load_scenario_text
from maxq.sim.vehicle.modes.tables import MODE_COLUMNS, ModeTable, SpatialModeTable
from maxq.sim.vehicle.state import N_FIXED, Q_BI, R_I, V_I, W_BI_B

CUT_S, LATER_S, LENGTH_M, FRONT_M, ELEMENTS, MODES = 0.1, 0.5, 20.0, 9.0, 60, 4
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Piece:
    """A free beam: consistent mass and stiffness over (displacement, slope) of its nodes, and all of its modes."""

    nodes_m: Array
    density_kgpm: Array
    mass: Array
    stiffness: Array

    @property
    def rigid(self) -> Array:
        """Return the fields of a displacement and of a rotation about the nose."""
        out = np.zeros((2 * len(self.nodes_m), 2))
        out[0::2, 0], out[0::2, 1], out[1::2, 1] = 1.0, self.nodes_m, 1.0
        return out

    @property
    def mass_kg(self) -> float:
        return float(self.rigid[:, 0] @ self.mass @ self.rigid[:, 0])

    @property
    def cg_m(self) -> float:
        return float(self.rigid[:, 0] @ self.mass @ self.rigid[:, 1]) / self.mass_kg

    @property
    def inertia_kgm2(self) -> float:
        about_nose = float(self.rigid[:, 1] @ self.mass @ self.rigid[:, 1])
        return about_nose - self.mass_kg * self.cg_m**2

    @property
    def forward_kg(self) -> Array:
        return np.concatenate([[0.0], np.cumsum(self.density_kgpm * np.diff(self.nodes_m))])

    def modes(self) -> tuple[Array, Array]:
        """Return the frequencies (rad/s) and shapes by columns of all bending modes; the largest displacement is 1."""
        squares, shapes = eigh(self.stiffness, self.mass)
        shapes = shapes[:, 2:] / np.abs(shapes[0::2, 2:]).max(axis=0)
        return np.sqrt(squares[2:]), shapes

    def columns(self) -> dict[str, list[float]]:
        """Return the piece as the columns of a mode table."""
        omega, shapes = self.modes()
        rows = [
            (0.0, k + 1, omega[k] / (2.0 * np.pi), shapes[:, k] @ self.mass @ shapes[:, k], x, phi, slope, forward)
            for k in range(MODES)
            for x, phi, slope, forward in zip(
                self.nodes_m, shapes[0::2, k], shapes[1::2, k], self.forward_kg, strict=True
            )
        ]
        names = (MODE_COLUMNS.axis, *MODE_COLUMNS.sets[0])
        return {name: [float(row[k]) for row in rows] for k, name in enumerate(names)}


def piece(length_m: float) -> Piece:
    """Return the front `length_m` of a beam whose mass and stiffness vary along it."""
    h = LENGTH_M / ELEMENTS
    count = round(length_m / h)
    x = h * np.arange(count + 1)
    middle = 0.5 * (x[1:] + x[:-1])
    density = np.where(middle < 3.0, 40.0, np.where(middle < FRONT_M, 220.0, 310.0))
    bending = np.where(middle < FRONT_M, 4e7, 1.2e8)
    stiffness, mass = Beam(x, bending, density, np.zeros(count + 1), np.zeros(count)).matrices()
    return Piece(x, density, mass, stiffness)


WHOLE, FRONT = piece(LENGTH_M), piece(FRONT_M)


def flown() -> FlightRun:
    def stage(beam: Piece) -> dict[str, Any]:
        constant = {
            "time_s": 0.0,
            "mass_kg": beam.mass_kg,
            "x_cg_m": beam.cg_m,
            "Ixx_kgm2": 0.2 * beam.mass_kg,
            "Iyy_kgm2": beam.inertia_kgm2,
            "Izz_kgm2": beam.inertia_kgm2,
        }
        modes = beam.columns()
        return {
            "mass": {"table": {key: [value] for key, value in constant.items()}},
            "bending": {"pitch": modes, "yaw": modes, "damping_ratio": [0.0] * MODES},
        }

    document = {
        "schema": 1,
        "vehicle": {
            "name": "beam",
            "reference": {"length_m": LENGTH_M, "diameter_m": 1.0, "area_m2": 0.8},
            "stage": [stage(WHOLE) | {"separation_s": CUT_S}, stage(FRONT)],
        },
        "run": {"duration_s": 1.0, "stop_at": [], "step_s": 1e-4},
        "initial": {"ned_mps": [0.0, 0.0, -1000.0]},
        "log": {"fast_hz": 10.0, "slow_hz": 10.0, "transform_hz": 1.0},
    }
    return FlightRun(load_scenario_text(tomli_w.dumps(document)), log=False)


ETA, XI = N_FIXED, N_FIXED + 2 * MODES


def flight(bent: bool, rates_radps: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> dict[str, Array]:
    """Return the state vectors before, after and some time after the cut, of a flight with or without modal motion."""
    run = flown()
    y = run.packed.state
    y[W_BI_B : W_BI_B + 3] = rates_radps
    if bent:
        for first, sign in ((ETA, 1.0), (XI, -0.7)):
            y[first : first + MODES] = sign * np.array([3e-3, 2e-3, -1e-3, 5e-4])
            y[first + MODES : first + 2 * MODES] = np.array([0.05, -0.04, 0.03, 0.02])
    run.fly_segment(round(1e9 * CUT_S))
    out, soon = {"before": np.array(y)}, []
    for _ in range(4):
        run.fly_segment(100_000)
        soon.append(np.array(y))
    out["after"] = 4.0 * soon[0] - 6.0 * soon[1] + 4.0 * soon[2] - soon[3]  # extrapolated to the instant of the cut
    run.fly_segment(round(1e9 * LATER_S))
    assert [e.name for e in run.events] == ["separation"]
    return out | {"later": np.array(y)}


def turning(q: Array) -> Array:
    """Return the rotation matrix from B to I."""
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip  # by rows


def points(y: Array, beam: Piece) -> tuple[Array, Array]:
    """Return the places and velocities of a beam's nodes in I: C + R (r + u), v + R (w x (r + u) + du/dt)."""
    phi, x = beam.modes()[1][0::2, :MODES], beam.nodes_m
    eta, nu, xi, nu_xi = (y[ETA + k * MODES : ETA + (k + 1) * MODES] for k in range(4))
    w, zero, rotation = y[W_BI_B : W_BI_B + 3], np.zeros_like(x), turning(y[Q_BI : Q_BI + 4])
    r = np.stack([beam.cg_m - x, phi @ xi, phi @ eta], axis=1)
    rate = np.stack([zero, phi @ (nu_xi + w[0] * eta), phi @ (nu - w[0] * xi)], axis=1)
    return y[R_I : R_I + 3] + r @ rotation.T, y[V_I : V_I + 3] + (np.cross(w, r) + rate) @ rotation.T


def test_the_front_part_goes_on_where_it_was_and_as_fast() -> None:
    """Every point of a turning beam bent in both planes keeps place and velocity at the cut.

    The motion that its modes cannot represent is left over; it has no linear or angular momentum. Masses are lumped at
    the nodes here.
    """
    y = flight(True, (0.5, 0.3, -0.2))
    n = len(FRONT.nodes_m)
    half = 0.5 * FRONT.density_kgpm * np.diff(FRONT.nodes_m)
    mass = np.append(half, 0.0) + np.append(0.0, half)
    straight = y["before"].copy()
    straight[N_FIXED : N_FIXED + 4 * MODES] = 0.0
    for before, after, unbent in zip(
        points(y["before"], WHOLE), points(y["after"], FRONT), points(straight, WHOLE), strict=True
    ):
        left, moved = (after - before[:n]), np.linalg.norm(before[:n] - unbent[:n], axis=1)
        assert np.linalg.norm(left, axis=1).max() < 0.03 * moved.max()
        assert np.abs(mass @ left).max() < 1e-3 * (mass @ moved)
        lever = FRONT.nodes_m - FRONT.cg_m
        assert np.abs((mass * lever) @ left).max() < 1e-3 * (mass * np.abs(lever)) @ moved


def test_the_front_part_moves_on_as_finite_elements_do() -> None:
    """All modes and the rigid motion of a beam, from the composite's field at the cut, equal the simulator's flight.

    A flight without modal motion is subtracted.
    """
    with_motion, without = flight(True), flight(False)
    n, wait_s = 2 * len(FRONT.nodes_m), LATER_S - CUT_S
    later, start = with_motion["later"], with_motion["before"]
    rotation = turning(without["later"][Q_BI : Q_BI + 4])
    moved = rotation.T @ (later - without["later"])[R_I : R_I + 3]
    tilt = rotation.T @ turning(later[Q_BI : Q_BI + 4])
    angle = np.array([tilt[2, 1], tilt[0, 2], tilt[1, 0]])
    omega, shapes = FRONT.modes()
    whole = WHOLE.modes()[1][:n, :MODES]
    rigid = FRONT.rigid
    rigid[:, 1] -= FRONT.cg_m * rigid[:, 0]
    for first, axis, rotates in ((ETA, 2, angle[1]), (XI, 1, -angle[2])):
        field, rate = (whole @ start[first + k : first + k + MODES] for k in (0, MODES))
        norms = [FRONT.mass_kg, FRONT.inertia_kgm2]
        free = [(r @ FRONT.mass @ (field + wait_s * rate)) / norm for r, norm in zip(rigid.T, norms, strict=True)]
        assert (moved[axis], rotates) == pytest.approx(free, rel=1e-5)
        masses = np.einsum("ij,ik,kj->j", shapes, FRONT.mass, shapes)
        at_cut, speed = (shapes.T @ FRONT.mass @ f / masses for f in (field, rate))
        by_elements = at_cut * np.cos(omega * wait_s) + speed / omega * np.sin(omega * wait_s)
        assert later[first : first + MODES] == pytest.approx(by_elements[:MODES], abs=1e-5 * np.abs(at_cut).max())
        bent = field - rigid @ [(r @ FRONT.mass @ field) / norm for r, norm in zip(rigid.T, norms, strict=True)]
        energies = masses * (speed**2 + (omega * at_cut) ** 2)
        assert np.abs(bent).max() > 1e-3
        assert energies[MODES:].sum() < 0.05 * energies.sum()  # what the table's modes leave out


def part(beam: Piece, table: ModeTable | SpatialModeTable | None = None, planar: bool = True) -> StageModes:
    """Return the beam's modes in both planes, or as spatial modes."""
    omega, shapes = beam.modes()
    shapes = shapes[:, :MODES].T
    mass = np.array([[shape @ beam.mass @ shape for shape in shapes]])
    given = np.zeros(1), beam.nodes_m, omega[None, :MODES] / (2.0 * np.pi), mass
    if planar:
        table = ModeTable(*given, shapes[None, :, 0::2], shapes[None, :, 1::2], beam.forward_kg[None])
        return StageModes(table, table, None, 0.0, "pchip")
    zero = np.zeros_like(shapes[:, 0::2])
    phi, slope = shapes[:, 0::2], shapes[:, 1::2]
    displacement = np.concatenate([np.stack([zero, zero, phi], -1), np.stack([zero, phi, zero], -1)])
    rotation = np.concatenate([np.stack([zero, slope, zero], -1), np.stack([zero, zero, -slope], -1)])
    frequency, masses = np.tile(given[2], 2), np.tile(mass, 2)
    spatial = SpatialModeTable(
        given[0], given[1], frequency, masses, displacement[None], rotation[None], beam.forward_kg[None], None, None
    )
    return StageModes(None, None, spatial, 0.0, "pchip")


def test_energy_is_lost_by_what_the_modes_cannot_hold_and_by_nothing_else() -> None:
    """The energy lost is that of the motion that the modes cannot represent.

    Pythagoras under the masses: kinetic energy of any motion before = that after + that of the remainder.
    """
    transfer = modal_transfer(part(WHOLE), part(FRONT), 0.0, 0.0)
    shapes = FRONT.modes()[1]
    n, rng = 2 * len(FRONT.nodes_m), np.random.default_rng(5)
    for _ in range(5):
        nu = rng.normal(size=MODES)
        field = WHOLE.modes()[1][:n, :MODES] @ nu
        rows = transfer[:, :MODES] @ nu  # those of the pitch plane
        taken = FRONT.rigid @ rows[[2, 4]] + shapes[:, :MODES] @ rows[RIGID : RIGID + MODES]
        left = field - taken
        energies = [f @ FRONT.mass @ f for f in (field, taken, left)]
        assert energies[0] == pytest.approx(energies[1] + energies[2], rel=1e-9)
        higher = shapes[:, MODES:].T @ FRONT.mass @ field
        by_higher = higher**2 / np.einsum("ij,ik,kj->j", shapes[:, MODES:], FRONT.mass, shapes[:, MODES:])
        assert energies[2] == pytest.approx(by_higher.sum(), rel=1e-6)
        assert energies[2] < 0.05 * energies[0]


@pytest.mark.parametrize(("before", "after"), [(True, False), (False, True), (False, False)])
def test_spatial_modes_hand_on_what_planar_ones_do(before: bool, after: bool) -> None:
    plain = modal_transfer(part(WHOLE), part(FRONT), 0.0, 0.0)
    assert modal_transfer(part(WHOLE, planar=before), part(FRONT, planar=after), 0.0, 0.3) == pytest.approx(
        plain, abs=1e-9
    )


def test_a_shaft_that_is_cut_turns_on_with_the_mean_of_its_twist() -> None:
    """In torsion cos(pi x / L) of a uniform shaft of length L, the front part a turns by sin(pi a / L) / (pi a / L).

    Mode cos(k pi x / a) takes the integral of both, in closed form.
    """
    x, a, length = np.linspace(0.0, 6.0, 241), 6.0, 10.0

    def shaft(end_m: float, modes: int) -> StageModes:
        stations = x if end_m == a else np.linspace(0.0, end_m, 401)
        twist = np.array([np.cos((k + 1) * np.pi * stations / end_m) for k in range(modes)])
        rotation = np.stack([twist, 0.0 * twist, 0.0 * twist], axis=-1)[None]
        ones = np.ones((1, modes))
        table = SpatialModeTable(
            np.zeros(1), stations, ones, ones, 0.0 * rotation, rotation, 50.0 * stations[None], None, None
        )
        return StageModes(None, None, table, 0.0, "pchip")

    found = modal_transfer(shaft(length, 1), shaft(a, 3), 0.0, 0.25)[:, 0]
    b = np.pi / length
    mean = np.sin(b * a) / (b * a)
    shares = [  # 2 / a times the integral of cos(b x) cos(c x)
        (np.sin((b - c) * a) / (b - c) + np.sin((b + c) * a) / (b + c)) / a for c in (k * np.pi / a for k in (1, 2, 3))
    ]
    assert found[[0, 1, 2, 4, 5]] == pytest.approx(np.zeros(5), abs=1e-12)
    assert found[[3, 6, 7, 8]] == pytest.approx([mean, *shares], abs=2e-4)


def test_a_front_part_without_modes_takes_the_rigid_motion_up_to_its_mass() -> None:
    rigid = modal_transfer(part(WHOLE), StageModes(None, None, None, 0.0, "pchip"), FRONT.mass_kg, 0.0)
    n = 2 * len(FRONT.nodes_m)
    whole = WHOLE.modes()[1][:n, :MODES]
    gram = FRONT.rigid.T @ FRONT.mass @ FRONT.rigid
    wanted = np.linalg.solve(gram, FRONT.rigid.T @ FRONT.mass @ whole)
    assert rigid.shape == (RIGID, 2 * MODES)
    assert rigid[[2, 4], :MODES] == pytest.approx(wanted, rel=1e-9, abs=1e-12)
    assert rigid[[1, 5], MODES:] == pytest.approx(wanted * [[1.0], [-1.0]], rel=1e-9, abs=1e-12)


def test_shapes_that_the_next_stage_has_pass_over_whatever_the_masses() -> None:
    """A motion that is rigid or a mode of the front part stays so, for any masses and for equal modes."""
    transfer = modal_transfer(part(FRONT), part(FRONT), 0.0, 0.0)
    assert transfer[RIGID:] == pytest.approx(np.eye(2 * MODES), abs=1e-9)
    assert transfer[:RIGID] == pytest.approx(np.zeros((RIGID, 2 * MODES)), abs=1e-9)
    odd, table = part(FRONT), part(FRONT).pitch
    assert table is not None
    massless = replace(table, mass_forward_kg=np.zeros_like(table.mass_forward_kg))
    unknown = odd._replace(pitch=massless, yaw=massless)
    assert modal_transfer(part(FRONT), unknown, 0.0, 0.0) == pytest.approx(transfer, abs=1e-9)
