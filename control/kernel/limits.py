"""The largest numbers of parts in parameter records and kernels.

This is their only definition: schemas reject larger numbers, and records hold arrays of these lengths. The module
imports nothing, so that importing it is fast.
"""

MAX_STAGES = 8
MAX_PENDULUMS = 8  # of a stage: slosh modes of all its tanks, and so the tanks as well
MAX_ENGINES = 9  # of a stage
MAX_BOOSTERS = MAX_ENGINES  # of a stage with section loads
MAX_MODES = 12  # of a stage: in each plane, and of spatial modes
MAX_SURFACES = 8  # lifting surfaces of a stage
MAX_LOAD_STATIONS = 24  # stations of a stage at which section loads are evaluated
MAX_TVC_LOADS = MAX_ENGINES  # of a stage: engines on the compliance of their mount
MAX_SENSORS = 5  # of a stage: rate gyros beyond the first, and an accelerometer
MAX_LATENCY = 8  # samples that a sensor's output may come late
MAX_GUSTS = 16
MAX_INJECTIONS = 16
MAX_FAULTS = 16
MAX_FAULT_WRITES = 6 * MAX_FAULTS  # two on each of three axes
MAX_TONES = 64  # of a multisine
MAX_BURNS = 4  # of the last engine
