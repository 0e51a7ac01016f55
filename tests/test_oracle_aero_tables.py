"""Coefficients over angle of attack equal SciPy's interpolation with rotation matrices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from aero_tables import (
    MODES,
    OVER_ALPHA_BETA,
    OVER_TOTAL,
    PARTS,
    RATES,
    REFERENCE,
    STABILITY,
    WIND_PLANE,
    burning,
    flying,
)
from flightkit import Rig, Tree
from scipy.interpolate import PchipInterpolator, RegularGridInterpolator

from maxq.control.kernel.grids import GridRefs, fit_grid, grid_in, interpolate_grid
from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import Array, pack
from maxq.control.kernel.tables import Pool
from maxq.sim.vehicle.state import eta_index, xi_index

_interpolate_grid = from_python(interpolate_grid)
X = (np.array([0.0, 0.3, 0.9, 1.6]), np.array([0.0, 0.1, 0.5, np.pi]), np.array([-1.0, 0.5, 2.0, 2 * np.pi - 1.0]))
VALUES = np.random.default_rng(7).normal(size=(4, 4, 4, 3))
VALUES[:, :, -1] = VALUES[:, :, 0]
PARITY = np.array([1.0, -1.0, 1.0])
VALUES[:, [0, -1], :, 1] = 0.0
POINTS = np.random.default_rng(8).uniform([-0.3, 0.0, -1.0], [2.0, np.pi, 2 * np.pi - 1.0], (40, 3))


def grids(smooth: bool):
    return fit_grid(X, VALUES, smooth, ("open", "mirror", "periodic"), PARITY)


# --- interpolation
def test_multilinear_is_scipys() -> None:
    theirs = RegularGridInterpolator(X, VALUES)(np.clip(POINTS, [b[0] for b in X], [b[-1] for b in X]))
    np.testing.assert_allclose([grids(False)(p) for p in POINTS], theirs, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("smooth", [False, True])
def test_kernel_reads_what_is_packed(smooth: bool) -> None:
    made, pool = grids(smooth), Pool()
    pool.put(np.zeros(5))
    at = np.zeros((8, 6), np.int64)
    at[2] = pool.put(*made.breaks, made.nodes), 4, 4, 4, 3, made.nodes.shape[3]
    refs, out = pack([GridRefs(at)])[0], np.zeros(5)
    np.testing.assert_array_equal(grid_in(pool.array(), at[2]).nodes, made.nodes)
    for point in POINTS:
        _interpolate_grid(pool.array(), refs, 2, *point, out, 1)
        np.testing.assert_allclose(out[1:4], made(point), rtol=1e-12, atol=1e-12)


def test_smooth_grid_is_pchip_along_its_lines() -> None:
    """Between two nodes only the changing variable counts; mirrored and periodic ends have data beyond them."""
    made, mach = grids(True), np.linspace(0.0, 1.6, 33)
    ours = [made((m, X[1][2], X[2][1])) for m in mach]
    np.testing.assert_allclose(ours, PchipInterpolator(X[0], VALUES[:, 2, 1])(mach), rtol=1e-12, atol=1e-12)
    total = np.concatenate([-X[1][1:2], X[1], 2 * np.pi - X[1][-2:-1]])
    mirrored = np.concatenate([PARITY * VALUES[1, 1:2, 2], VALUES[1, :, 2], PARITY * VALUES[1, -2:-1, 2]])
    at = np.linspace(0.0, np.pi, 41)
    np.testing.assert_allclose(
        [made((X[0][1], t, X[2][2])) for t in at], PchipInterpolator(total, mirrored)(at), rtol=1e-12, atol=1e-12
    )
    roll = np.concatenate([X[2][-2:-1] - 2 * np.pi, X[2], X[2][1:2] + 2 * np.pi])
    round_about = np.concatenate([VALUES[1, 1, -2:-1], VALUES[1, 1], VALUES[1, 1, 1:2]])
    at = np.linspace(-1.0, 2 * np.pi - 1.0, 41)
    np.testing.assert_allclose(
        [made((X[0][1], X[1][1], r)) for r in at], PchipInterpolator(roll, round_about)(at), rtol=1e-12, atol=1e-12
    )


def test_smooth_grid_is_straight_between_two_nodes() -> None:
    """Two points in any variable define a line; the third node of the other axes changes nothing."""
    for axis in range(3):
        breaks = [b[:2] if k == axis else b[:1] for k, b in enumerate(X)]
        values = VALUES[tuple(slice(len(b)) for b in breaks)]
        made = fit_grid(breaks, values, True, ("open",) * 3, PARITY)
        low, high = breaks[axis]
        for share in (0.0, 0.2, 0.75, 1.0):
            at = np.array([b[0] for b in breaks])
            at[axis] = low + share * (high - low)
            first, last = values.reshape(2, 3)
            np.testing.assert_allclose(made(tuple(at)), first + share * (last - first), rtol=1e-12, atol=1e-13)
            slope = made(tuple(at), np.eye(3, dtype=int)[axis])
            np.testing.assert_allclose(slope, (last - first) / (high - low), rtol=1e-11)


@pytest.mark.parametrize("axis", range(3))
def test_smooth_grid_has_continuous_slopes(axis: int) -> None:
    made, order = grids(True), np.eye(3, dtype=int)
    for node in X[axis][1:-1]:
        for point in POINTS[:8]:
            below, above = point.copy(), point.copy()
            below[axis], above[axis] = np.nextafter(node, -9.0), node
            for k in range(3):
                np.testing.assert_allclose(made(below, order[k]), made(above, order[k]), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("smooth", [False, True])
def test_derivatives_are_those_of_the_interpolant(smooth: bool) -> None:
    made = grids(smooth)
    for point in POINTS:
        for axis in range(3):
            order = np.eye(3, dtype=int)[axis]
            step = 1e-6 * order
            if min(abs(point[axis] - node) for node in X[axis]) > 1e-5:
                numerical = (made(point + step) - made(point - step)) / 2e-6
                np.testing.assert_allclose(made(point, order), numerical, rtol=1e-6, atol=1e-7)


def test_derivatives_of_products_are_reproduced() -> None:
    """x y z is trilinear, and both methods reproduce it exactly."""
    product = (X[0][:, None, None] * X[1][None, :, None] * X[2][None, None, :])[..., None]
    for smooth in (False, True):
        made = fit_grid(X, product, smooth, ("open",) * 3, np.ones(1))
        inside = np.clip(POINTS, [b[0] for b in X], [b[-1] for b in X])
        np.testing.assert_allclose([made(p)[0] for p in inside], inside.prod(axis=1), rtol=1e-12, atol=1e-12)


# --- forces and moments
def looked_up(columns: Tree, axes: list[str], point: list[float]) -> dict[str, float]:
    """Return SciPy's multilinear interpolation of a long-format table; roll angles are wrapped by hand."""
    columns = {name: np.asarray(values, float) for name, values in columns.items()}
    if "roll_deg" in axes:
        k, first = axes.index("roll_deg"), columns["roll_deg"].min()
        again = columns["roll_deg"] == first
        columns = {n: np.concatenate([v, v[again] + (360.0 if n == "roll_deg" else 0.0)]) for n, v in columns.items()}
        point = [*point]
        point[k] = (point[k] - first) % 360.0 + first
    order = np.lexsort([columns[name] for name in reversed(axes)])
    breaks = [np.unique(columns[name]) for name in axes]
    shape = [len(b) for b in breaks]
    point = [float(np.clip(x, b[0], b[-1])) for x, b in zip(point, breaks, strict=True)]
    names = [name for name in columns if name not in axes]
    return {n: float(RegularGridInterpolator(breaks, columns[n][order].reshape(shape))(point)[0]) for n in names}


