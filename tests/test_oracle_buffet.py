"""Buffet against closed forms, SciPy and sums written out here.

| what | against |
|---|---|
| spectrum of the packed filters | the table, and a Lyapunov equation of a mode behind a coloured noise |
| spectrum of the force over 400 s | the table, by Welch's method |
| mean square of two modes over 400 s | the Lyapunov equation |
| motion of modes and rigid body under the force of one flight | SciPy's integration of the same force |
| force between Mach numbers, and over dynamic pressure | the force of one Mach number |
| section loads | the sum of the forces forward of the cut |
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from flightkit import Mode, Parts, Rig, Tree, flown, load, merged, rig, scenario_of, with_stage
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline
from scipy.linalg import solve_continuous_lyapunov
from scipy.signal import welch
from test_oracle_spatial_modes import AIR, as_spatial

from maxq import ScenarioError
from maxq.control.kernel.records import Array
from maxq.design.model.linearised import at_rest, linearise
from maxq.sim.run.evaluate import evaluate_at
from maxq.sim.vehicle import state as layout

# (Hz, kg, phi, slope, zeta): shapes at 0, 3, 5, 10, 12, 14 m
SHAPES = (
    Mode(4.0, 600.0, (1.2, 0.3, -0.4, -0.5, 0.6, 1.1), (-0.35, -0.3, -0.15, 0.2, 0.3, 0.3), 0.06),
    Mode(9.0, 450.0, (-1.1, 0.5, 0.7, -0.6, 0.4, 1.2), (0.5, 0.4, -0.2, -0.3, 0.4, 0.45), 0.05),
)
PARTS = Parts(pitch=SHAPES, yaw=SHAPES, core_cg=(7.0, 0.04, -0.07))
PLACES_m = (3.0, 10.0)
AT = (1, 3)  # of PLACES_m in the shapes
FILTER_HZ, FILTER_ZETA, LEVEL = 6.0, 0.4, (900.0, 400.0)  # coloured noise: N2/Hz at low frequencies
HZ = np.concatenate([[0.02], np.linspace(0.1, 20.0, 140), np.linspace(20.5, 50.0, 50)])


def coloured(f: Array) -> Array:
    """Return the spectrum of unit white noise behind an oscillator."""
    x = f / FILTER_HZ
    return np.asarray(1.0 / ((1.0 - x * x) ** 2 + (2.0 * FILTER_ZETA * x) ** 2))


def rows(name: str = "force_psd_N2pHz", mach: tuple[float, ...] = (0.0,), gain: tuple[float, ...] = (1.0,)) -> Tree:
    """Return the table over two stations, times the gains of the Mach numbers."""
    out: dict[str, list[float]] = {key: [] for key in ("mach", "frequency_hz", "station_m", name)}
    for m, factor in zip(mach, gain, strict=True):
        for place, level in zip(PLACES_m, LEVEL, strict=True):
            for f, value in zip(HZ, level * factor * coloured(HZ), strict=True):
                for key, number in zip(out, (m, f, place, value), strict=True):
                    out[key].append(number)
    return out


def shaken(parts: Parts = PARTS, table: Tree | None = None, stage: Tree | None = None, **sections: Any) -> Rig:
    given = {"buffet": {"table": rows() if table is None else table}} | (stage or {})
    return rig(with_stage(scenario_of(parts, **sections), **given))


def forces(made: Rig, times_s: Array) -> Array:
    """Return the force along z and y of each station (times, stations, 2)."""
    out = []
    for t in times_s:
        made.derivative_within(made.y, round(1e9 * t), 0.0)
        out.append(made.aux.buffet_N[:4].copy())
    return np.array(out).reshape(len(times_s), 2, 2)


@pytest.fixture(scope="module")
def record() -> tuple[float, Array]:
    """Return the sample period, s, and the forces over 400 s."""
    return 0.004, forces(shaken(), 0.004 * np.arange(100_000))


def mean_square(mode: Mode) -> float:
    """Return the stationary mean square of a mode behind the coloured noise, by the Lyapunov equation.

    A two-sided density s of white noise corresponds to the one-sided density 2 s.
    """
    w, w_f = 2.0 * np.pi * mode.frequency_hz, 2.0 * np.pi * FILTER_HZ
    a = np.zeros((4, 4))
    a[0, 1] = a[2, 3] = 1.0
    a[1, :2] = -w * w, -2.0 * mode.zeta * w
    a[3, 2:] = -w_f * w_f, -2.0 * FILTER_ZETA * w_f
    a[1, 2] = 1.0 / mode.mass_kg
    b = np.array([0.0, 0.0, 0.0, w_f * w_f])
    driven = sum(level * mode.phi[k] ** 2 for level, k in zip(LEVEL, AT, strict=True))
    return float(solve_continuous_lyapunov(a, -0.5 * driven * np.outer(b, b))[0, 0])


def packed_density(made: Rig, f: Array) -> Array:
    """Return the one-sided spectrum of each station's force from the packed taps (stations, frequencies)."""
    b, tick_s = made.vehicle.buffet, 1e-9 * int(made.vehicle.buffet.tick_ns)
    count = 257
    taps = made.packed.pool[int(b.taps) : int(b.taps) + 2 * count].reshape(2, count)
    gain = taps[:, :1] + 2.0 * taps[:, 1:] @ np.cos(2.0 * np.pi * tick_s * np.outer(np.arange(1, count), f))
    return np.asarray(2.0 * tick_s * gain**2 * np.sinc(f * tick_s) ** 8)


