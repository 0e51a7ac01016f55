"""The lag of the air behind the first bending mode, against matrices written out here and SciPy's exponential.

| what | against |
|---|---|
| linear model of pitch and yaw, and plant of a plane | the equations of body, two modes and lag, written out |
| flight of both planes | the exponential of the same matrix |
| response of the aerodynamic force to a mode that is moved | 1 / (1 + s L / V) |
| a long and a short lag | no force of the mode, and the quasi-steady one |
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from flightkit import Mode, Parts, Rig, Tree, flown, load, merged, rig, scenario_of, with_stage
from scipy.linalg import expm

from maxq import ScenarioError
from maxq.control.kernel.records import Array
from maxq.design.model.linearised import linearise
from maxq.design.model.node import node_of
from maxq.sim.packing.flight import pack_flight
from maxq.sim.vehicle import state as layout

SPEED, DENSITY, AREA, LAG_M = 300.0, 0.6, 0.8, 6.0
MASS_KG, INERTIA, CG_M = 4000.0, 5.0e4, 7.0
SURFACES = ((2.2, 3.0, 1), (30.0, 12.0, 4))  # CN_alpha, station, index of the station in the shapes
MODES = (
    Mode(4.0, 600.0, (1.2, 0.3, -0.4, -0.5, 0.6, 1.1), (-0.35, -0.3, -0.15, 0.2, 0.3, 0.3), 0.005),
    Mode(9.0, 450.0, (-1.1, 0.5, 0.7, -0.6, 0.4, 1.2), (0.5, 0.4, -0.2, -0.3, 0.4, 0.45), 0.005),
)
PARTS = Parts(pitch=MODES, yaw=MODES)
STILL: Tree = {
    "atmosphere": {"model": "constant", "density_kgpm3": DENSITY, "pressure_Pa": 5e4, "temperature_K": 280.0},
    "initial": {"ned_mps": [SPEED, 0.0, 0.0]},
}


def tree_of(lag_m: float | None = LAG_M, **sections: Any) -> Tree:
    parts = [{"table": [{"mach": 0.0, "CN_alpha_pr": cn, "station_m": x}]} for cn, x, _ in SURFACES]
    aero: Tree = {"surface": parts} | ({} if lag_m is None else {"lag_m": lag_m})
    return with_stage(scenario_of(PARTS, **merged(STILL, sections)), aero=aero)


def matrix(lag_m: float = LAG_M) -> Array:
    """Return d/dt of (w, q, eta_1, eta_1', eta_2, eta_2', lagged eta_1), for small motions at constant speed."""
    a = np.zeros((7, 7))
    a[0, 1] = SPEED
    a[6, [2, 6]] = np.array([1.0, -1.0]) * SPEED / lag_m
    for k, mode in enumerate(MODES):
        omega = 2.0 * np.pi * mode.frequency_hz
        a[2 + 2 * k, 3 + 2 * k] = 1.0
        a[3 + 2 * k, 2 + 2 * k : 4 + 2 * k] = -omega * omega, -2.0 * mode.zeta * omega
    for cn, x, at in SURFACES:
        flow = np.zeros(7)  # lateral flow at the surface
        flow[0] = 1.0
        flow += SPEED * MODES[0].slope_pm[at] * np.eye(7)[6] + MODES[0].phi[at] * a[6]
        flow[4:6] += SPEED * MODES[1].slope_pm[at], MODES[1].phi[at]
        force = -0.5 * DENSITY * AREA * cn * SPEED * flow
        a[0] += force / MASS_KG
        a[1] -= (CG_M - x) * force / INERTIA
        for k, mode in enumerate(MODES):
            a[3 + 2 * k] += mode.phi[at] * force / mode.mass_kg
    return a


NAMES = {
    "pitch": ("w_mps", "q_radps", "eta_1_m", "eta_1_rate_mps", "eta_2_m", "eta_2_rate_mps", "air_lag_1_pitch_m"),
    "yaw": ("v_mps", "r_radps", "xi_1_m", "xi_1_rate_mps", "xi_2_m", "xi_2_rate_mps", "air_lag_1_yaw_m"),
}
SIGNS = {"pitch": np.ones(7), "yaw": np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0, 1.0])}


def at_start(made: Rig) -> Array:
    out = np.zeros(layout.MAX_STATE)
    out[: made.n] = made.y
    return out


@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_the_linear_model_is_the_one_written_out(plane: str) -> None:
    made = rig(tree_of())
    model = linearise(made.packed, at_start(made), 0.0)
    at = [model.states.index(name) for name in NAMES[plane]]
    ours = SIGNS[plane][:, None] * model.a[np.ix_(at, at)] * SIGNS[plane]
    theirs = matrix()
    assert ours == pytest.approx(theirs, rel=1e-8, abs=1e-9 * np.abs(theirs).max())


@pytest.mark.parametrize("plane", ["pitch", "yaw"])
def test_the_plant_of_a_plane_has_the_poles(plane: str) -> None:
    packed = pack_flight(load(merged(tree_of(), {"earth": {"gravity": "uniform"}})).scenario)
    poles = node_of(packed, 0.0, plane=plane).plant.poles()
    for pole in np.linalg.eigvals(matrix()):
        assert np.abs(poles - pole).min() < 1e-5 * (1.0 + abs(pole))


def test_both_planes_fly_as_the_exponential() -> None:
    """The amplitude of 1e-7 m leaves products of the motions at 1e-7 of it."""
    made = rig(tree_of(run={"step_s": 0.0005}))
    model = linearise(made.packed, at_start(made), 0.0)
    indices = {
        "pitch": (int(layout.eta_index(made.sizes)), layout.W_BI_B + 1, 0),
        "yaw": (int(layout.xi_index(made.sizes)), layout.W_BI_B + 2, 1),
    }
    late = int(layout.air_lag_index(made.sizes))
    start = np.array([0.0, 0.0, 1e-7, 2e-6, -1e-7, 0.0, 0.5e-7])
    for first, _, k in indices.values():
        made.y[first : first + 2], made.y[first + 2 : first + 4] = start[[2, 4]], start[[3, 5]]
        made.y[late + k] = start[6]
    states = flown(made, 0.5, 0.05)
    for plane, (first, turning, k) in indices.items():
        expected = np.array([expm(matrix() * t) @ start for t in 0.05 * np.arange(11)])
        for ours, column in (
            (SIGNS[plane][1] * states[:, turning], 1),
            (states[:, first], 2),
            (states[:, first + 2], 3),
            (states[:, first + 1], 4),
            (states[:, late + k], 6),
        ):
            assert ours == pytest.approx(expected[:, column], abs=1e-4 * np.abs(expected[:, column]).max())
    assert model.a.shape[0] == made.n - 1  # the quaternion has three coordinates


def test_the_force_of_a_moved_mode_lags() -> None:
    """The force of one surface on eta = exp(i w t) is the quasi-steady one over 1 + i w L / V."""
    a, w = matrix(), 2.0 * np.pi * 4.0
    late = 1.0 / (1.0 + 1j * w * LAG_M / SPEED)
    made = rig(tree_of())
    quasi = rig(tree_of(None))
    model, plain = (linearise(x.packed, at_start(x), 0.0) for x in (made, quasi))
    row = ("w_mps", "eta_1_m", "eta_1_rate_mps", "air_lag_1_pitch_m")
    w_row, eta, rate, lagged = (model.states.index(name) for name in row)
    ours = model.a[w_row, eta] + 1j * w * model.a[w_row, rate] + late * model.a[w_row, lagged]
    w_row, eta, rate = (plain.states.index(name) for name in row[:3])
    theirs = late * (plain.a[w_row, eta] + 1j * w * plain.a[w_row, rate])
    assert ours == pytest.approx(theirs, rel=1e-9)
    assert abs(a[0, 6]) > 0.1


def test_the_force_in_any_motion_is_that_of_a_vehicle_with_the_lagged_modes() -> None:
    """A vehicle without lag has the same forces if its first modes have the lagged displacement and quasi-velocity."""
    made, quasi = rig(tree_of()), rig(tree_of(None))
    y = made.y.copy()
    y[layout.W_BI_B : layout.W_BI_B + 3] = 2.0, 0.1, -0.2
    y[layout.V_I : layout.V_I + 3] = SPEED, 8.0, -5.0
    first, late = int(layout.eta_index(made.sizes)), int(layout.air_lag_index(made.sizes))
    modal = np.array([0.02, -0.01, 0.5, 0.3, 0.015, 0.02, -0.4, 0.2])  # eta, their rates, xi, their rates
    y[first : first + 8], y[late : late + 2] = modal, (0.012, -0.007)
    made.derivative(y)
    speed = made.aux.air.airspeed_mps
    eta, xi, roll_radps = y[late], y[late + 1], 2.0
    rates = speed / LAG_M * (modal[[0, 4]] - [eta, xi])
    there = np.delete(y, [late, late + 1])
    there[[first, first + 4]] = eta, xi
    there[[first + 2, first + 6]] = rates[0] + roll_radps * xi, rates[1] - roll_radps * eta
    quasi.derivative(there)
    assert made.aux.aero_force_B_N == pytest.approx(quasi.aux.aero_force_B_N, rel=1e-12)
    assert made.aux.aero_moment_B_Nm == pytest.approx(quasi.aux.aero_moment_B_Nm, rel=1e-12)
    still = quasi.derivative(np.delete(y, [late, late + 1]))
    assert np.abs(quasi.aux.aero_force_B_N[1:] / made.aux.aero_force_B_N[1:] - 1.0).min() > 0.01
    assert len(still) == len(y) - 2


def test_short_lags_are_quasi_steady_and_long_ones_leave_no_force() -> None:
    made = rig(tree_of(None))
    quasi = linearise(made.packed, at_start(made), 0.0)
    at = [quasi.states.index(name) for name in NAMES["pitch"][:6]]
    poles = np.linalg.eigvals(quasi.a[np.ix_(at, at)])
    short = np.linalg.eigvals(matrix(0.003))
    assert all(np.abs(short - pole).min() < 2e-3 * (1.0 + abs(pole)) for pole in poles)
    long = np.linalg.eigvals(matrix(1e7))
    free = 2.0 * np.pi * 4.0 * (-0.005 + 1j * np.sqrt(1.0 - 0.005**2))
    assert np.abs(long - free).min() < 1e-2 * abs(free)
    assert min(np.abs(poles - free)) > 0.02 * abs(free)


def test_a_lag_too_short_for_the_step_ends_the_flight_with_its_cause() -> None:
    """With V h / L = 6 the method multiplies the lag by 31 in each whole step."""
    run = rig(tree_of(0.1, run={"step_s": 0.002}, initial={"ned_mps": [SPEED, 5.0, 5.0]})).run()
    while not run.finished:
        run.fly_segment()
    result = run.result()
    assert result.outcome == "diverged"
    assert "aero.lag_m is too short for run.step_s" in result.cause


def test_a_lag_needs_planar_modes() -> None:
    tree = tree_of()
    del tree["vehicle"]["stage"][0]["bending"]
    with pytest.raises(ScenarioError, match="the stage has no planar modes"):
        load(tree)