def expected(columns: Tree, flow: Array, mach: float, factors: tuple[float, float] = (1.0, 1.0)) -> tuple[Array, Array]:
    """Return the static force and moment about the reference, in B. `factors`: axial, normal."""
    u, v, w = flow
    speed = float(np.linalg.norm(flow))
    total, roll = math.acos(u / speed), math.atan2(v, w)
    angles = {
        "mach": mach,
        "total_deg": math.degrees(total),
        "roll_deg": math.degrees(roll),
        "alpha_deg": math.degrees(math.atan2(w, u)),
        "beta_deg": math.degrees(math.asin(v / speed)),
    }
    axes = [name for name in angles if name in columns]
    c = {name: 0.0 for name in ("CX", "CY", "CZ", "Cl", "Cm", "Cn")} | looked_up(
        columns, axes, [angles[a] for a in axes]
    )
    c["CX"] -= c.get("CA", 0.0)
    c["CZ"] -= c.get("CN", 0.0)
    axial, normal = factors
    aeroballistic = "total_deg" in columns
    force = np.array([axial * c["CX"], normal * c["CY"], normal * c["CZ"]])
    if "CD" in columns or "CL" in columns:
        turn = total if aeroballistic else math.atan2(w, u)
        to_body = np.array([[math.cos(turn), 0, -math.sin(turn)], [0, 1, 0], [math.sin(turn), 0, math.cos(turn)]])
        force = force + to_body @ np.array([-axial * c.get("CD", 0.0), 0.0, -normal * c.get("CL", 0.0)])
    yaw_length = REFERENCE["chord_m"] if aeroballistic else REFERENCE["yaw_chord_m"]
    moment = normal * np.array([REFERENCE["span_m"] * c["Cl"], REFERENCE["chord_m"] * c["Cm"], yaw_length * c["Cn"]])
    if aeroballistic:  # from axes with z' towards (v, w): turned back about x
        to_body = np.array([[1, 0, 0], [0, math.cos(roll), math.sin(roll)], [0, -math.sin(roll), math.cos(roll)]])
        force, moment = to_body @ force, to_body @ moment
    flux = 0.5 * 0.9 * speed**2 * REFERENCE["area_m2"]
    return flux * force, flux * moment