def test_the_filters_have_the_spectrum_of_the_table() -> None:
    """The filters resolve 0.5 Hz, a hundredth of the highest frequency, and smooth the ends of the table over 2 Hz."""
    f = np.linspace(2.2, 45.0, 300)
    found = packed_density(shaken(), f)
    assert found == pytest.approx(np.outer(LEVEL, coloured(f)), rel=0.005)


def test_the_packed_noise_excites_modes_as_the_lyapunov_equation_says() -> None:
    """The integral over the packed spectrum has no statistical error; the rest is that of the window."""
    f = np.linspace(0.01, 60.0, 120_000)
    density = packed_density(shaken(), f)
    for mode in SHAPES:
        w, w_0 = 2.0 * np.pi * f, 2.0 * np.pi * mode.frequency_hz
        response = 1.0 / (mode.mass_kg * np.abs(w_0**2 - w**2 + 2j * mode.zeta * w_0 * w)) ** 2
        driven = sum(density[s] * mode.phi[k] ** 2 for s, k in enumerate(AT))
        assert np.trapezoid(driven * response, f) == pytest.approx(mean_square(mode), rel=0.005)


def test_the_force_has_the_spectrum_of_the_table(record: tuple[float, Array]) -> None:
    """Welch's estimate of a band of n bins in m segments of two planes has an error of about 1 / sqrt(2 n m)."""
    tick_s, found = record
    f, density = welch(found, 1.0 / tick_s, nperseg=2048, axis=0)
    for station, level in enumerate(LEVEL):
        mean = density[:, station].mean(axis=1)
        for low, high in ((1.0, 3.0), (3.0, 5.0), (5.0, 7.0), (7.0, 11.0), (11.0, 18.0), (18.0, 40.0)):
            band = (f >= low) & (f < high)
            error = 1.0 / math.sqrt(2.0 * band.sum() * (len(found) / 2048))
            assert mean[band].mean() == pytest.approx(level * coloured(f[band]).mean(), rel=0.02 + 3.0 * error)


def test_forces_of_stations_and_planes_are_independent(record: tuple[float, Array]) -> None:
    """The correlation of 400 s, with a memory of 0.1 s, is within 3 / sqrt(4000)."""
    found = record[1].reshape(len(record[1]), 4)
    apart = np.corrcoef(found.T) - np.eye(4)
    assert np.abs(apart).max() < 0.05
    level = math.sqrt(LEVEL[0] * np.trapezoid(coloured(HZ), HZ))
    assert found[:, 0].std() == pytest.approx(level, rel=0.05)
    assert np.mean((found[:, 0] / found[:, 0].std()) ** 4) == pytest.approx(3.0, abs=0.25)  # normal


def test_the_force_is_a_function_of_time_alone() -> None:
    times = 0.37 * np.arange(40)
    once, backwards = forces(shaken(), times), forces(shaken(), times[::-1])[::-1]
    assert np.array_equal(once, backwards)
    made = shaken()
    assert np.array_equal(forces(made, times)[20:], forces(made, times)[20:])
    assert not np.array_equal(once, forces(shaken(run={"seed": 5}), times))
    within = made.derivative_within(made.y, round(7.4e9) - 1_234_567, 1.234567e-3)
    assert within == pytest.approx(made.derivative_within(made.y, round(7.4e9), 0.0), abs=1e-9)


