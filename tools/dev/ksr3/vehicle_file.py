"""vehicle.toml of the reconstruction, every value marked [sourced] or [assumed]."""

from __future__ import annotations

from maxq.tools.dev.ksr3 import assumptions as a
from maxq.tools.dev.ksr3.aerodynamics import cross_flow
from maxq.tools.dev.ksr3.write_files import LOAD_STATIONS_M


def vehicle_toml() -> str:
    engine = (a.GIMBALLED_MASS_KG, a.GIMBALLED_CG_BEHIND_GIMBAL_M, a.GIMBALLED_INERTIA_KGM2)
    return f"""\
# KSR-III, a reconstruction: NOT flight data. Written by tools/dev/ksr3/build.py; change the assumptions
# there. [sourced]: Lee, Ahn & Roh, Tables 1 to 4, or public descriptions of the vehicle; [assumed]: see
# NOTES.md.
schema = 1
name = "KSR-III (reconstruction)"

[reference]
length_m = {a.LENGTH_M:g}                # [sourced]
diameter_m = {a.DIAMETER_M:g}               # [sourced]
area_m2 = {a.AREA_M2:.6f}           # cross-section of the body
chord_m = {a.CHORD_M:g}                  # [assumed] body diameter
span_m = {a.DIAMETER_M:g}                   # [assumed] body diameter

[[stage]]
name = "main"
interpolation = "pchip"

[stage.mass]
table = "mass.csv"           # 6100 kg at t = 0 [sourced], distribution [assumed]; liquid frozen in the tanks

[stage.engine]
table = "thrust.csv"         # 129 kN at sea level, 59 s [sourced]; droop, ramp, tail-off [assumed]
exit_area_m2 = {a.NOZZLE_EXIT_AREA_M2:g}        # [assumed]
gimbal_station_m = {a.GIMBAL_STATION_M:g}      # [assumed]
exit_station_m = {a.LENGTH_M:g}          # [sourced] end of the vehicle
gimballed_mass_kg = {engine[0]:g}      # [assumed] of an engine of {a.ENGINE_MASS_KG:g} kg
cg_from_gimbal_m = {engine[1]:g}      # [assumed]
inertia_about_gimbal_kgm2 = {engine[2]:.3f}  # [assumed]

[stage.actuator]
omega_hz = {list(a.ACTUATOR_HZ)}  # [sourced] Table 3
zeta = {list(a.ACTUATOR_ZETA)}  # [sourced] Table 3
exchange_a3_a4 = false       # as printed
angle_limit_deg = 6.0        # [assumed] typical
rate_limit_degps = 30.0      # [assumed] typical

[[stage.tank]]
name = "lox"
table = "tank_lox.csv"       # [assumed]
damping_ratio = {a.SLOSH_DAMPING:g}         # [assumed] ring baffles; a smooth wall would give 0.0003
radius_m = {a.TANK_RADIUS_M:g}              # [assumed]
bottom_station_m = {a.LOX.bottom_station_m:g}      # [assumed]

[[stage.tank]]
name = "jeta1"
table = "tank_jeta1.csv"     # [assumed]
damping_ratio = {a.SLOSH_DAMPING:g}         # [assumed] ring baffles; a smooth wall would give 0.0008
radius_m = {a.TANK_RADIUS_M:g}              # [assumed]
bottom_station_m = {a.JET_A1.bottom_station_m:g}      # [assumed]

[stage.bending]
pitch = "modes.csv"          # [assumed] beam model with its first mode at {a.FIRST_MODE_HZ:g} Hz at lift-off
yaw = "modes.csv"
damping_ratio = {[a.BENDING_DAMPING] * a.MODE_COUNT}  # [assumed] design value of NASA SP-8036

[stage.aero]
table = "aero.csv"           # [assumed] fitted to Tables 1 and 2
interpolation = "pchip"
crossflow_station_m = {cross_flow().station_m:.3f}  # [assumed] centroid of the planform

[[stage.aero.surface]]
name = "nose"
table = "aero_nose.csv"      # [assumed]

[[stage.aero.surface]]
name = "fins"
table = "aero_fins.csv"      # [assumed] fitted to Table 2

[stage.gyro]
station_m = {a.GYRO_STATION_M:g}             # [assumed]
omega_hz = 60.0              # [sourced] Table 4
zeta = 0.65                  # [sourced] Table 4

[stage.roll_thrusters]
torque_Nm = 150.0            # [assumed]; cold gas in roll is [sourced]

[stage.loads]                # read with switches.section_loads
stations_m = {list(LOAD_STATIONS_M)}
line_mass = "line_mass.csv"  # [assumed] the parts of mass.csv
limits = "section_limits.csv"  # [assumed] 150 MPa in an aluminium shell with the EI of the beam
axial_force = {{station_m = [1.0, 11.9, 13.0], share = [0.5, 0.25, 0.25]}}  # [assumed] nose, fins, base

[[stage.loads.liquid]]
tank = "lox"
table = "liquid_lox.csv"
bottom_station_m = {a.LOX.bottom_station_m:g}

[[stage.loads.liquid]]
tank = "jeta1"
table = "liquid_jeta1.csv"
bottom_station_m = {a.JET_A1.bottom_station_m:g}

[computer]
sample_s = 0.01              # [sourced] Table 4, tau_VF = tau_DZ
delay_s = 0.003              # [sourced] Table 4, tau_D
count_rad = 1.0e-5           # [assumed]
dac_step_deg = 0.001         # [assumed]
angle_error_limit_deg = 20.0 # [assumed]
command_limit_deg = 6.0      # [assumed] the gimbal's limit
"""
