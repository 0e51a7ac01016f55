"""The memory of the derivative, provided by the caller, because kernels allocate nothing.

The module of each component declares its own records.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, NamedTuple

from maxq.control.kernel.limits import MAX_BUFFETS, MAX_ENGINES, MAX_PENDULUMS
from maxq.control.kernel.records import Array
from maxq.sim.vehicle.air.kernel import AeroWork
from maxq.sim.vehicle.buffet.kernel import BuffetWork
from maxq.sim.vehicle.engine.kernel import EngineOutputs, KeptEngine
from maxq.sim.vehicle.environment import AirData, Anchor
from maxq.sim.vehicle.feed.kernel import FeedWork
from maxq.sim.vehicle.modes.planar import GimbalBending, Modes
from maxq.sim.vehicle.slosh.kernel import TankWork
from maxq.sim.vehicle.tvc_load.kernel import System, TvcLoadOutputs

# columns of the widest schedule (12 modes per plane, 12 spatial modes, 8 tanks, 9 surfaces, 9 engines, 4 feed
# lines, 8 places of buffet and 5 sensors at different stations: 5764) and derived properties (475)
PROPERTIES_SIZE = 6336


@dataclass
class Work:
    """The intermediate values of one evaluation, which the components exchange."""

    anchor: Anchor
    modes: Modes
    aero: AeroWork
    engine: Annotated[tuple[KeptEngine, ...], (MAX_ENGINES,)]  # after the first
    tank: Annotated[tuple[TankWork, ...], (MAX_PENDULUMS,)]
    system: System
    buffet: BuffetWork
    feed: FeedWork


@dataclass
class Aux:
    """The auxiliary outputs of an evaluation for metrics, events and logs."""

    air: AirData
    engines: EngineOutputs
    tvc_loads: TvcLoadOutputs
    gimbal_bending: GimbalBending
    aero_force_B_N: Annotated[Array, (3,)]
    aero_moment_B_Nm: Annotated[Array, (3,)]  # about the core CG
    specific_force_B_mps2: Annotated[Array, (3,)]  # at the core CG: acceleration minus gravitation
    alpha_BI_B_radps2: Annotated[Array, (3,)]  # angular acceleration
    gyro_bending_radps: Annotated[Array, (2,)]  # angular rate due to bending at the gyro: pitch, yaw
    axial_load_mps2: float  # axial specific force that softens the modes and drives the pendulums
    tension_N: Annotated[Array, (MAX_PENDULUMS,)]  # of the rod of each pendulum
    buffet_N: Annotated[Array, (2 * MAX_BUFFETS,)]  # force along z and along y at each station


class Evaluation(NamedTuple):
    """The arguments and results of one evaluation of the derivative."""

    properties: Array  # of the vehicle at this instant (schedule.py)
    y: Array
    dy: Array
    aux: Aux
