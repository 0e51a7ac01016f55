"""Solid motors agree with closed forms and SciPy.

| quantity | against |
|---|---|
| mass, CG and inertia of a grain with a port, or of an end burner | integrals over its volume |
| propellant spent by a table of thrust with specific impulse | the integral of their ratio |
| speed, total impulse and burnout of hot, fast and strong motors | the integral of thrust over mass |
| roll by the torque of the exhaust | its total impulse times an arm |
| a sine of the thrust at an axial mode | an oscillator |
| an engine on a flexible bearing | two springs |
| gimbal authority in a tail-off | the derivatives at both sides of its end |
| random vehicles of a sweep of warm motors | the packed scenario of each |
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flightkit import EMPTY_SPACE, Parts, Tree, flown, load, merged, rig, scenario_of, with_stage
from scipy.integrate import quad, solve_ivp
from scipy.interpolate import PchipInterpolator
from test_oracle_spatial_modes import spatial_section

import maxq
from maxq import ScenarioError
from maxq.design.model.deviations import deviations_of
from maxq.design.model.node_times import node_times
from maxq.design.verify.uncovered import uncovered
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_file, load_scenario
from maxq.sim.vehicle import state as layout
from maxq.tools.vehicle.aerodynamics import aerodynamics
from maxq.tools.vehicle.layout import Layout, read_layout
from maxq.tools.vehicle.masses import Stack, stacks
from maxq.tools.vehicle.trajectory import _Model

G_0 = 9.80665
GANNET = Path(__file__).parent.parent / "scenarios" / "layouts" / "gannet.toml"


def stack(number: int, *changes: str) -> Stack:
    """Return a stage of the layout, with changes."""
    return stacks(load_file(Layout, "layout", GANNET, changes)[0])[number]


# --- the shipped launcher
def test_the_shipped_launcher_has_the_masses_and_thrusts_of_its_parts() -> None:
    """Parts, engines, grains and liquids are summed by hand; the thrust is the impulse over the burn time."""
    # structure and engine, propellant that burns, impulse per g_0 and kg, duration
    motors = [
        (8200.0, 88000.0, 280.31, 108.0),
        (2400.0, 24000.0, 287.5, 77.0),
        (1080.0, 10500.0, 296.0, 119.0),
        (650.0, 885.0, 320.0, 278.02),
    ]
    above = 2200.0 + 15.0 + 480.0  # payload, residuals and fairing
    for number, (dry, burns, isp_s, burn_s) in reversed(list(enumerate(motors))):
        found, above = stack(number), above + dry
        first, last = (found.mass_properties(t).mass_kg for t in (found.burn.start_s, found.burn.end_s))
        assert (first, last) == pytest.approx((above + burns, above), rel=1e-9)
        assert found.burn.end_s - found.burn.start_s == pytest.approx(burn_s, abs=0.01)
        mean = burns * G_0 * isp_s / burn_s
        t = np.linspace(found.burn.start_s, found.burn.end_s, 40001)
        assert np.mean([found.burn.thrust_vacuum_N(x) for x in t[::10]]) == pytest.approx(mean, rel=5e-4)
        above += burns


def test_the_ascent_across_a_thrust_table_has_a_derivative() -> None:
    """The orbit search differentiates with steps of 1e-5, and wider steps give the same slope."""
    read = read_layout(GANNET)
    whole = stacks(read)
    model = _Model(read, whole, [aerodynamics(each) for each in whole], kick_rad=0.15)

    def height(tangent: float) -> float:
        model.tangents = (tangent, -0.1)
        return model.fly(2)[0][-1].altitude_m

    wide = (height(0.302) - height(0.298)) / 4e-3
    assert (height(0.30001) - height(0.3)) / 1e-5 == pytest.approx(wide, rel=0.1)


# --- the grain
@pytest.mark.parametrize("share", [0.0, 0.4, 0.97])
def test_a_port_burns_outwards(share: float) -> None:
    """The grain of 88 t has radii of 0.5 and 1.46 m; the remainder is integrated over shells of the radius r."""
    motor = stack(0)
    t = float(np.interp(share, [motor.burn.used(t) for t in np.linspace(0, 108, 4001)], np.linspace(0, 108, 4001)))
    (rod,), left = motor.grains(t), 1.0 - motor.burn.used(t)
    assert left == pytest.approx(1.0 - share, abs=1e-4)
    density = 88000.0 / (8.5 * math.pi * (1.46**2 - 0.5**2))
    inner = math.sqrt(1.46**2 - left * (1.46**2 - 0.5**2))
    shell = 2.0 * math.pi * density * 8.5
    mass = quad(lambda r: shell * r, inner, 1.46)[0]
    roll = quad(lambda r: shell * r**3, inner, 1.46)[0]
    across = quad(lambda r: shell * r * (0.5 * r * r + 8.5**2 / 12.0), inner, 1.46)[0]
    assert (rod.mass_kg, rod.station_m) == pytest.approx((mass, 28.45), rel=1e-9)
    assert rod.mass_kg * rod.roll_m2 == pytest.approx(roll, rel=1e-9)
    assert rod.inertia_kgm2 == pytest.approx(across, rel=1e-9)


def test_an_end_burner_moves_its_cg() -> None:
    motor = stack(2, "stage.2.grain.0.burns='end'", "stage.2.grain.0.port_radius_m=")
    t = motor.burn.start_s + 50.0
    (rod,), left = motor.grains(t), 1.0 - motor.burn.used(t)
    length = 2.7 * left
    assert 0.4 < left < 0.6
    assert rod.station_m == pytest.approx(10.9 + 0.5 * length, rel=1e-12)
    assert rod.inertia_kgm2 == pytest.approx(10500.0 * left * (length**2 / 12.0 + 0.93**2 / 4.0), rel=1e-12)
    assert rod.mass_kg * rod.roll_m2 == pytest.approx(10500.0 * left * 0.93**2 / 2.0, rel=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("stage.0.grain.0.port_radius_m=1.46", "stage.0.grain.0.port_radius_m = 1.46: is not inside the grain"),
        (
            "stage.0.grain.0.burns='end'",
            "stage.0.grain.0.port_radius_m = 0.5: has no meaning here; allowed: this key with",
        ),
        ("stage.1.engine.thrust.isp_vacuum_s=[0.0]", "isp_vacuum_s = [0.0]: has 1 numbers, time_s has 17"),
        ("stage.0.engine.tvc_load.group='left'", 'stage.0.engine.tvc_load.group = "left": one table is that of all'),
    ],
)
def test_what_a_motor_cannot_be(change: str, message: str) -> None:
    with pytest.raises(ScenarioError) as refused:
        stack(0, change)
    assert message in str(refused.value)


def test_flow_is_thrust_over_specific_impulse() -> None:
    """The flow integrates to the grain; its rows are those of the layout, with PCHIP between them."""
    motor = stack(0)
    table = motor.stage.engine.thrust
    assert table is not None
    flow = PchipInterpolator(table["time_s"], table["thrust_vacuum_N"] / (G_0 * table["isp_vacuum_s"]))
    kg = [quad(flow, a, b)[0] for a, b in zip(table["time_s"][:-1], table["time_s"][1:], strict=True)]
    assert sum(kg) == pytest.approx(88000.0, rel=1e-4)  # of a table rounded to 1 kN
    for n in (3, 9, 15):
        burned = sum(kg[:n]) / sum(kg)
        assert motor.burn.used(float(table["time_s"][n])) == pytest.approx(burned, rel=1e-9)
        assert motor.used_kg(float(table["time_s"][n])) == pytest.approx(88000.0 * burned, rel=1e-9)
    first, rest = motor.burn.split(40.0)
    assert (first.used(40.0), rest.used(0.0)) == pytest.approx((motor.burn.used(40.0),) * 2, rel=1e-9)
    assert rest.used(20.0) == pytest.approx(motor.burn.used(60.0), rel=1e-4)  # another PCHIP of the same rows
    by_thrust = quad(PchipInterpolator(table["time_s"], table["thrust_vacuum_N"]), 0.0, 5.0, points=[0.15, 0.4])[0]
    assert by_thrust / motor.burn.impulse_Ns != pytest.approx(motor.burn.used(5.0), rel=1e-3)  # Isp makes a difference


# --- the burn
TIMES, NEWTONS = (0.0, 0.2, 2.0, 6.0, 9.0, 10.0, 11.0), (0.0, 8.0e4, 1.0e5, 9.0e4, 7.0e4, 2.0e4, 0.0)
THRUST = PchipInterpolator(TIMES, NEWTONS)
MASS_TIMES = np.linspace(0.0, 11.0, 221)
MASS = PchipInterpolator(MASS_TIMES, 1000.0 - 600.0 * THRUST.antiderivative()(MASS_TIMES) / THRUST.integrate(0.0, 11.0))
BREAKS = np.union1d(TIMES, MASS_TIMES)


def motor_alone(**engine: Any) -> Tree:
    kilograms = MASS(MASS_TIMES)
    inertia = {"Ixx_kgm2": 0.1 * kilograms, "Iyy_kgm2": 2.0 * kilograms, "Izz_kgm2": 2.0 * kilograms}
    mass = {"time_s": MASS_TIMES, "mass_kg": kilograms, "x_cg_m": 0.0 * kilograms + 3.0, **inertia}
    table = {"time_s": TIMES, "thrust_vacuum_N": NEWTONS}
    stage = {
        "mass": {"table": mass},
        "engine": {"table": table, "gimbal": "fixed", "gimbal_station_m": 5.0, "exit_station_m": 5.0} | engine,
    }
    vehicle = {"name": "motor", "reference": {"length_m": 5.0, "diameter_m": 1.0, "area_m2": 0.8}, "stage": [stage]}
    start = {"euler_deg": [0.0, 0.0, 0.0], "ned_mps": [0.0, 0.0, 0.0]}
    return merged({"schema": 1, "vehicle": vehicle, "initial": start} | EMPTY_SPACE, {"run": {"duration_s": 14.0}})


def integral(of: Any) -> float:
    """Return the Gauss-Legendre integral between the breaks, where the integrand is smooth."""
    x, w = np.polynomial.legendre.leggauss(8)
    middle, half = 0.5 * (BREAKS[1:] + BREAKS[:-1]), 0.5 * np.diff(BREAKS)
    return float((half[:, None] * w * of(middle[:, None] + half[:, None] * x)).sum())


@pytest.mark.parametrize(
    ("engine", "burn_rate", "strength"),
    [
        ({}, 1.0, 1.0),
        ({"mass_flow_factor": 1.06}, 1.06, 1.0),
        ({"thrust_factor": 1.02}, 1.0, 1.02),
        ({"temperature_sensitivity_1pK": 0.002, "propellant_temperature_K": 314.15}, math.exp(0.04), 1.0),
        ({"temperature_sensitivity_1pK": 0.002, "reference_temperature_K": 304.15}, math.exp(-0.02), 1.0),
    ],
)
def test_a_faster_burn_keeps_the_total_impulse(engine: Tree, burn_rate: float, strength: float) -> None:
    """The integral of F / m is independent of the burn rate: thrust and flow grow in proportion, and the burn is
    shorter.
    """
    flight = fly(load(motor_alone(**engine)))
    assert flight["v_I_x_mps"][-1] == pytest.approx(strength * integral(lambda t: THRUST(t) / MASS(t)), rel=1e-9)
    assert flight["mass_kg"][-1] == pytest.approx(400.0, rel=1e-12)
    burnout = next(event.time_s for event in flight.events if event.name == "burnout")
    assert burnout == pytest.approx(11.0 / burn_rate, abs=1e-6)
    t, newton = flight.time_s("thrust_N"), flight["thrust_N"]
    at = t < 11.0 / burn_rate - 0.01
    expected = strength * burn_rate * THRUST(burn_rate * t[at])
    np.testing.assert_allclose(newton[at], expected, atol=1e-6 * 1e5)


def test_roll_torque_of_the_exhaust() -> None:
    """d(Ixx p)/dt = arm F: with the outflow on the axis, the propellant leaves at the body's rate."""
    flight = fly(load(motor_alone(roll_arm_m=3e-4)))
    spin = 3e-4 * integral(THRUST) / (0.1 * 400.0)
    assert flight["body_roll_rate_degps"][-1] == pytest.approx(math.degrees(spin), rel=1e-6)


