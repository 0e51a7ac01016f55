"""The present faults: one array of numbers, all zero in a healthy vehicle, which the components read.

A fault of the scenario writes into slots of this array while it lasts (sim/flight/faults.py); what a number means is
the component's affair. A slot that is zero changes nothing.
"""

from __future__ import annotations

from maxq.control.kernel.limits import MAX_ENGINES, MAX_SENSORS

ANY_FAULT = 0  # 1 while any slot is in use
GYRO_LOST = 1  # of each axis: share of the gyro's output that is lost
GYRO_ADDED = 4  # of each axis: rate added to what is left, rad/s
GYRO_WALK = 7  # of each axis: angle random walk beside the gyro's own, rad / sqrt(s)
ACTUATOR_FAULT = 10  # of pitch and yaw of each group of engines: HEALTHY, STUCK, HARD_OVER or FLOATING
ACTUATOR_ANGLE = ACTUATOR_FAULT + 2 * MAX_ENGINES  # of the same: where a hard-over goes, rad
SENSOR_FAULT = ACTUATOR_ANGLE + 2 * MAX_ENGINES  # of each sensor beyond the gyro nine slots, in the gyro's order
SENSOR_SLOTS = 9  # of an accelerometer in m/s2 and (m/s) / sqrt(s)
N_FAULT_SLOTS = SENSOR_FAULT + SENSOR_SLOTS * MAX_SENSORS
HEALTHY, STUCK, HARD_OVER, FLOATING = 0.0, 1.0, 2.0, 3.0