def about_cg(force: Array, moment: Array, reference_m: float) -> Array:
    cg = np.array([-PARTS.core_cg[0], *PARTS.core_cg[1:]])
    return moment + np.cross(np.array([-reference_m, 0.0, 0.0]) - cg, force)


def loads(made: Rig) -> tuple[Array, Array]:
    made.derivative(made.y)
    return made.aux.aero_force_B_N.copy(), made.aux.aero_moment_B_Nm.copy()


FLOWS = ([300.0, 20.0, -35.0], [250.0, -90.0, 120.0], [-180.0, 60.0, 30.0], [5.0, 140.0, 130.0], [310.0, 0.0, 25.0])


@pytest.mark.parametrize("columns", [OVER_TOTAL, OVER_ALPHA_BETA, STABILITY, WIND_PLANE])
@pytest.mark.parametrize("flow", FLOWS)
def test_forces_and_moments(columns: Tree, flow: list[float]) -> None:
    aero = {
        "interpolation": "linear",
        "moment_reference_m": 6.2,
        "axial_factor": 1.2,
        "force_factor": 0.9,
        "coefficients": [{"table": columns}],
    }
    made = flying(aero, flow)
    force, moment = loads(made)
    ours = expected(columns, np.array(flow), float(made.aux.air.mach), (1.2, 0.9))
    scale = float(np.linalg.norm(ours[0]))
    np.testing.assert_allclose(force, ours[0], rtol=1e-11, atol=1e-11 * scale)
    np.testing.assert_allclose(moment, about_cg(*ours, 6.2), rtol=1e-11, atol=1e-10 * scale)


def test_tables_add_up_and_shift_moves_what_is_across() -> None:
    flow, shift = [300.0, 20.0, -35.0], 0.4
    all_of_them = [OVER_TOTAL, OVER_ALPHA_BETA]
    aero = {"interpolation": "linear", "moment_reference_m": 6.2, "coefficients": [{"table": t} for t in all_of_them]}
    made = flying(aero, flow)
    force, moment = loads(made)
    ours = [expected(t, np.array(flow), float(made.aux.air.mach)) for t in all_of_them]
    np.testing.assert_allclose(force, sum(f for f, _ in ours), rtol=1e-11)
    np.testing.assert_allclose(moment, sum(about_cg(f, m, 6.2) for f, m in ours), rtol=1e-11)
    _, shifted = loads(flying(aero | {"centre_shift_m": shift}, flow))
    np.testing.assert_allclose(shifted - moment, [0.0, shift * force[2], -shift * force[1]], rtol=1e-9, atol=1e-7)