@pytest.mark.parametrize(("share", "begin", "end"), [(0.1, 2.0, 4.0), (-0.3, 6.0, 9.0)])
def test_an_injected_share_of_thrust(share: float, begin: float, end: float) -> None:
    tree = motor_alone() | {
        "injection": [
            {"at": "thrust", "axis": "x", "kind": "step", "amplitude_share": share, "start_s": begin, "stop_s": end}
        ]
    }
    whole = integral(lambda t: (1.0 + share * ((t > begin) & (t < end))) * THRUST(t) / MASS(t))
    assert fly(load(tree))["v_I_x_mps"][-1] == pytest.approx(whole, rel=1e-9)


def test_pressure_oscillation_drives_an_axial_mode() -> None:
    """A chirp through the first axial mode of a rod gives the motion of an undamped oscillator, integrated by SciPy."""
    length, kilograms, thrust, hz = 14.0, 4200.0, 1.0e5, 25.0
    stations = np.linspace(0.0, length, 57)
    shape = np.zeros((len(stations), 6))
    shape[:, 0] = np.cos(np.pi * stations / length)
    parts = Parts(
        core_mass_kg=kilograms,
        core_cg=(length / 2, 0.0, 0.0),
        core_inertia=((800.0, 0.0, 0.0), (0.0, 7e4, 0.0), (0.0, 0.0, 7e4)),
        gimbal_station_m=length,
        gyro_station_m=0.0,
        thrust_N=thrust,
    )
    sine = {"at": "thrust", "axis": "x", "kind": "chirp", "amplitude_share": 0.02, "frequency_hz": 22.0}
    sine |= {"stop_frequency_hz": 28.0, "stop_s": 1.0}
    switches = {"gyro": "ideal", "actuator": "ideal"}
    tree = scenario_of(parts, run={"step_s": 0.0005}, switches=switches, injection=[sine])
    modes = [(hz, 0.5 * kilograms, 0.0, shape)]
    section = spatial_section(stations, kilograms * stations / length, modes)
    made = rig(with_stage(tree, spatial_modes=section))

    def slope(t: float, y: Any) -> list[float]:
        force = thrust * (1.0 + 0.02 * math.sin(2.0 * math.pi * (22.0 + 3.0 * t) * t))
        return [y[1], -((2.0 * math.pi * hz) ** 2) * y[0] - force / (0.5 * kilograms)]

    expected = solve_ivp(slope, (0.0, 0.9), [0.0, 0.0], rtol=1e-10, atol=1e-14).y[0, -1]
    still = -thrust / (0.5 * kilograms) / (2.0 * math.pi * hz) ** 2 * (1.0 - math.cos(2.0 * math.pi * hz * 0.9))
    found = flown(made, 0.9)[-1][int(layout.spatial_index(made.sizes))]
    assert found == pytest.approx(expected, rel=2e-4)  # of a Runge-Kutta step of 0.08 rad at this mode
    assert abs(expected - still) > 0.2 * abs(still)


