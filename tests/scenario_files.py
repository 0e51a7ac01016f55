"""Write small scenario and vehicle folders for tests of scenario files."""

from __future__ import annotations

from pathlib import Path

BRICK = """\
schema = 1
name = "brick"
[reference]
length_m = 0.2
diameter_m = 0.1
area_m2 = 0.02
[[stage]]
[stage.mass]
mass_kg = 2.27
x_cg_m = 0.1
inertia_kgm2 = [[0.00257, 0.0, 0.0], [0.0, 0.00842, 0.0], [0.0, 0.0, 0.00975]]
"""

FREE = """\
schema = 1
vehicle = "brick"
[initial]
geodetic = {latitude_deg = 0.0, longitude_deg = 0.0, altitude_m = 9144.0}
rate_BI_degps = [10.0, 20.0, 30.0]
"""

ROCKET = """\
schema = 1
name = "rocket"
[reference]
length_m = 14.0
diameter_m = 1.0
area_m2 = 0.785
[[stage]]
name = "main"
[stage.mass]
table = "mass.csv"
[stage.engine]
table = "thrust.csv"
exit_area_m2 = 0.25
gimbal_station_m = 12.7
exit_station_m = 14.0
gimballed_mass_kg = 180.0
cg_from_gimbal_m = 0.38
inertia_about_gimbal_kgm2 = 46.0
[stage.actuator]
omega_hz = [5.8, 7.2, 52.6, 15.6]
zeta = [0.87, 0.49, 0.15, 0.042]
angle_limit_deg = 6.0
rate_limit_degps = 30.0
[[stage.tank]]
name = "lox"
table = "tank.csv"
damping_ratio = 0.02
[stage.bending]
pitch = "modes.csv"
yaw = "modes.csv"
damping_ratio = [0.005, 0.006]
[stage.aero]
table = "aero.csv"
[[stage.aero.surface]]
name = "fins"
table = "fins.csv"
[stage.gyro]
station_m = 3.0
omega_hz = 60.0
zeta = 0.65
[stage.roll_thrusters]
torque_Nm = 150.0
[computer]
sample_s = 0.01
delay_s = 0.003
count_rad = 1.0e-5
angle_error_limit_deg = 20.0
command_limit_deg = 6.0
"""

TABLES = {
    "mass.csv": "time_s,mass_kg,x_cg_m,Ixx_kgm2,Iyy_kgm2,Izz_kgm2\n"
    "0,6100,7.6,735,65893,65893\n30,4400,7.5,600,60000,60000\n59,2681,7.2,400,50000,50000\n",
    "thrust.csv": "# made up\ntime_s,thrust_vacuum_N\n0,0\n0.5,150000\n\n58,110000\n59,0\n",
    "tank.csv": "time_s,slosh_mass_kg,pendulum_length_m,hinge_station_m\n0,190,0.27,8.6\n59,10,0.26,11.0\n",
    "aero.csv": "mach,CA,Cmq\n0,0.5,-600\n1.2,0.9,-700\n3,0.6,-500\n",
    "fins.csv": "mach,CN_alpha_pr,station_m\n0,17,11\n3,9,11.3\n",
}

DESIGN = """\
schema = 2
name = "trial"
[gains]
table = [{time_s = 5.0, k_p = 1.2, k_d_s = 0.5}, {time_s = 55.0, k_p = 0.7, k_d_s = 0.3}]
yaw = "pitch"
[filter]
structure = "F3"
quadratic = [{zero_hz = 9.0, zero_zeta = 0.3, pole_hz = 7.0, pole_zeta = 0.7}]
first_order = [{zero_hz = 30.0, pole_hz = 5.0}]
prewarp_hz = 9.2
[roll]
k_rate_s = 0.5
dead_band_deg = 1.0
"""

ASCENT = """\
schema = 1
vehicle = "vehicles/rocket"
design = "designs/trial.toml"
[run]
duration_s = 300.0
[wind]
profile = "winds/west.csv"
[guidance]
programme = "vehicles/rocket/programme.csv"
[[injection]]
at = "gimbal_command"
axis = "pitch"
kind = "doublet"
amplitude_deg = 0.5
start_s = 10.0
stop_s = 12.0
[[requirement]]
metric = "max_q_alpha_Padeg"
limit = 300000.0
"""


def modes_csv(times: tuple[float, ...] = (0.0, 59.0), modes: int = 2) -> str:
    """Return a mode table with stations 0, 7 and 14 m."""
    lines = ["time_s,mode,frequency_hz,generalized_mass_kg,station_m,phi,slope_pm,mass_forward_kg"]
    lines += [
        f"{t:g},{m},{9.1 * m + 0.01 * t},{1700 * m},{x},"
        f"{round(1.8 - 0.1 * x * m, 6)},{round(-0.5 + 0.07 * x, 6)},{400 * x}"
        for t in times
        for m in range(1, modes + 1)
        for x in (0, 7, 14)
    ]
    return "\n".join(lines) + "\n"


def write_free(folder: Path) -> Path:
    """Write the scenario of a torque-free brick, and return its path."""
    (folder / "brick").mkdir(parents=True)
    (folder / "brick" / "vehicle.toml").write_text(BRICK)
    (folder / "free.toml").write_text(FREE)
    return folder / "free.toml"


def write_ascent(folder: Path) -> Path:
    """Write the scenario of a rocket with all components and a design, and return its path."""
    vehicle = folder / "vehicles" / "rocket"
    for made in (vehicle, folder / "designs", folder / "winds"):
        made.mkdir(parents=True)
    (vehicle / "vehicle.toml").write_text(ROCKET)
    for name, text in TABLES.items():
        (vehicle / name).write_text(text)
    (vehicle / "modes.csv").write_text(modes_csv())
    (vehicle / "programme.csv").write_text("time_s,pitch_rate_degps\n0,0\n10,-1\n60,0\n")
    (folder / "designs" / "trial.toml").write_text(DESIGN)
    (folder / "winds" / "west.csv").write_text("altitude_m,speed_mps,from_deg\n0,8,270\n12000,40,280\n")
    (folder / "ascent.toml").write_text(ASCENT)
    return folder / "ascent.toml"