def test_derivatives_by_body_rates() -> None:
    flow, rate = np.array([300.0, 20.0, -35.0]), np.array([0.3, -0.2, 0.15])
    aero = {
        "interpolation": "linear",
        "moment_reference_m": 6.2,
        "damping_factor": 1.5,
        "coefficients": [{"table": RATES}],
    }
    made = flying(aero, [*flow])
    made.y[10:13] = rate
    force, moment = loads(made)
    c = looked_up(RATES, ["mach", "alpha_deg"], [float(made.aux.air.mach), math.degrees(math.atan2(flow[2], flow[0]))])
    speed = float(np.linalg.norm(flow))
    lengths = np.array([REFERENCE["span_m"], REFERENCE["chord_m"], REFERENCE["yaw_chord_m"]])
    p, q, r = rate * lengths / (2.0 * speed)
    flux = 1.5 * 0.5 * 0.9 * speed**2 * REFERENCE["area_m2"]
    ours = flux * np.array([0.0, c["CYp"] * p + c["CYr"] * r, -c["CNq"] * q])
    turning = flux * lengths * np.array([c["Clp"] * p + c["Clr"] * r, c["Cmq"] * q, c["Cnp"] * p + c["Cnr"] * r])
    np.testing.assert_allclose(force, ours, rtol=1e-11, atol=1e-9)
    np.testing.assert_allclose(moment, about_cg(ours, turning, 6.2), rtol=1e-11)


def test_force_is_continuous_where_the_plane_of_incidence_is_undefined() -> None:
    for method in ("linear", "pchip"):
        coefficients = [{"table": OVER_TOTAL, "interpolation": method}]
        along = loads(flying({"coefficients": coefficients}, [300.0, 0.0, 0.0]))
        for direction in np.linspace(0.0, 2.0 * np.pi, 7):
            flow = [300.0, 1e-9 * math.sin(direction), 1e-9 * math.cos(direction)]
            beside = loads(flying({"coefficients": coefficients}, flow))
            for a, b in zip(along, beside, strict=True):
                np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-4)


@pytest.mark.parametrize("burning", [0, 1])
def test_power_on_and_off(burning: int) -> None:
    flow = [300.0, 20.0, -35.0]
    tables = {"always": OVER_ALPHA_BETA, "on": STABILITY, "off": WIND_PLANE}
    made = flying(
        {"interpolation": "linear", "coefficients": [{"table": t, "power": k} for k, t in tables.items()]}, flow
    )
    made.derivative(made.y)
    made.held.burning = burning
    force, _ = loads(made)
    acting = ["always", "on" if burning else "off"]
    ours = [expected(tables[k], np.array(flow), float(made.aux.air.mach))[0] for k in acting]
    np.testing.assert_allclose(force, sum(ours), rtol=1e-11)


def test_floor_on_airspeed() -> None:
    aero = {"coefficients": [{"table": OVER_TOTAL}], "airspeed_floor_mps": 50.0}
    assert np.linalg.norm(loads(flying(aero, [49.0, 9.0, 0.0]))[0]) == 0.0  # 49.8 m/s
    assert np.linalg.norm(loads(flying(aero, [50.0, 9.0, 0.0]))[0]) > 0.0


@pytest.mark.parametrize("key", ["moment_reference_over_time", "moment_reference_over_mass"])
def test_moment_reference_moves(key: str) -> None:
    """The reference follows the mass: 3800 kg at 4 s of a burn from 4200 to 3200 kg in 10 s.

    Slopes with Cm_alpha_pr use the same reference.
    """
    flow = [300.0, 20.0, -35.0]
    reference = {
        "moment_reference_over_time": {"time_s": [0.0, 10.0], "station_m": [6.0, 7.0]},
        "moment_reference_over_mass": {"mass_kg": [3000.0, 4000.0], "station_m": [7.2, 6.2]},
    }[key]
    slopes = {"mach": [0.0], "CN_alpha_pr": [3.0], "Cm_alpha_pr": [-2.0]}
    burn = {"mass_kg": 4200.0, "mass_flow_kgps": 100.0, "burn_s": 10.0}

    def moment(**reference_key: Any) -> Array:
        aero = {"interpolation": "linear", "table": slopes, "coefficients": [{"table": STABILITY}]}
        stage = {"interpolation": "linear", "aero": aero | reference_key}
        made = burning(stage, burn, flow)
        made.derivative(made.y, 4.0)
        return made.aux.aero_moment_B_Nm.copy()

    np.testing.assert_allclose(moment(**{key: reference}), moment(moment_reference_m=6.4), rtol=1e-12)
    assert abs(moment(moment_reference_m=6.41)[1] / moment(moment_reference_m=6.4)[1] - 1.0) > 1e-4