def test_modes_and_body_move_by_the_force() -> None:
    """SciPy integrates modes and rigid body under a force that is weak, as it does not integrate their roll."""
    parts, run = replace(PARTS, core_cg=(7.0, 0.0, 0.0)), {"step_s": 0.0005}
    made, fine = shaken(parts, rows(gain=(1e-6,)), run=run), 0.001 * np.arange(4005)
    force = CubicSpline(fine, forces(made, fine).reshape(-1, 4))
    states = flown(made, 4.0, 0.5)
    arms = np.array([PARTS.core_cg[0] - place for place in PLACES_m])

    def slopes(t: float, y: Array) -> Array:
        (z_1, y_1, z_2, y_2), out = force(t), []
        for k, mode in enumerate(SHAPES):
            w, phi = 2.0 * np.pi * mode.frequency_hz, np.array(mode.phi)[list(AT)]
            for plane, (first, second) in enumerate(((z_1, z_2), (y_1, y_2))):
                eta, rate = y[4 * k + 2 * plane : 4 * k + 2 * plane + 2]
                pushed = phi[0] * first + phi[1] * second
                out += [rate, pushed / mode.mass_kg - 2.0 * mode.zeta * w * rate - w * w * eta]
        return np.array([*out, -(arms @ [z_1, z_2]) / 5.0e4, (arms @ [y_1, y_2]) / 5.0e4])

    expected = solve_ivp(slopes, (0.0, 4.0), np.zeros(10), rtol=1e-10, atol=1e-13, t_eval=np.arange(0, 4.1, 0.5)).y.T
    eta, xi = int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))
    for k in range(2):
        assert states[:, eta + k] == pytest.approx(expected[:, 4 * k], abs=2e-6 * np.abs(expected[:, 4 * k]).max())
        assert states[:, xi + k] == pytest.approx(expected[:, 4 * k + 2], abs=2e-6 * np.abs(expected[:, 4 * k]).max())
    rates = states[:, layout.W_BI_B + 1 : layout.W_BI_B + 3]
    assert rates == pytest.approx(expected[:, 8:], abs=1e-5 * np.abs(expected[:, 8:]).max())


@pytest.mark.slow
def test_the_mean_square_of_modes_in_flight_is_that_of_the_lyapunov_equation() -> None:
    """A mean square over T, of two planes, has the relative error 1 / sqrt(2 zeta w T)."""
    made, duration_s = shaken(run={"step_s": 0.004, "duration_s": 500.0}), 400.0
    states = flown(made, duration_s, 0.02)[200:]
    eta, xi = int(layout.eta_index(made.sizes)), int(layout.xi_index(made.sizes))
    for k, mode in enumerate(SHAPES):
        found = 0.5 * float(np.mean(states[:, eta + k] ** 2) + np.mean(states[:, xi + k] ** 2))
        error = 1.0 / math.sqrt(2.0 * mode.zeta * 2.0 * np.pi * mode.frequency_hz * duration_s)
        assert found == pytest.approx(mean_square(mode), rel=3.0 * error)


def test_force_and_moment_act_at_the_stations_of_an_offset_body() -> None:
    made = shaken(Parts(core_cg=PARTS.core_cg))
    rate = made.derivative(made.y, 1.0)
    (z_1, y_1), (z_2, y_2) = made.aux.buffet_N[:4].reshape(2, 2)
    x, y, z = PARTS.core_cg
    assert rate[layout.V_I : layout.V_I + 3] * 4000.0 == pytest.approx([0.0, y_1 + y_2, z_1 + z_2], rel=1e-12)
    moment = [z * (y_1 + y_2) - y * (z_1 + z_2), -((x - 3.0) * z_1 + (x - 10.0) * z_2), (x - 3) * y_1 + (x - 10) * y_2]
    inertia = np.array([700.0, 5.0e4, 5.0e4])
    assert rate[layout.W_BI_B : layout.W_BI_B + 3] * inertia == pytest.approx(moment, rel=1e-12)


def test_spatial_modes_move_as_the_planar_ones() -> None:
    section, rest = as_spatial(PARTS)
    planar, spatial = shaken(), shaken(rest, stage={"spatial_modes": section})
    i, j = int(layout.eta_index(planar.sizes)), int(layout.xi_index(planar.sizes))
    k = int(layout.spatial_index(spatial.sizes))
    for time_s in (0.3, 2.0):
        once, other = planar.derivative(planar.y, time_s), spatial.derivative(spatial.y, time_s)
        assert np.abs(once[i + 2 : i + 4]).min() > 1e-3
        assert other[k + 4 : k + 8] == pytest.approx([once[n + m] for m in (2, 3) for n in (i, j)], rel=1e-9)
        assert other[: layout.GYRO] == pytest.approx(once[: layout.GYRO], rel=1e-12)


