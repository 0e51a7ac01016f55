"""What the KSR-III reconstruction assumes, in one place: everything here can be argued with.

Stations are metres aft of the nose tip. Sourced numbers are from Lee, Ahn & Roh, Tables 1 to 4; everything
else is an engineering guess, and scenarios/vehicles/ksr3/NOTES.md says why it was made.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

STANDARD_GRAVITY_MPS2 = 9.80665
EARTH_RADIUS_M = 6_371_000.0

# Sourced: Table 1, and the public description of the vehicle (14 m, 1 m diameter).
LIFTOFF_MASS_KG = 6100.0
SEA_LEVEL_THRUST_N = 129.0e3
BURN_S = 59.0
LENGTH_M = 14.0
DIAMETER_M = 1.0
AREA_M2 = pi / 4 * DIAMETER_M**2
CHORD_M = 1.0

# Assumed: the pad and the shape of the ascent.
PAD_ALTITUDE_M = 30.0
PITCH_OVER_START_S, PITCH_OVER_S = 5.0, 14.0
BLEND_S = 6.0  # the gravity turn takes over during the last seconds of the pitch-over
NOZZLE_EXIT_AREA_M2 = 0.2515
IGNITION_RAMP_S = 0.2
TAIL_OFF_S = 0.3

# Assumed: propellants, Jet A-1 forward, pressurant bay between, LOX aft; flat-bottomed tanks.
OXIDISER_TO_FUEL = 2.30
TANK_RADIUS_M = 0.49
SLOSH_DAMPING = 0.02


@dataclass(frozen=True)
class Tank:
    """A flat-bottomed cylindrical tank."""

    name: str
    density_kgpm3: float
    share: float  # of the propellant mass
    bottom_station_m: float


LOX = Tank("lox", 1140.0, OXIDISER_TO_FUEL / (1 + OXIDISER_TO_FUEL), 11.10)
JET_A1 = Tank("jeta1", 804.0, 1 / (1 + OXIDISER_TO_FUEL), 5.45)
TANKS = (LOX, JET_A1)

# Assumed: the engine (a point on the beam's tail, a uniform rod in the mass model) and the instruments.
GIMBAL_STATION_M = 12.70
ENGINE_MASS_KG = 220.0
ENGINE_END_STATION_M = 13.60
ENGINE_CG_BEHIND_GIMBAL_M = 0.40  # of all 220 kg, for the beam
ENGINE_GYRATION_M2 = (
    0.05  # about its own CG: too little, the 40 kg that stay are left with -9.4 kg m2 (from 0.093 on it is a body)
)
GIMBALLED_MASS_KG = 180.0
GIMBALLED_CG_BEHIND_GIMBAL_M = 0.38
GIMBALLED_INERTIA_KGM2 = GIMBALLED_MASS_KG * GIMBALLED_CG_BEHIND_GIMBAL_M**2 + 20.0  # about the gimbal
GYRO_STATION_M = 3.05


@dataclass(frozen=True)
class Component:
    """A dry part, uniform between two stations; `guess_kg` before the sum is scaled to the burn-out mass."""

    name: str
    guess_kg: float
    front_station_m: float
    rear_station_m: float


# The two trims are the bounds at which the fit to Table 2's span of M_delta (8.1 to 15.5 1/s2) stops: the
# span itself is out of reach.
NOSE_TRIM, AFT_TRIM = 1.25, 0.80
DRY_COMPONENTS = (
    Component("nose and payload", 300.0 * NOSE_TRIM, 0.3, 2.5),
    Component("avionics, INS, roll gas", 300.0 * NOSE_TRIM, 2.5, 3.45),
    Component("fuel tank", 300.0, 3.5, 5.6),
    Component("pressurant bay", 520.0, 5.8, 7.7),
    Component("LOX tank", 420.0, 8.0, 11.25),
    Component("aft skirt and thrust structure", 190.0 * AFT_TRIM, 11.2, 12.7),
    Component("four fins", 180.0 * AFT_TRIM, 10.9, 12.7),
    Component("actuators and lines", 100.0 * AFT_TRIM, 11.4, 12.6),
    Component("shell and ducts", 136.0, 0.0, 12.7),
)
CROSS_GYRATION_M2 = 0.2  # of a dry component about its own transverse axis, beside its length
ROLL_GYRATION_M2 = 0.081  # all but the engine; liquids turn little with their walls
FIN_ROLL_INERTIA_KGM2 = 180.0 * 1.2**2

# Assumed: bending. First free-free mode at lift-off, all else follows from the shape of EI.
FIRST_MODE_HZ = 9.0
BENDING_DAMPING = 0.005
SHELL_MODULUS_PA, SHELL_STRESS_PA = 70.0e9, 150.0e6  # stiffened aluminium: what sections bear
BEAM_ELEMENTS = 127
MODE_COUNT = 3

# Assumed: fin planform, for roll damping and cross-flow drag only (lift is fitted).
FIN_ROOT_RADIUS_M, FIN_TIP_RADIUS_M = 0.5, 1.95
FIN_ROOT_CHORD_M, FIN_TIP_CHORD_M = 1.8, 0.8

# Sourced: Tables 3 and 4.
ACTUATOR_HZ = (5.8, 7.2, 52.6, 15.6)
ACTUATOR_ZETA = (0.87, 0.49, 0.15, 0.042)
# Sourced: case study, 0.5 Hz and 0.7 at eleven nodes.
RIGID_HZ, RIGID_ZETA = 0.5, 0.7
NODES_S = tuple(float(t) for t in range(5, 56, 5))