def test_a_flexible_bearing_holds_back_the_engine() -> None:
    """With the actuator at 2 deg, the engine settles at k / (k + k_b) of it, because its CG is at the gimbal."""
    parts = Parts(engine_mass_kg=200.0, engine_cg_m=0.0, engine_inertia_kgm2=50.0)
    spring = {"stiffness_Nmprad": 4.0e5, "bearing_stiffness_Nmprad": 1.0e5, "damping_ratio": 0.5}
    made = rig(
        with_stage(
            scenario_of(parts, switches={"actuator": "ideal"}), tvc_load=spring, actuator={"bias_deg": (2.0, -1.0)}
        )
    )
    y = flown(made, 2.0)[-1]
    first = int(layout.tvc_load_index(made.sizes))
    np.testing.assert_allclose(np.degrees(y[[first, first + 3]]), [1.6, -0.8], rtol=1e-6)


# --- tail-off
def test_a_long_tail_off_names_the_end_of_the_authority() -> None:
    """The message names the end for KSR-III with its centre of pressure ahead of the CG and thrust falling from 50 s.

    At the named time, 5 deg of angle of attack need less than the gimbal's limit, and 0.15 s later more.
    """
    table = "{time_s=[0.0,0.5,50.0,54.0,58.0],thrust_vacuum_N=[0.0,1.4e5,1.4e5,7e4,0.0]}"
    changes = [f"vehicle.stage.0.engine.table={table}", "vehicle.stage.0.aero.centre_shift_m=-2.75"]
    scenario = load_scenario("nominal", changes)
    times_s = node_times(scenario)
    tail = uncovered(scenario, {0: [t for t in times_s if t < 54.0]})[-1]
    assert (tail.begin_s, tail.end_s) == pytest.approx((54.0, 58.0), abs=0.01)
    said = re.fullmatch(
        r"tail-off, with less than half of the largest thrust; the gimbals trim 5 deg of angle of attack "
        r"to ([0-9.]+) s "
        r"\(M_delta falls from ([0-9.]+) to ([0-9.]+) 1/s2\)",
        tail.why,
    )
    assert said is not None
    end_s, most, least = map(float, said.groups())
    first, held, lost = maxq.nodes(scenario, [54.0, end_s, end_s + 0.15])
    needed = [math.radians(5.0) * n.derivatives.m_alpha_1ps2 / abs(n.derivatives.m_delta_1ps2) for n in (held, lost)]
    limit = math.radians(scenario.vehicle.stage[0].actuators[0].axes[0].angle_limit_deg)
    assert 54.5 < end_s < 57.8
    assert needed[0] <= limit < needed[1]
    assert abs(first.derivatives.m_delta_1ps2) == pytest.approx(most, rel=5e-3)
    assert least < abs(held.derivatives.m_delta_1ps2) < most


