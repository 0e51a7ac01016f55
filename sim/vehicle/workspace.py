"""Memory of the derivative: a kernel allocates nothing, so its caller provides these arrays.

`work` holds what the parts of one evaluation pass to each other, `aux` the auxiliary outputs of an evaluation (loads,
air data), which metrics and logs read.
"""

from __future__ import annotations

from typing import NamedTuple

from maxq.control.kernel.limits import MAX_ENGINES, MAX_MODES, MAX_PENDULUMS, MAX_SURFACES, MAX_TVC_LOADS
from maxq.control.kernel.records import Array


class Evaluation(NamedTuple):
    """Arguments and results of one evaluation of the derivative."""

    properties: Array  # of the vehicle at this instant, see schedule.py
    y: Array
    dy: Array
    aux: Array


# columns of the widest schedule (12 modes a plane, 12 spatial modes, 8 tanks, 9 surfaces, 9 engines and 5 sensors at as
# many stations: 4324) and derived properties (439)
PROPERTIES_SIZE = 4864

# --- work
# of each mode, in pitch and then in yaw, zeros from the last mode to the next multiple of four
FORCE = 0  # generalised force, N
ETA = FORCE + 2 * MAX_MODES  # modal coordinate: eta in pitch, xi in yaw, m
RATE = ETA + 2 * MAX_MODES  # its time derivative, m/s
NU = RATE + 2 * MAX_MODES  # its quasi-velocity, m/s
ACCEL = NU + 2 * MAX_MODES  # modal acceleration: time derivative of the quasi-velocity, m/s2
ROLL = ACCEL + 2 * MAX_MODES  # modal acceleration per roll acceleration with engines deflected, m
MACH_ROW = ROLL + 2 * MAX_MODES  # aerodynamic coefficients at the present Mach number
MACH_WIDTH = 8 + 2 * (MAX_SURFACES + 1)  # one more for the normal force of the table of coefficients beyond their sum
SURFACE_LOAD = MACH_ROW + MACH_WIDTH  # of each lifting surface: force y, z (N), CN_alpha, that times its station
SURFACE_LOAD_WIDTH = 4
PENDULUM = SURFACE_LOAD + SURFACE_LOAD_WIDTH * (MAX_SURFACES + 1)  # per tank, see slosh.py
PENDULUM_WIDTH = 36
GRAM = PENDULUM + PENDULUM_WIDTH * MAX_PENDULUMS  # matrix of the tensions, see slosh.py
MAX_UNKNOWNS = MAX_PENDULUMS + 2 * MAX_TVC_LOADS  # tensions, and angular accelerations of the engine
TENSION = GRAM + MAX_UNKNOWNS * MAX_UNKNOWNS
# of each spatial mode, see spatial_modes.py
SPATIAL_FORCE = TENSION + MAX_UNKNOWNS
SPATIAL_ETA = SPATIAL_FORCE + MAX_MODES
SPATIAL_RATE = SPATIAL_ETA + MAX_MODES
SPATIAL_NU = SPATIAL_RATE + MAX_MODES
SPATIAL_ACCEL = SPATIAL_NU + MAX_MODES
SPATIAL_TURNED = SPATIAL_ACCEL + MAX_MODES  # A eta (eq. 4.7), m
SPATIAL_TURNED_RATE = SPATIAL_TURNED + MAX_MODES  # A d(eta)/dt, m/s
SPATIAL_MOMENTUM = SPATIAL_TURNED_RATE + MAX_MODES  # what the moving engine adds to the modal momentum, N s
SPATIAL_ROLL = SPATIAL_MOMENTUM + MAX_MODES  # modal acceleration per roll acceleration with engines deflected, m
SPATIAL_ALONG = SPATIAL_ROLL + MAX_MODES  # per tank: shape at the hinge along the rod
LOAD = SPATIAL_ALONG + MAX_PENDULUMS * MAX_MODES  # per unknown of a TVC load, see tvc_load.py
LOAD_WIDTH = 14
LOAD_MODAL = LOAD + 2 * MAX_TVC_LOADS * LOAD_WIDTH
LOAD_MODAL_WIDTH = 2 * MAX_MODES
LOAD_SPATIAL = LOAD_MODAL + 4 * MAX_TVC_LOADS * LOAD_MODAL_WIDTH  # generalised forces on spatial modes, accelerations
ANCHOR = LOAD_SPATIAL + 4 * MAX_TVC_LOADS * MAX_MODES  # see environment.py
ANCHOR_WIDTH = 28
GRID_ROW = ANCHOR + ANCHOR_WIDTH  # columns of a table of coefficients over incidence
COEFFICIENTS = GRID_ROW + 14  # and what they are, see incidence.py
PART_WIND = (
    COEFFICIENTS + 14
)  # air's velocity at each surface, then at the cross-flow's station, less that at C, m/s (3)
CROSSFLOW_PART = MAX_SURFACES + 1  # the last of them
ENGINE = PART_WIND + 3 * (CROSSFLOW_PART + 1)  # per engine beyond the first, see rigid.py
ENGINE_WIDTH = 24
WORK_SIZE = ENGINE + ENGINE_WIDTH * (MAX_ENGINES - 1)

# --- aux
ALTITUDE = 0  # m above the ellipsoid, sphere or plane
DENSITY = 1
PRESSURE = 2
TEMPERATURE = 3
SOUND_SPEED = 4
AIRSPEED = 5  # m/s, relative to the moving air
FLOW = 6  # velocity relative to the air in B, m/s (3)
MACH = 9
DYNAMIC_PRESSURE = 10
AERO_FORCE = 11  # B, N (3)
AERO_MOMENT = 14  # about the core CG in B, N m (3)
THRUST = 17  # N
ENGINE_PITCH = 18  # angle, rate, acceleration of the first group of engines: rad, rad/s, rad/s2
ENGINE_YAW = 21
SPECIFIC_FORCE = 24  # specific force at the core CG in B, m/s2 (3): acceleration less gravitation
ANGULAR_ACCEL = 27  # B, rad/s2 (3)
WIND_N = 30  # air's motion relative to the Earth, north, east, down, m/s (3)
GYRO_BEND = 33  # angular rate that bending adds at the gyro: pitch, yaw, rad/s (2)
GRAVITATION = 35  # I, m/s2 (3)
AXIAL_LOAD = 38  # axial specific force that softens the modes and drives the pendulums, m/s2
GIMBAL_BEND = 39  # of the gimbal, by bending: displacement along y and z (m), rotation about y and z (rad)
TENSIONS = 43  # tension of each pendulum's rod, N
GROUPS = TENSIONS + MAX_PENDULUMS  # pitch and yaw of every further group of engines, as of the first (6)
ENGINE_THRUSTS = GROUPS + 6 * (MAX_ENGINES - 1)  # thrust of every engine of engine.py, N
# of every TVC load
SWING = ENGINE_THRUSTS + MAX_ENGINES  # its engine, as of a group of engines (6)
HELD = SWING + 6 * MAX_TVC_LOADS  # its actuators: angle and rate in pitch and yaw, rad, rad/s (4)
HINGE_MOMENT = HELD + 4 * MAX_TVC_LOADS  # on the engine about its gimbal, pitch and yaw, N m (2)
AUX_SIZE = HINGE_MOMENT + 2 * MAX_TVC_LOADS
