"""Scratch memory of the derivative: a kernel allocates nothing, so its caller lends it these arrays.

`work` holds what is passed between the parts of one evaluation, `aux` what an evaluation knows besides the
derivative (loads, air data): metrics and logs read it.
"""

from __future__ import annotations

from maxq.control.kernel.limits import MAX_MODES, MAX_SURFACES, MAX_TANKS

# --- work
# of each mode, in pitch and then in yaw, zeros from the last mode to the next multiple of four
FORCE = 0  # generalised force, N; later acceleration, m/s2
ETA = FORCE + 2 * MAX_MODES  # modal coordinate: eta in pitch, xi in yaw, m
RATE = ETA + 2 * MAX_MODES  # its time derivative, m/s
NU = RATE + 2 * MAX_MODES  # its quasi-velocity, m/s
MACH_ROW = NU + 2 * MAX_MODES  # aerodynamic coefficients at the present Mach number
MACH_WIDTH = 8 + 2 * (MAX_SURFACES + 1)  # one more for the normal force of the table of coefficients beyond their sum
PENDULUM = MACH_ROW + MACH_WIDTH  # per tank, see slosh.py
PENDULUM_WIDTH = 24
GRAM = PENDULUM + PENDULUM_WIDTH * MAX_TANKS  # coupling of the tensions among each other
TENSION = GRAM + MAX_TANKS * MAX_TANKS
ANCHOR = TENSION + MAX_TANKS  # place about which its neighbourhood is known, see nearby.py
ANCHOR_WIDTH = 28
WORK_SIZE = ANCHOR + ANCHOR_WIDTH

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
ENGINE_PITCH = 18  # angle, rate, acceleration: rad, rad/s, rad/s2
ENGINE_YAW = 21
SPECIFIC_FORCE = 24  # specific force at the core CG in B, m/s2 (3): acceleration less gravitation
ANGULAR_ACCEL = 27  # B, rad/s2 (3)
WIND_N = 30  # air's motion relative to the Earth, north, east, down, m/s (3)
GYRO_BEND = 33  # turning rate that bending adds at the gyro: pitch, yaw, rad/s (2)
GRAVITATION = 35  # I, m/s2 (3)
AXIAL_LOAD = 38  # axial specific force that stiffens and slackens the body, m/s2
GIMBAL_BEND = 39  # by bending, of the gimbal: displacement along y and z (m), turning about y and z (rad)
TENSIONS = 43  # of each pendulum's rod, N
AUX_SIZE = TENSIONS + MAX_TANKS