@pytest.mark.parametrize(("limit_deg", "lost_by"), [(4.0, "drag"), (3.0, "trim")])
def test_operating_points_in_a_tail_off_end_with_the_authority(limit_deg: float, lost_by: str) -> None:
    """In the same tail-off, thrust falls by equal factors from half to a tenth of the largest, linearly in time.

    The operating points end where drag exceeds the thrust, or where 5 deg of angle of attack need more than the limit.
    """
    table = "{time_s=[0.0,0.5,50.0,54.0,58.0],thrust_vacuum_N=[0.0,1.4e5,1.4e5,7e4,0.0]}"
    changes = [f"vehicle.stage.0.engine.table={table}", "vehicle.stage.0.aero.centre_shift_m=-2.75"]
    scenario = load_scenario("nominal", [*changes, f"vehicle.stage.0.actuator.angle_limit_deg={limit_deg}"])
    times_s = node_times(scenario)
    shares = 0.5 * 0.2 ** (np.arange(1, 5) / 4.0)
    wanted = np.round(58.0 - 8.0 * shares, 3)
    points = maxq.nodes(scenario, wanted)
    derivatives = [point.derivatives for point in points]
    trims = [abs(d.m_delta_1ps2) * limit_deg >= d.m_alpha_1ps2 * 5.0 for d in derivatives]
    pushed = [point.axial_load_mps2 > 0.0 for point in points]
    count = {"drag": 3, "trim": 2}[lost_by]
    assert (trims, pushed)[lost_by == "drag"][: count + 1] == [True] * count + [False]
    assert list(times_s[11:]) == wanted[:count].tolist()
    assert node_times(scenario, 2)[2:] == ()  # its only point would be at a tenth
    rest = uncovered(scenario, {0: list(times_s)})[-1]
    assert (rest.begin_s, rest.end_s) == pytest.approx((wanted[count - 1], 58.0), abs=0.01)
    assert rest.why.startswith(f"tail-off, with less than {100.0 * shares[count - 1]:.0f} % of the largest thrust")