def test_force_follows_mach_number_and_dynamic_pressure() -> None:
    """The spectra of Mach 0 and Mach 1 have the ratio 9, so that the force at Mach m is (1 + 2 m) times the first."""
    plain, table = shaken(), rows("area_psd_m4pHz", (0.0, 1.0), (1.0, 9.0))
    air = shaken(table=table, **merged(AIR, {"vehicle": {"reference": {"area_m2": 0.8}}}))
    air.derivative(air.y, 3.0)
    mach, pressure = air.aux.air.mach, air.aux.air.dynamic_pressure_Pa
    assert 0.3 < mach < 0.9
    expected = pressure * (1.0 + 2.0 * mach) * forces(plain, np.array([3.0]))[0]
    assert air.aux.buffet_N[:4].reshape(2, 2) == pytest.approx(expected, rel=1e-9)


def test_section_loads_contain_the_forces() -> None:
    """A rigid body in empty space: the load at 5 m is the force at 3 m less the inertia of the mass forward of 5 m."""
    line = {"front_station_m": [0.0, 6.0], "rear_station_m": [14.0, 8.0], "mass_kg": [3000.0, 1000.0]}
    inertia = 3000.0 * 14.0**2 / 12.0 + 1000.0 * 2.0**2 / 12.0
    parts = Parts(core_inertia=((700.0, 0.0, 0.0), (0.0, inertia, 0.0), (0.0, 0.0, inertia)))
    made = shaken(
        parts, stage={"loads": {"stations_m": [5.0, 11.999], "line_mass": line}}, switches={"section_loads": True}
    )
    at = evaluate_at(made.packed, made.packed.state, 1.0)
    (z_1, y_1), (z_2, y_2) = at.aux.buffet_N[:4].reshape(2, 2)
    a_y, a_z = (y_1 + y_2) / 4000.0, (z_1 + z_2) / 4000.0
    q, r = -(4.0 * z_1 - 3.0 * z_2) / inertia, (4.0 * y_1 - 3.0 * y_2) / inertia
    forward, arm = 3000.0 * 5.0 / 14.0, 7.0 - 2.5  # mass forward of 5 m, and distance of its centre from the CG
    assert at.sections[0, 1:3] == pytest.approx([y_1 - forward * (a_y + arm * r), z_1 - forward * (a_z - arm * q)])
    second = 5.0**2 / 12.0
    bent = -2.0 * z_1 + forward * (a_z * 2.5 - q * (2.5 * arm + second))
    assert at.sections[0, 3] == pytest.approx(bent, rel=1e-9)
    behind = 3000.0 * 2.001 / 14.0  # mass aft of the second cut, which carries the rest
    assert at.sections[1, 1:3] == pytest.approx([behind * (a_y - 5.9995 * r), behind * (a_z + 5.9995 * q)], rel=1e-6)


def test_the_linear_model_is_without_the_force() -> None:
    tree, buffet = scenario_of(PARTS, **AIR), {"table": rows("area_psd_m4pHz")}
    rigs = rig(tree), rig(with_stage(tree, buffet=buffet))
    plain, made = (linearise(*at_rest(of.packed, 1.0), 1.0) for of in rigs)
    assert made.a == pytest.approx(plain.a, abs=1e-12)


def test_without_a_force_the_flight_keeps_its_bits() -> None:
    plain = flown(rig(scenario_of(PARTS)), 0.2)[-1]
    assert np.array_equal(flown(shaken(stage={"buffet": {"table": rows(), "factor": 0.0}}), 0.2)[-1], plain)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"station_m": [3.0, 3.0, 20.0, 20.0]}, "this station lies beyond the mode shapes"),
        ({"frequency_hz": [1.0, 2.0, 1.0, 3.0]}, "has 4 rows for 6 combinations"),
        ({"frequency_hz": [1.0, 1.0, 1.0, 1.0]}, "has 1 values of frequency_hz"),
        ({"force_psd_N2pHz": [1.0, 1.0, 1.0, -1.0]}, "force_psd_N2pHz.3 = -1.0: is negative"),
        ({"area_psd_m4pHz": [1.0, 1.0, 1.0, 1.0]}, "column area_psd_m4pHz cannot be combined with force_psd_N2pHz"),
    ],
)
def test_wrong_tables_are_rejected(changes: Tree, message: str) -> None:
    table: Tree = {
        "mach": [0.0] * 4,
        "frequency_hz": [1.0, 2.0, 1.0, 2.0],
        "station_m": [3.0, 3.0, 10.0, 10.0],
        "force_psd_N2pHz": [1.0] * 4,
    }
    with pytest.raises(ScenarioError) as raised:
        load(with_stage(scenario_of(PARTS), buffet={"table": table | changes}))
    assert "vehicle.stage.0.buffet" in str(raised.value)
    assert message in " ".join(str(raised.value).split())
