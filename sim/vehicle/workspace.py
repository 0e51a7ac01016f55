"""Scratch memory of the derivative: what its parts pass to each other. A kernel allocates nothing itself."""

from __future__ import annotations

from maxq.control.kernel.limits import MAX_ENGINES, MAX_MODES, MAX_PENDULUMS, MAX_SURFACES, MAX_TVC_LOADS

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