# --- deviations
WARM = """\
extends = "nominal.toml"
[vehicle_overrides]
stage.0.engine.temperature_sensitivity_1pK = 0.003
[campaign]
runs = 20
[[disperse]]
name = "propellant temperature"
key = "vehicle.stage.0.engine.propellant_temperature_K"
apply = "add"
distribution = "normal"
three_sigma = 30.0
"""


def test_the_sweep_of_a_loop_draws_the_temperatures_of_the_campaign(tmp_path: Path) -> None:
    """Run N of the campaign and vehicle N of the sweep have the same thrust in the packed record."""
    path = tmp_path / "warm.toml"
    path.write_text(WARM)
    campaign = maxq.load(path)
    (node,) = maxq.nodes(campaign.base, [30.0])
    deviations = deviations_of(campaign, node)
    assert (deviations.left_out, deviations.fields) == ((), ("mass_flow",))
    for run, by in enumerate(deviations.drawn(range(3))):
        engine = campaign.scenario_of(run).scenario.vehicle.stage[0].engines[0]
        warmer = engine.propellant_temperature_K - 294.15
        assert abs(warmer) > 0.1
        assert by.mass_flow == pytest.approx(math.exp(0.003 * warmer), rel=1e-12)
        packed = pack_flight(campaign.scenario_of(run).scenario)
        factor = float(packed.parameters[0].vehicle.engine.thrust_factor[0])
        assert factor == pytest.approx(math.exp(0.003 * warmer), rel=1e-12)
