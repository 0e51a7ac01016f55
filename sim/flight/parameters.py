"""The parameters of one stage's flight, as one record; a flight is an array of such records, one per stage."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from maxq.control.computer import Computer, ComputerState
from maxq.control.kernel.limits import MAX_BURNS, MAX_ENGINES, MAX_PENDULUMS, MAX_STAGES, MAX_TRAIL
from maxq.control.kernel.records import Array, IntArray
from maxq.sim.flight.faults import FaultMemory, Faults
from maxq.sim.flight.injection import Injections
from maxq.sim.flight.launch import Launch, LaunchMemory
from maxq.sim.flight.metric_table import N_METRICS
from maxq.sim.flight.navigation import Navigation, NavigationMemory
from maxq.sim.vehicle.derivative import Held, StageInputs, StageRecord
from maxq.sim.vehicle.environment import Environment
from maxq.sim.vehicle.loads.columns import Loads, SectionLoads
from maxq.sim.vehicle.sensor.gauges import Gauges
from maxq.sim.vehicle.sensor.receivers import ReceiverMemory, Receivers
from maxq.sim.world.gust_history import GustHistory
from maxq.sim.world.turbulence import TurbulenceState

NEVER = 2**62  # ns: an instant that never occurs
NONE = -1  # no place in the pool
MAX_IGNITIONS = MAX_STAGES + MAX_BURNS
N_COMMANDS = 5  # ignition, cutoff, separations of stage, boosters and fairing
DROPS = 2  # value of `continues` for a stage that drops some boosters of the previous stage

# Events in the order of the events' table; BURNOUT is that of the last stage that burned.
EVENT_NAMES = ("liftoff", "burnout", "separation", "apogee", "impact", "control_lost", "tumble", "diverged")
N_EVENTS = len(EVENT_NAMES)
LIFTOFF, BURNOUT, SEPARATION, APOGEE, IMPACT, CONTROL_LOST, TUMBLE, DIVERGED = range(N_EVENTS)


@dataclass(frozen=True)
class StageTimeline:
    """The timeline of a stage, in ns of flight time unless the name contains another unit."""

    step_ns: int
    even: int  # 1: steps of equal length, at most `step_ns`, fill the time between two instants
    stage_start_ns: int  # zero of this stage's clock
    burn_start_ns: int  # ignition
    frozen: int  # 1: the schedule is stopped at `frozen_s`
    frozen_s: float
    burn_rate: float  # seconds of schedule time per second of flight
    burnout_ns: int
    decay_ns: int  # of the thrust after a cutoff by the guidance
    separation_ns: int  # NEVER on the last stage
    separation_impulse_Ns: float  # forward on the next stage
    separation_spring_J: float
    tip_off_radps: Annotated[Array, (3,)]  # added to the rates of the next stage
    continues: int  # 1: engines, liquid and modes keep their state from the previous stage; DROPS: those that remain
    handed_on: int  # place of the transfer matrix from the previous modes (packing/separation.py), or NONE
    release_ns: int  # time of release; NEVER: when thrust exceeds weight
    stop_ns: int
    ground_altitude_m: float
    stop_mask: int  # bit i: event i ends the flight
    control_lost_rad: float  # attitude error under thrust at which control counts as lost; inf: without control
    # total angle of attack that counts as tumbling while the dynamic pressure exceeds `tumble_pressure_Pa`
    tumble_rad: float
    tumble_pressure_Pa: float
    fast_ns: int  # periods of the log
    slow_ns: int
    seed: int
    sequenced: int  # 1: flight code commands ignitions, cutoffs, throttle and separations (sequence.py)
    separates: int  # kind of the separation that ends the stage, index into external.SEPARATIONS


@dataclass(frozen=True)
class Parameters:
    vehicle: StageRecord
    loads: Loads
    environment: Environment
    computer: Computer
    launch: Launch
    navigation: Navigation
    injections: Injections
    faults: Faults
    timeline: StageTimeline
    receivers: Receivers
    gauges: Gauges


@dataclass
class Clock:
    """The progress of a flight between two calls of the kernel."""

    now_ns: int
    stage: int
    started: int
    finished: int
    cause: int  # cause of divergence, index into `state.CAUSES`
    steps: int
    interval: int  # interval of the schedule
    fresh: int  # 1: the schedule must be read again
    next_break_ns: int  # next breakpoint of the schedule
    next_sample_ns: int
    command_due_ns: int  # instant at which the pending command takes effect
    # engine cutoff by the guidance or flight code, or the ignition that flight code has not commanded yet; it stops the
    # schedule; 0: none
    cut_off_ns: int
    decay_ns: int  # of the thrust after this cutoff, by the stage that commanded it
    ignite_ns: int  # commanded ignition; 0: none
    idle_ns: int  # total time between cutoffs and restarts, in which the schedule was stopped
    separation_ns: int  # end of the stage
    throttled: float  # 1 minus the throttle, by which the schedule is slower and the thrust less; 0: none
    pending_throttled: float
    throttled_ns: int  # instant up to which idle_ns includes the throttling
    pending_rad: Annotated[Array, (2 * MAX_ENGINES,)]
    pending_roll: int
    pending_turn: Annotated[IntArray, (2,)]  # demand on the thrusters in pitch and yaw
    pending_settling_N: float
    next_gust_ns: int
    samples: int  # number of gyro samples, the index of its noise
    next_errors_ns: int  # time of the next estimate of the integration errors
    climbing: int  # 1 while the altitude rises
    event_ns: Annotated[IntArray, (N_EVENTS,)]  # -1: not yet
    stage_burnout_ns: Annotated[IntArray, (MAX_STAGES,)]
    stage_separation_ns: Annotated[IntArray, (MAX_STAGES,)]
    restarts: int
    restart_ns: Annotated[IntArray, (MAX_IGNITIONS,)]  # of the last stage's engine; with flight code, all ignitions
    restart_cut_off_ns: Annotated[IntArray, (MAX_IGNITIONS,)]  # cutoff before each restart
    restart_stage: Annotated[IntArray, (MAX_IGNITIONS,)]


@dataclass
class Extremes:
    """The value and time of each metric so far."""

    value: Annotated[Array, (N_METRICS,)]
    time_ns: Annotated[IntArray, (N_METRICS,)]


@dataclass
class Waves:
    """The waves of each pendulum, stage by stage with MAX_PENDULUMS entries each.

    - `largest`, `largest_ns`: peak wave height under thrust divided by the breaking height, and its time.
    - `broke_ns`: first time at which a wave broke (-1: none).
    """

    largest: Annotated[Array, (MAX_STAGES * MAX_PENDULUMS,)]
    largest_ns: Annotated[IntArray, (MAX_STAGES * MAX_PENDULUMS,)]
    broke_ns: Annotated[IntArray, (MAX_STAGES * MAX_PENDULUMS,)]


@dataclass
class Truth:
    """The true attitude relative to that in the computer.

    `start_q_BI`: attitude at the start, which the computer knows apart from its error of alignment. `error_rad`: roll,
    and tilt about body axes, from the commanded to the true attitude, at the computer's last sample.
    """

    start_q_BI: Annotated[Array, (4,)]
    error_rad: Annotated[Array, (3,)]


@dataclass
class Burnout:
    """The last burnout or cutoff: its time (-1: none), and position and velocity in I."""

    time_ns: int
    r_I_m: Annotated[Array, (3,)]
    v_I_mps: Annotated[Array, (3,)]


@dataclass
class Trail:
    """States of the flight at intervals of about `period_ns` (0: none), for the metrics of the impact point.

    When the arrays are full, every second state is dropped, and the period doubles.
    """

    period_ns: int
    next_ns: int
    count: int
    time_ns: Annotated[IntArray, (MAX_TRAIL,)]
    r_I_m: Annotated[Array, (3 * MAX_TRAIL,)]
    v_I_mps: Annotated[Array, (3 * MAX_TRAIL,)]


ERRORS_SQUARED = 5


@dataclass
class Memory:
    """The complete state of a flight except the state vector."""

    clock: Clock
    held: Held
    inputs: StageInputs
    faults: FaultMemory
    computer: ComputerState
    truth: Truth
    launch: LaunchMemory
    navigation: NavigationMemory
    receivers: ReceiverMemory
    asked: Annotated[IntArray, (N_COMMANDS,)]  # commands of the sequence at the last sample
    burnout: Burnout
    trail: Trail
    gusts: TurbulenceState
    history: GustHistory
    extremes: Extremes
    sections: SectionLoads
    waves: Waves
    errors: Annotated[Array, (8,)]
    """The errors of the integration: attitude, deg; bending, m; slosh, deg; position, m; speed, m/s.

    From ERRORS_SQUARED on, the array contains the sums of the squares of the first three errors, in steps within which
    an engine started or stopped.
    """

    increment_rad: Annotated[Array, (3,)]
    rate_injection_radps: Annotated[Array, (3,)]
    rate_replaces: Annotated[IntArray, (3,)]
    gimbal_injection_rad: Annotated[Array, (2,)]
    gimbal_replaces: Annotated[IntArray, (2,)]
