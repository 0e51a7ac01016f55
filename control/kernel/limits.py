"""The largest numbers of parts in parameter records and kernels.

These are their only definitions: schemas reject larger numbers, and records contain arrays of these lengths. The module
imports nothing, so that its import is fast.
"""

MAX_STAGES = 8
MAX_PENDULUMS = 8  # slosh modes of all tanks of a stage; also the largest number of tanks
MAX_ENGINES = 9  # per stage
MAX_BOOSTERS = MAX_ENGINES  # per stage with section loads
MAX_MODES = 12  # per stage: modes of each plane, and spatial modes
MAX_SURFACES = 8  # lifting surfaces per stage
MAX_LOAD_STATIONS = 24  # stations per stage at which section loads are evaluated
MAX_TVC_LOADS = MAX_ENGINES  # per stage: engines with a compliant mount
MAX_BUFFETS = 8  # stations per stage at which buffet acts
MAX_FEED_LINES = 4  # per stage
MAX_SENSORS = 5  # per stage: rate gyros after the first, and accelerometers
MAX_UNITS = 3  # inertial units: a gyro and an accelerometer each
MAX_LATENCY = 8  # largest delay of a sensor's output, samples
MAX_GUSTS = 16
MAX_INJECTIONS = 16
MAX_FAULTS = 16
MAX_FAULT_WRITES = 6 * MAX_FAULTS  # two per axis for each fault
MAX_TONES = 64  # of a multisine input
MAX_BURNS = 4  # of the last stage's engine
MAX_TRAIL = 512  # states of a flight kept for the metrics of its impact point
