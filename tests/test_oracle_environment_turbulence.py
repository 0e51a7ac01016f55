"""Turbulence has its spectra in both frames, and equals the exact discretisation in 30 digits."""

from __future__ import annotations

import math

import mpmath
import numba
import numpy as np
import pytest
import scipy.signal
import scipy.spatial.transform

from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import blank, pack
from maxq.control.kernel.tables import Pool
from maxq.sim.packing.flight import pack_flight
from maxq.sim.scenario.loader import load_scenario, load_scenario_text
from maxq.sim.vehicle import environment as surroundings
from maxq.sim.vehicle.environment import AirData, Anchor
from maxq.sim.world.turbulence import (
    HORIZONTAL,
    VON_KARMAN,
    Turbulence,
    TurbulenceState,
    exceedance_table,
    intensity_table,
    scale_mixture,
    second_order_step,
    spectral_lines,
    turbulence_at,
    turbulence_start,
    turbulence_tick,
    turned_from_up,
)

FOOT_m = 0.3048

air_data, flight_direction = from_python(surroundings.air_data), from_python(surroundings.flight_direction)
SIGMA = (2.0, 3.0, 0.5)
LENGTH = (20.0, 30.0, 15.0)  # short, so that a run of minutes holds thousands of independent gusts
AIRSPEED = 100.0
TICKS = 2**14 if numba.config.DISABLE_JIT else 2**18  # every bound below follows the number of samples
SEGMENT = 4096


def setting(table, seed=1, **more):
    pool = Pool()
    ref = pool.add(table)
    return pack([Turbulence(1, ref, seed, **more)])[0], pool.array()


@numba.njit
def fly(turbulence, pool, state, airspeed, altitude, climb, along, out):
    turbulence_start(turbulence, pool, state, altitude, along)
    for i in range(len(out)):
        turbulence_tick(turbulence, pool, state, airspeed, altitude + climb * i, along)
        out[i, 0], out[i, 1], out[i, 2] = turbulence_at(state, 1.0)


UP = (0.0, 0.0, -1.0)


def history(seed, ticks=TICKS, airspeed=AIRSPEED, along=UP, **more):
    row, pool = setting(intensity_table(0.0, SIGMA, LENGTH), seed, **more)
    out = np.empty((ticks, 3))
    fly(row, pool, blank(TurbulenceState)[0], airspeed, 0.0, 0.0, along, out)
    return out


@pytest.fixture(scope="module")
def gusts():
    return history(seed=1)


def test_variance_and_mean(gusts):
    """Variance and mean agree; one independent sample takes at most 2 L / V seconds of correlation."""
    samples = TICKS * 0.01 * AIRSPEED / (2 * np.array(LENGTH))
    assert np.all(np.abs(gusts.mean(axis=0)) < 4 * np.array(SIGMA) / np.sqrt(samples))
    assert np.all(np.abs(gusts.var(axis=0) / np.square(SIGMA) - 1) < 4 * np.sqrt(2 / samples))


def dryden(f, sigma, length, longitudinal):
    """Return the one-sided spectral density over Hz, (m/s)^2/Hz, of MIL-F-8785C 3.7.1.2."""
    n = length / AIRSPEED
    x2 = (2 * math.pi * f * n) ** 2
    over_w = 2 * n / math.pi / (1 + x2) if longitudinal else n / math.pi * (1 + 3 * x2) / (1 + x2) ** 2
    return 2 * math.pi * sigma**2 * over_w


def von_karman(f, sigma, length, longitudinal):
    """Return the one-sided spectral density over Hz, (m/s)^2/Hz, of MIL-F-8785C 3.7.1.1."""
    n = length / AIRSPEED
    x2 = (1.339 * 2 * math.pi * f * n) ** 2
    u = 2 * n / math.pi * (1 + x2) ** (-5 / 6)
    v = n / math.pi * (1 + 8 / 3 * x2) * (1 + x2) ** (-11 / 6)
    return 2 * math.pi * sigma**2 * (u if longitudinal else v)


