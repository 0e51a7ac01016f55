"""The active faults: one array of numbers that the components read, all zero in a healthy vehicle.

A fault of the scenario writes into slots of this array while it is active (sim/flight/faults.py). Each component
defines the meaning of its slots. A slot of zero has no effect.
"""

from __future__ import annotations

from maxq.control.kernel.limits import MAX_ENGINES, MAX_SENSORS

ANY_FAULT = 0  # 1 while any slot is not zero
GYRO_LOST = 1  # per axis: lost share of the gyro's output
GYRO_ADDED = 4  # per axis: rate added to the remaining output, rad/s
GYRO_WALK = 7  # per axis: angle random walk in addition to the gyro's own, rad / sqrt(s)
ACTUATOR_FAULT = 10  # pitch and yaw of each group: HEALTHY, STUCK, HARD_OVER or FLOATING
ACTUATOR_ANGLE = ACTUATOR_FAULT + 2 * MAX_ENGINES  # per actuator: angle of a hard-over, rad
# nine slots per sensor after the gyro, in the order of the gyro's slots
SENSOR_FAULT = ACTUATOR_ANGLE + 2 * MAX_ENGINES
SENSOR_SLOTS = 9  # of an accelerometer in m/s2 and (m/s) / sqrt(s)
RECEIVER_FAULT = SENSOR_FAULT + SENSOR_SLOTS * MAX_SENSORS
# 1 while the fault is active, unless a unit is given
GNSS_OUTAGE, GNSS_STUCK = RECEIVER_FAULT, RECEIVER_FAULT + 1
GNSS_ADDED = RECEIVER_FAULT + 2  # north, east, down: added to the position, m
BAROMETER_STUCK, BAROMETER_DEAD = RECEIVER_FAULT + 5, RECEIVER_FAULT + 6
BAROMETER_ADDED = RECEIVER_FAULT + 7  # Pa
MAGNETOMETER_STUCK, MAGNETOMETER_DEAD = RECEIVER_FAULT + 8, RECEIVER_FAULT + 9
MAGNETOMETER_ADDED = RECEIVER_FAULT + 10  # per axis, T
LIFTOFF_SWITCH_STUCK, SEPARATION_SWITCH_STUCK = RECEIVER_FAULT + 13, RECEIVER_FAULT + 14
SAMPLE_LOST = RECEIVER_FAULT + 15  # of the first gyro, then of each sensor after it
N_FAULT_SLOTS = SAMPLE_LOST + 1 + MAX_SENSORS
HEALTHY, STUCK, HARD_OVER, FLOATING = 0.0, 1.0, 2.0, 3.0