# --- on the bent body
def test_bent_body_feels_and_is_bent_by_the_local_flow() -> None:
    """Generalised forces equal the work of the resultant, and the local flow is that of a turned and moving body."""
    flow = np.array([300.0, 20.0, -35.0])
    switches = {"bending_softening": False}
    aero = {
        "interpolation": "linear",
        "moment_reference_m": 6.2,
        "coefficients": [{"table": OVER_ALPHA_BETA, "station_m": 5.0}],
    }
    made, still = (
        flying(aero, [*flow], switches=switches),
        flying({"table": {"mach": [0.0]}}, [*flow], switches=switches),
    )
    eta, nu, xi, nu_yaw = np.array([0.02, -0.01]), np.array([0.4, 0.3]), np.array([-0.015, 0.01]), np.array([-0.3, 0.2])
    sizes = made.sizes
    for one in (made, still):
        one.y[eta_index(sizes) : eta_index(sizes) + 4] = [*eta, *nu]
        one.y[xi_index(sizes) : xi_index(sizes) + 4] = [*xi, *nu_yaw]
    phi, slope = (np.array([getattr(mode, name)[2] for mode in MODES]) for name in ("phi", "slope_pm"))
    local = flow + np.array([0.0, flow[0] * slope @ xi + phi @ nu_yaw, flow[0] * slope @ eta + phi @ nu])
    force, _ = loads(made)
    rate = made.derivative(made.y) - still.derivative(still.y)
    ours, moment = expected(OVER_ALPHA_BETA, local, float(made.aux.air.mach))
    np.testing.assert_allclose(force, ours, rtol=1e-11)
    couple = moment + np.cross([5.0 - 6.2, 0.0, 0.0], [0.0, ours[1], ours[2]])
    masses = np.array([mode.mass_kg for mode in MODES])
    first = eta_index(sizes)
    np.testing.assert_allclose(rate[first + 2 : first + 4] * masses, phi * ours[2] + slope * couple[1], rtol=1e-9)
    first = xi_index(sizes)
    np.testing.assert_allclose(rate[first + 2 : first + 4] * masses, phi * ours[1] - slope * couple[2], rtol=1e-9)


def test_table_of_a_slope_is_the_slope() -> None:
    """CN = CN_alpha sin(2 alpha) / 2 has the force of the slopes, -k CN_alpha U W, at the same station of the modes."""
    total = np.linspace(0.0, 90.0, 361)
    columns = {"total_deg": total, "CN": 3.0 * np.sin(np.radians(total)) * np.cos(np.radians(total))}
    by_table = {"interpolation": "pchip", "moment_reference_m": 5.0, "coefficients": [{"table": columns}]}
    by_slope = {"table": {"mach": [0.0], "CN_alpha_pr": [3.0], "x_cp_m": [5.0]}}
    ours, theirs = (flying(aero, [300.0, 20.0, -35.0]) for aero in (by_table, by_slope))
    for a, b in zip(loads(ours), loads(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=2e-6, atol=1e-6)
    np.testing.assert_allclose(ours.derivative(ours.y), theirs.derivative(theirs.y), rtol=3e-6, atol=1e-9)


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["damps", "drives"])
def test_damping_with_the_mass_properties(sign: float) -> None:
    rates = np.array([0.3, -0.2, 0.15])
    table_of = {"time_s": [0.0, 10.0], "x_Nms": [10.0, 30.0], "y_Nms": [100.0, 500.0], "z_Nms": [200.0, 0.0]}

    def turning(**mass: Any) -> Array:
        made = burning({"interpolation": "linear"}, mass, [0.0, 0.0, 0.0])
        made.y[10:13] = rates
        return made.derivative(made.y, 2.5)[10:13]

    for axis in ("x_Nms", "y_Nms", "z_Nms"):
        table_of[axis] = [sign * value for value in table_of[axis]]
    given, without = turning(rate_damping=table_of), turning()
    moment = np.array(PARTS.core_inertia) @ (given - without)
    np.testing.assert_allclose(moment, -sign * np.array([15.0, 200.0, 150.0]) * rates, rtol=1e-9)