def assert_spectrum(gust, spectrum, sigma, length, longitudinal, share=0.0):
    """Compare the spectrum of a gust with the expected one in bands; `share` allows for the error of the model."""
    f, got = scipy.signal.welch(gust, fs=100.0, nperseg=SEGMENT)
    # sampling folds components above 50 Hz back, and the comparison must contain them
    expected = sum(spectrum(np.abs(f + 100.0 * k), sigma, length, longitudinal) for k in range(-400, 401))
    for low, high in [(0.1, 0.3), (0.3, 0.7), (0.7, 1.5), (1.5, 4.0), (4.0, 10.0), (10.0, 45.0)]:
        band = (f >= low) & (f < high)
        # half-overlapping Hann segments: 2 TICKS / SEGMENT of them, worth 0.53 independent ones each (Welch),
        # and every second bin of a Hann window is independent of the others
        error = 4 / math.sqrt(0.53 * 2 * TICKS / SEGMENT * max(1, band.sum() // 2))
        assert np.mean(got[band] / expected[band]) == pytest.approx(1.0, abs=error + share)


@pytest.mark.parametrize("component", [0, 1, 2])
def test_spectrum(gusts, component):
    assert_spectrum(gusts[:, component], dryden, SIGMA[component], LENGTH[component], component == 0)


@pytest.mark.parametrize("longitudinal", [True, False])
def test_von_karman_is_a_mixture_of_dryden_fields(longitudinal):
    """Both spectra agree from the longest wave to 40 Hz of a vehicle at 100 m/s with L = 533 m."""
    x = np.concatenate([[1e-4], np.geomspace(1e-2, 1500.0, 300)])
    f = x * AIRSPEED / (2 * math.pi * 1.339)  # L = 1
    fields = scale_mixture(VON_KARMAN)
    got = sum(
        fields["amplitude"][k] ** 2 * dryden(f, 1.0, 1.0 / fields["shorter"][k], longitudinal)
        for k in range(fields["scales"])
    )
    assert np.abs(got / von_karman(f, 1.0, 1.0, longitudinal) - 1.0).max() < 8e-3
    assert sum(fields["amplitude"][: fields["scales"]] ** 2) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.slow
def test_von_karman_spectra_of_a_long_sample():
    gusts = history(seed=5, **scale_mixture(VON_KARMAN))
    for component in range(3):
        at = SIGMA[component], LENGTH[component], component == 0
        assert_spectrum(gusts[:, component], von_karman, *at, share=0.03)  # above 400 images nothing is folded back
        samples = TICKS * 0.01 * AIRSPEED / (2 * LENGTH[component])
        assert abs(gusts[:, component].var() / SIGMA[component] ** 2 - 1) < 4 * np.sqrt(2 / samples)


NORTH_EAST_DOWN = (2.0, 2.0, 0.5), (30.0, 30.0, 15.0)


@pytest.mark.parametrize(
    ("along", "longitudinal"), [(UP, 2), ((1.0, 0.0, 0.0), 0), ((0.0, -1.0, 0.0), 1)], ids=["up", "north", "west"]
)
def test_horizontal_frame_has_the_intensity_of_the_axis_and_the_spectrum_of_the_direction(along, longitudinal):
    """A rising vehicle has longitudinal gusts vertically and lateral ones in both horizontal axes.

    sigma and L are those of the horizontal frame.
    """
    sigma, length = NORTH_EAST_DOWN
    row, pool = setting(intensity_table(0.0, sigma, length), 7, frame=HORIZONTAL)
    out = np.empty((TICKS, 3))
    fly(row, pool, blank(TurbulenceState)[0], AIRSPEED, 0.0, 0.0, along, out)
    for axis in range(3):
        assert_spectrum(out[:, axis], dryden, sigma[axis], length[axis], axis == longitudinal)
    samples = TICKS * 0.01 * AIRSPEED / (2 * max(length))
    assert np.abs(np.corrcoef(out.T) - np.eye(3)).max() < 4 / math.sqrt(samples)


def test_horizontal_frame_keeps_variances_and_independence_in_oblique_flight():
    along = tuple(np.array([0.48, -0.6, -0.64]))
    row, pool = setting(intensity_table(0.0, SIGMA, 20.0), 11, frame=HORIZONTAL)
    out = np.empty((TICKS, 3))
    fly(row, pool, blank(TurbulenceState)[0], AIRSPEED, 0.0, 0.0, along, out)
    samples = TICKS * 0.01 * AIRSPEED / 40.0
    assert np.abs(out.var(axis=0) / np.square(SIGMA) - 1).max() < 4 * np.sqrt(2 / samples)
    assert np.abs(np.corrcoef(out.T) - np.eye(3)).max() < 4 / math.sqrt(samples)


def test_near_the_ground_both_lateral_axes_of_a_rising_vehicle_are_horizontal():
    """At 10 m, MIL-F-8785C in body axes gives 1.54 m/s over 10 m in pitch; the right value is 2.92 m/s over 67 m."""
    table = exceedance_table("moderate")(10.0)
    assert table[:3] == pytest.approx([2.92, 2.92, 1.54], abs=5e-3)
    assert table[3:] == pytest.approx([66.6, 66.6, 10.0], abs=0.1)
    first = np.array([start_at(seed, 10.0) for seed in range(2000)])
    assert first.std(axis=0) == pytest.approx(table[:3], rel=4 / math.sqrt(2 * 2000))


def start_at(seed, altitude):
    row, pool = setting(exceedance_table("moderate"), seed, frame=HORIZONTAL)
    out = np.empty((1, 3))
    fly(row, pool, blank(TurbulenceState)[0], 50.0, altitude, 0.0, UP, out)
    return out[0]


@pytest.mark.parametrize("along", [UP, (1.0, 0.0, 0.0), (0.48, -0.6, -0.64), (0.48, -0.6, 0.64), (1e-3, 0.0, 1.0)])
def test_shortest_rotation_from_up(along):
    along = np.array(along) / np.linalg.norm(along)
    turn = np.cross([0.0, 0.0, -1.0], along)
    angle = math.atan2(float(np.linalg.norm(turn)), -along[2])
    axis = turn / max(float(np.linalg.norm(turn)), 1e-300)
    rotation = scipy.spatial.transform.Rotation.from_rotvec(angle * axis)
    for vector in np.eye(3):
        assert turned_from_up(tuple(along), tuple(vector)) == pytest.approx(tuple(rotation.apply(vector)), abs=1e-7)
    assert turned_from_up((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)) == (0.0, 0.0, 1.0)


def test_spectrum_over_altitude():
    """Variance in bands of wave number, over many seeds, equals the integral of the given spectrum."""
    waves, density = np.array([1 / 2000, 1 / 400, 1 / 20]), np.array([3000.0, 400.0, 0.5])
    altitude = np.arange(0.0, 40e3, 5.0)
    bands = [(1 / 2000, 1 / 800), (1 / 800, 1 / 200), (1 / 200, 1 / 60), (1 / 60, 1 / 20)]
    got, total = np.zeros((len(bands), 2)), np.zeros(2)
    seeds = 12
    for seed in range(seeds):
        row = pack([Turbulence(1, **spectral_lines(waves, density, seed))])[0]
        out = np.empty((len(altitude), 3))
        fly(row, np.zeros(1), blank(TurbulenceState)[0], 500.0, 0.0, 5.0, UP, out)
        assert (out[:, 2] == 0.0).all()
        total += out[:, :2].var(axis=0) / seeds
        for axis in range(2):
            f, power = scipy.signal.periodogram(out[:, axis], fs=1 / 5.0, window="hann")
            for b, (low, high) in enumerate(bands):
                got[b, axis] += power[(f >= low) & (f < high)].sum() * f[1] / seeds
    fine = np.geomspace(waves[0], waves[-1], 20001)
    over = np.exp(np.interp(np.log(fine), np.log(waves), np.log(density)))
    assert total == pytest.approx(np.trapezoid(over, fine), rel=2e-2)
    for b, (low, high) in enumerate(bands):
        inside = (fine >= low) & (fine < high)
        # a line may be on either side of a band's end: one of a dozen or more in it, in each of the flights
        assert got[b] == pytest.approx(np.trapezoid(over[inside], fine[inside]), rel=0.08)


def test_the_shipped_spectrum_is_its_formula():
    """The spectrum has its closed form, with 98.8 % of its variance between its ends."""
    loaded = load_scenario(
        "nominal", ("wind.turbulence={model='spectrum',spectrum='winds/small-scale-spectrum.csv',seed=4}",)
    )
    lines = pack_flight(loaded.scenario).parameters[0].environment.turbulence.line_mps
    share = 2.62 / 4.05  # integral of x^m / (1 + a x^n): pi a^(-(m + 1) / n) / (n sin(pi (m + 1) / n))
    variance = 683.4 / 4000.0 * np.pi * 0.0067**-share / (4.05 * np.sin(np.pi * share))
    assert np.sqrt(variance) == pytest.approx(1.94, abs=0.005)
    assert 0.5 * (lines**2).sum() == pytest.approx(variance, rel=2e-2)


def test_components_are_independent(gusts):
    samples = TICKS * 0.01 * AIRSPEED / (2 * max(LENGTH))
    correlation = np.corrcoef(gusts.T) - np.eye(3)
    assert np.abs(correlation).max() < 4 / math.sqrt(samples)


def test_seed_makes_the_field(gusts):
    assert np.array_equal(history(seed=1, ticks=500), gusts[:500])
    other = history(seed=2)
    samples = TICKS * 0.01 * AIRSPEED / (2 * max(LENGTH))
    for j in range(3):
        assert abs(np.corrcoef(gusts[:, j], other[:, j])[0, 1]) < 4 / math.sqrt(samples)


@pytest.mark.parametrize("theta", [0.0, 1e-8, 1e-4, 9.4e-3, 0.0499, 0.0501, 0.3, 2.0, 30.0])
def test_second_order_step_is_exact(theta):
    with mpmath.workdps(40):
        t = mpmath.mpf(theta)
        q = [
            mpmath.quad(lambda s, n=n: s**n * mpmath.exp(-2 * s), [0, t / 3, t]) if theta else mpmath.mpf(0)
            for n in range(3)
        ]
        l_11 = mpmath.sqrt(q[0])
        l_21 = q[1] / l_11 if theta else mpmath.mpf(0)
        expected = (mpmath.exp(-t), l_11, l_21, mpmath.sqrt(q[2] - l_21**2))
    assert second_order_step(theta) == pytest.approx(tuple(map(float, expected)), rel=2e-8)


def test_start_is_stationary():
    """Over many seeds, the first gust has the full variance: no spin-up is needed."""
    first = np.array([history(seed, ticks=1)[0] for seed in range(2000)])
    assert first.std(axis=0) == pytest.approx(np.array(SIGMA), rel=4 / math.sqrt(2 * 2000))


def test_still_vehicle_sees_a_frozen_gust():
    out = history(seed=3, ticks=50, airspeed=0.0)
    assert np.array_equal(out, np.broadcast_to(out[0], out.shape))
    assert np.all(out[0] != 0.0)


def test_linear_and_continuous_between_ticks():
    row, pool = setting(intensity_table(0.0, 1.0, 50.0))
    state = blank(TurbulenceState)[0]
    turbulence_start(row, pool, state, 0.0, UP)
    at_start = turbulence_at(state, 0.0)
    assert at_start == turbulence_at(state, 1.0)
    turbulence_tick(row, pool, state, 300.0, 0.0, UP)
    assert turbulence_at(state, 0.0) == at_start
    end = turbulence_at(state, 1.0)
    assert end != at_start
    assert turbulence_at(state, 0.25) == pytest.approx(
        tuple(0.75 * a + 0.25 * b for a, b in zip(at_start, end, strict=True))
    )
    turbulence_tick(row, pool, state, 300.0, 0.0, UP)
    assert turbulence_at(state, 0.0) == pytest.approx(end, abs=1e-15)


def test_off_is_calm():
    state = blank(TurbulenceState)[0]
    off = pack([Turbulence()])[0]
    turbulence_start(off, np.zeros(1), state, 0.0, UP)
    turbulence_tick(off, np.zeros(1), state, 300.0, 0.0, UP)
    assert turbulence_at(state, 0.5) == (0.0, 0.0, 0.0)


def test_tick_length_enters_through_the_way_flown():
    """Twice the tick at half the speed gives the same field."""
    table = intensity_table(0.0, SIGMA, LENGTH)
    last = []
    for tick_ns, airspeed in [(10_000_000, 200.0), (20_000_000, 100.0)]:
        row, pool = setting(table, tick_ns=tick_ns)
        out = np.empty((20, 3))
        fly(row, pool, blank(TurbulenceState)[0], airspeed, 0.0, 0.0, UP, out)
        last.append(out[-1])
    assert last[0] == pytest.approx(last[1], rel=1e-12)


def test_preset_intensities():
    """The presets equal figure 7 at a tabulated altitude, and the low-altitude model at 500 ft by hand."""
    for level, at_15000_ft, wind_kt in [("light", 4.6, 15), ("moderate", 8.0, 30), ("severe", 22.1, 45)]:
        table = exceedance_table(level)
        assert table(15000 * FOOT_m) == pytest.approx([at_15000_ft * FOOT_m] * 3 + [1750 * FOOT_m] * 3)
        sigma_u, sigma_v, sigma_w, l_u, l_v, l_w = table(600 * FOOT_m)
        k = 0.177 + 0.000823 * 600
        assert sigma_w == pytest.approx(0.1 * wind_kt * 1852 / 3600)
        assert sigma_u == sigma_v == pytest.approx(sigma_w / k**0.4)
        assert l_w == pytest.approx(600 * FOOT_m)
        assert l_u == l_v == pytest.approx(600 * FOOT_m / k**1.2)
    # k = 1 at 1000 ft: there the three are equal, as the joint to the upper model wants
    assert exceedance_table("light")(1000 * FOOT_m)[:3] == pytest.approx([1.5 * 1852 / 3600] * 3, rel=1e-6)


def test_preset_over_high_ground():
    ground = 2000.0
    raised, level = exceedance_table("moderate", ground), exceedance_table("moderate")
    assert raised(ground + 100.0) == pytest.approx(level(100.0))
    assert raised(12e3) == pytest.approx(level(12e3))


def test_impossible_intensities_are_refused():
    with pytest.raises(ValueError, match="scale lengths"):
        intensity_table([0.0, 1.0], 1.0, 0.0)
    with pytest.raises(ValueError, match="intensities"):
        intensity_table(0.0, -1.0, 10.0)


@pytest.mark.parametrize(("frame", "turned"), [("body", False), ("horizontal", True)])
def test_the_gust_enters_the_flow_in_its_frame(frame, turned):
    """The flow velocity in B changes by the gust, at an asymmetric attitude and place."""
    more = ("wind.speed_mps=12", "wind.from_deg=250", f"wind.turbulence={{exceedance='light',frame='{frame}'}}")
    packed = pack_flight(load_scenario("nominal", more).scenario)
    environment, y = packed.parameters[0].environment, packed.state.copy()
    attitude = scipy.spatial.transform.Rotation.from_rotvec([0.3, -0.8, 0.5])
    y[6:10] = np.roll(attitude.as_quat(), 1)
    y[3:6] += [100.0, -40.0, 250.0]
    rotation = tuple(attitude.as_matrix().ravel())
    gust = (3.0, -2.0, 1.0)
    flows = []
    for given in ((0.0, 0.0, 0.0), gust):
        air = blank(AirData)[0]
        air_data(environment, packed.pool, given, rotation, y, blank(Anchor)[0], air)
        flows.append(air.flow_B_mps.copy())
    expected = np.array(gust)
    if turned:
        latitude = math.radians(36.70)  # of nominal.toml; geodetic, at t = 0 the inertial longitude is the Earth's
        longitude = math.atan2(y[1], y[0])
        s, c, sl, cl = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
        axes = np.array([[-s * cl, -s * sl, c], [-sl, cl, 0.0], [-c * cl, -c * sl, -s]])  # rows north, east, down
        expected = attitude.inv().apply(axes.T @ expected)
    assert flows[0] - flows[1] == pytest.approx(expected, abs=1e-9)
    along = np.array(flight_direction(environment, packed.pool, y))
    if turned:
        assert along == pytest.approx(axes @ attitude.apply(flows[0]) / np.linalg.norm(flows[0]), abs=1e-9)
    else:
        assert tuple(along) == (0.0, 0.0, -1.0)


def test_a_scenario_names_a_spectrum_and_flies_the_same_from_its_log():
    spectrum = "spectrum={wave_number_pm=[0.0005,0.05],density_m3ps2=[1000.0,0.1]}"
    loaded = load_scenario("nominal", (f"wind.turbulence={{model='spectrum',{spectrum},seed=4}}",))
    packed, again = pack_flight(loaded.scenario), pack_flight(load_scenario_text(loaded.as_flown).scenario)
    given = packed.parameters[0].environment.turbulence
    assert (given.lines, given.frame, given.on) == (64, HORIZONTAL, 1)
    assert packed.parameters.tobytes() == again.parameters.tobytes()
    # a straight line in the logarithms: E = 1000 (k / 0.0005)^-2
    variance = 1000.0 * 0.0005**2 * (1.0 / 0.0005 - 1.0 / 0.05)
    assert 0.5 * (given.line_mps**2).sum() == pytest.approx(variance, rel=2e-3)
