"""Operating points without a vehicle, given by published derivatives or by the matrices A, B, C, D.

**Derivatives.** Publications describe a launcher by coefficients over time (Greensite, Analysis and Design of Space
Vehicle Flight Control Systems, NASA CR-820 ff., 1967-70). In the equations, z' is the drift velocity across the
reference trajectory, theta the attitude, delta the gimbal angle, v the wind across the trajectory, and V the speed:

    z''     = a1 (z' - v) + (a1 V + a4) theta + a3 delta + sum of b_z eta
    theta'' = A6 (theta + (z' - v) / V) + K1 delta + sum of b_theta eta
    eta''   = -omega^2 eta - 2 zeta omega eta' - (phi_gimbal / M) T_c delta

The plant has the states of `Node.plant`, with w = z' + V theta in place of z'. The coefficient a4 is minus the axial
specific force. The instruments are at one station with the slope sigma and the shape phi of each mode. The gyro
measures theta' + sigma eta', and the accelerometer measures the lateral acceleration

    a1 (w - v) + a3 delta + sum of (b_z eta - phi eta'' - a4 sigma eta)

in its own axes, which rotate with the local slope. With the attitude at the gyro, theta + sigma eta, navigation derives
from it the drift velocity z' - phi eta' of its station (design/loop/fixed_path.py). The coefficients b_z and b_theta
are the force and the moment of a thrust line that follows the bent body. Publications often omit them.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.design.model.held import OUTPUTS, WIND, FlightCondition, state_names
from maxq.design.model.instruments import ACCELERATION, Instruments, Plane
from maxq.design.model.operating_point import OperatingPoint
from maxq.design.model.state_space import StateSpace
from maxq.design.model.vehicle_at import StabilityDerivatives
from maxq.sim.vehicle.actuator.kernel import Actuator, pack_actuators
from maxq.sim.vehicle.sensor.gyro import Gyro, pack_gyro

DELTA = "delta_rad"


@dataclass(frozen=True)
class GivenMode:
    """The coefficients of a bending mode at one instant, as defined in the module."""

    omega_radps: float
    zeta: float
    phi_gimbal_1pkg: float  # shape at the gimbal over the generalised mass
    phi_gyro: float
    slope_gyro_1pm: float
    rotation_1pms2: float = 0.0  # b_theta
    translation_1ps2: float = 0.0  # b_z


@dataclass(frozen=True)
class PlaneCoefficients:
    """The coefficients of a plane at one instant, as defined in the module."""

    V_mps: float
    A6_1ps2: float
    K1_1ps2: float
    a1_1ps: float
    a3_mps2: float
    a4_mps2: float
    control_thrust_N: float = 0.0  # T_c, which excites the modes
    modes: tuple[GivenMode, ...] = ()

    def scaled(self, **factors: float) -> PlaneCoefficients:
        """Return the coefficients with the named ones multiplied by factors.

        A coefficient of a mode has its number in front: `mode_1_omega_radps`. Raises ValueError for an unknown name.
        """
        own = [f.name for f in dataclasses.fields(self) if f.name != "modes"]
        of_mode = [f.name for f in dataclasses.fields(GivenMode)]
        known = own + [f"mode_{n}_{name}" for n in range(1, 1 + len(self.modes)) for name in of_mode]
        for name, factor in factors.items():
            if name not in known:
                raise ValueError(f"{name} = {factor:g}: allowed are factors on {', '.join(known)}")
        modes = []
        for n, mode in enumerate(self.modes, 1):
            values = {name: factors.get(f"mode_{n}_{name}", 1.0) * getattr(mode, name) for name in of_mode}
            modes.append(GivenMode(**values))
        changed = {name: factors.get(name, 1.0) * getattr(self, name) for name in own}
        return PlaneCoefficients(**changed, modes=tuple(modes))

    def plant(self) -> StateSpace:
        """Return the plant defined in the module, with the wind as its last input. Raises ValueError for zero speed."""
        if not self.V_mps > 0.0:
            raise ValueError(f"V_mps = {self.V_mps:g}: the coefficients of the air need a speed above 0")
        n = len(self.modes)
        size = 3 + 2 * n
        a, b = np.zeros((size, size)), np.zeros((size, 2))
        w, q, theta, eta, rate = 0, 1, 2, 3, 3 + n
        a[w, [w, q, theta]], b[w] = (self.a1_1ps, self.V_mps, self.a4_mps2), (self.a3_mps2, -self.a1_1ps)
        per_speed = self.A6_1ps2 / self.V_mps
        a[q, w], b[q] = per_speed, (self.K1_1ps2, -per_speed)
        a[theta, q] = 1.0
        local, lateral = np.zeros(size), np.zeros(size)
        local[q], lateral[w] = 1.0, self.a1_1ps
        through = np.array([self.a3_mps2, -self.a1_1ps])
        for k, mode in enumerate(self.modes):
            a[eta + k, rate + k] = 1.0
            a[rate + k, eta + k] = -(mode.omega_radps**2)
            a[rate + k, rate + k] = -2.0 * mode.zeta * mode.omega_radps
            b[rate + k, 0] = -mode.phi_gimbal_1pkg * self.control_thrust_N
            a[w, eta + k], a[q, eta + k] = mode.translation_1ps2, mode.rotation_1pms2
            local[rate + k] = mode.slope_gyro_1pm
            lateral -= mode.phi_gyro * a[rate + k]
            lateral[eta + k] += mode.translation_1ps2 - self.a4_mps2 * mode.slope_gyro_1pm
            through -= mode.phi_gyro * b[rate + k]
        unit, none = np.eye(size), np.zeros((4, 2))
        c = np.stack([unit[q], local, unit[w], unit[theta], lateral])
        return StateSpace(
            a, b, c, np.vstack([none, through]), state_names(n, 0), (DELTA, WIND), (*OUTPUTS, ACCELERATION)
        )

    @property
    def derivatives(self) -> StabilityDerivatives:
        """Return the derivatives in the notation of Lee, Ahn & Roh (4 to 8), with zero rate damping."""
        return StabilityDerivatives(
            z_alpha_1ps=self.a1_1ps,
            m_alpha_1ps2=self.A6_1ps2,
            z_delta_1ps=self.a3_mps2 / self.V_mps,
            m_delta_1ps2=self.K1_1ps2,
            m_q_1ps=0.0,
        )


Change = tuple[Array, Array, Array, Array]
"""The changes of A, B, C and D by a deviation of 1."""
COMPUTER = ("gain", "delay_s")
"""The deviations of every given point: a factor on the command, and a delay in s that is added to the computer's."""


@dataclass(frozen=True, kw_only=True)
class GivenPoint(OperatingPoint):
    """An operating point whose plant is given. Its measured acceleration is in the frame of `axial_mps2`."""

    given: StateSpace
    changes: Mapping[str, Change] = field(default_factory=dict)  # deviations of matrices by name
    axial_mps2: float = 0.0  # axial specific force that navigation measures
    of_rigid: StabilityDerivatives | None = None
    coefficients: PlaneCoefficients | None = None
    parts: tuple[tuple[str, StateSpace], ...] = ()  # plants without some of the effects (`steps`)

    def held_still(self) -> GivenPoint:
        return self

    def plant_in_wind(self, wind: bool = True) -> StateSpace:
        plant = self.given
        if not wind and WIND in plant.inputs:
            kept = [k for k, name in enumerate(plant.inputs) if name != WIND]
            names = tuple(plant.inputs[k] for k in kept)
            return dataclasses.replace(plant, b=plant.b[:, kept], d=plant.d[:, kept], inputs=names)
        if wind and WIND not in plant.inputs:
            raise ValueError(f"node at {self.time_s:g} s: its matrices have no input {WIND}")
        return plant

    @property
    def axial_load_mps2(self) -> float:
        return self.axial_mps2

    @property
    def derivatives(self) -> StabilityDerivatives:
        if self.of_rigid is None:
            raise ValueError(f"node at {self.time_s:g} s: matrices have no stability derivatives; give m_delta_1ps2")
        return self.of_rigid

    @property
    def omega_radps(self) -> Array:
        modes = () if self.coefficients is None else self.coefficients.modes
        return np.array([mode.omega_radps for mode in modes])

    def steps(self) -> list[tuple[str, OperatingPoint]]:
        before = [(name, dataclasses.replace(self, given=plant, parts=())) for name, plant in self.parts]
        return [*before, ("bending" if self.parts else "plant", self)]

    @property
    def known_deviations(self) -> tuple[str, ...]:
        """Return the names that `with_` accepts."""
        if self.coefficients is None:
            return (*COMPUTER, *self.changes)
        own = [f.name for f in dataclasses.fields(PlaneCoefficients) if f.name != "modes"]
        of_mode = [f.name for f in dataclasses.fields(GivenMode)]
        modes = range(1, 1 + len(self.coefficients.modes))
        return (*COMPUTER, *own, *(f"mode_{n}_{name}" for n in modes for name in of_mode))

    def with_(self, **deviations: float) -> GivenPoint:
        """Return the operating point with deviations.

        A deviation of a coefficient is a factor, such as A6_1ps2=1.3 or mode_1_omega_radps=0.9. A deviation of matrices
        is a multiple of the change with this name (`point_of_matrices`). `gain` is a factor on the command, and
        `delay_s` is added to the delay of the computer. Raises ValueError for an unknown name and for a negative delay.
        """
        for name, value in deviations.items():
            if name not in self.known_deviations:
                known = ", ".join(self.known_deviations)
                raise ValueError(f"node at {self.time_s:g} s: {name} = {value:g} is no deviation; allowed: {known}")
        own = {name: value for name, value in deviations.items() if name not in COMPUTER}
        point = self
        if self.coefficients is not None:
            point = of_coefficients(self, self.coefficients.scaled(**own)) if own else self
        elif own:
            parts = [getattr(self.given, name) for name in "abcd"]
            for name, value in own.items():
                parts = [part + value * change for part, change in zip(parts, self.changes[name], strict=True)]
            changed = dict(zip("abcd", parts, strict=True))
            point = dataclasses.replace(self, given=dataclasses.replace(self.given, **changed))
        gain, late_s = deviations.get("gain", 1.0), deviations.get("delay_s", 0.0)
        if late_s != 0.0:
            timing = point.instruments
            delay_s = _duration("delay_s", timing.delay_s + late_s)
            point = dataclasses.replace(point, instruments=dataclasses.replace(timing, delay_s=delay_s))
        return point if gain == 1.0 else dataclasses.replace(point, given=_amplified(point.given, gain), parts=())


def _amplified(plant: StateSpace, gain: float) -> StateSpace:
    """Return a plant whose gimbal angle is multiplied by a factor."""
    factors = np.array([gain if name == DELTA else 1.0 for name in plant.inputs])
    return dataclasses.replace(plant, b=plant.b * factors, d=plant.d * factors)


def _duration(name: str, value: float) -> float:
    if not 0.0 <= value < math.inf:
        raise ValueError(f"{name} = {value:g}: allowed is a finite number from 0")
    return value


def of_coefficients(point: GivenPoint, given: PlaneCoefficients) -> GivenPoint:
    """Return an operating point with the plant of the coefficients, in the air and with the instruments of `point`."""
    rigid = dataclasses.replace(given, modes=())
    airless = dataclasses.replace(rigid, A6_1ps2=0.0, a1_1ps=0.0)
    return dataclasses.replace(
        point,
        given=given.plant(),
        axial_mps2=-given.a4_mps2,
        of_rigid=given.derivatives,
        coefficients=given,
        parts=(("rigid body", airless.plant()), ("aerodynamics", rigid.plant())),
    )


def given_instruments(
    sample_s: float = 0.0,
    delay_s: float = 0.0,
    actuator: Actuator | None = None,
    gyro: Gyro | None = None,
    accelerometer: Gyro | None = None,
    latency_samples: int = 0,
) -> Instruments:
    """Return the instruments of an operating point without a vehicle. Instruments that are absent are ideal.

    A `sample_s` of 0 describes a computer without sampling, for loops of the kinds `exact` and `pade` only. The delay
    may be longer than a sample. Raises ValueError for a negative or infinite time.
    """
    for name, value in (("sample_s", sample_s), ("delay_s", delay_s)):
        _duration(name, value)
    ideal = pack_gyro(None, ideal=True)
    return Instruments(
        actuators=(actuator or pack_actuators(None, "ideal")[0],),
        gyro=gyro or ideal,
        sample_s=sample_s,
        delay_s=delay_s,
        sensors=((ACCELERATION, accelerometer or ideal, latency_samples),),
    )


def point_of_matrices(
    a: ArrayLike,
    b: ArrayLike,
    c: ArrayLike,
    d: ArrayLike | None = None,
    *,
    outputs: Sequence[str] = ("local_rate_radps",),
    inputs: Sequence[str] = (DELTA,),
    states: Sequence[str] | None = None,
    time_s: float = 0.0,
    sample_s: float = 0.0,
    delay_s: float = 0.0,
    axial_mps2: float = 0.0,
    plane: Plane = "pitch",
    airspeed_mps: float = math.nan,
    m_delta_1ps2: float | None = None,
    m_alpha_1ps2: float = 0.0,
    deviations: Mapping[str, Mapping[str, ArrayLike]] | None = None,
) -> GivenPoint:
    """Return an operating point of the plant x' = A x + B u, y = C x + D u, from the gimbal angle to measurements.

    `outputs` names the rows of C: `local_rate_radps`, the rate at the gyro, and optionally `accel_mps2`, the lateral
    specific force at the accelerometer. `inputs` names the columns of B: `delta_rad`, and optionally `wind_mps`. The
    `states` may include `eta_1_m` and `slosh_1_rad`; the lobes of their poles then have these names. An actuator must
    be part of the matrices. `axial_mps2` is the axial specific force, for a law with drift feedback, and `airspeed_mps`
    the speed, for gusts. The optimiser needs the angular acceleration per gimbal angle, `m_delta_1ps2`, and per angle
    of attack, `m_alpha_1ps2`, for its starts and for limits on the rigid body.

    `deviations` describe the uncertainty: {name: {"a": change, ...}} are the changes of A, B, C and D by a deviation
    of 1 (`GivenPoint.with_`, `worst_point`). Raises ValueError for inconsistent matrices and for other names.
    """
    matrices = [np.atleast_2d(np.asarray(m, float)) for m in (a, b, c)]
    n, m, p = len(matrices[0]), len(inputs), len(outputs)
    through = np.zeros((p, m)) if d is None else np.atleast_2d(np.asarray(d, float))
    known = ("local_rate_radps", ACCELERATION)
    if DELTA not in inputs or not set(inputs) <= {DELTA, WIND}:
        raise ValueError(f"inputs = {list(inputs)}: allowed are {DELTA} and, last, {WIND}")
    if known[0] not in outputs or not set(outputs) <= {*OUTPUTS, *known}:
        raise ValueError(
            f"outputs = {list(outputs)}: allowed are {known[0]} and any of {', '.join((*OUTPUTS, known[1]))}"
        )
    if not all(np.isfinite(x).all() for x in (*matrices, through)):
        raise ValueError("matrices: allowed are finite numbers")
    names = tuple(states) if states is not None else tuple(f"x_{k + 1}" for k in range(n))
    system = StateSpace(
        matrices[0], matrices[1].reshape(n, m), matrices[2], through, names, tuple(inputs), tuple(outputs)
    )
    instruments = given_instruments(sample_s, delay_s)
    if ACCELERATION not in outputs:
        instruments = dataclasses.replace(instruments, sensors=())
    rigid = None
    if m_delta_1ps2 is not None:
        rigid = StabilityDerivatives(math.nan, m_alpha_1ps2, math.nan, m_delta_1ps2, 0.0)
    return GivenPoint(
        time_s=time_s,
        condition=still(time_s, airspeed_mps, math.nan, axial_mps2),
        instruments=instruments,
        plane=plane,
        label=f"{time_s:g} s",
        speed_mps=airspeed_mps,
        given=system,
        axial_mps2=axial_mps2,
        of_rigid=rigid,
        changes={name: _change(name, change, system) for name, change in (deviations or {}).items()},
    )


def _change(name: str, given: Mapping[str, ArrayLike], system: StateSpace) -> Change:
    """Return the changes of all four matrices by a deviation. Raises ValueError for another name or shape."""
    if name in COMPUTER or not name.isidentifier() or not given or not set(given) <= set("abcd"):
        allowed = f"another name than {', '.join(COMPUTER)}, with any of a, b, c, d"
        raise ValueError(f"deviations: {name!r} has {list(given)}; allowed is {allowed}")
    out = []
    for part in "abcd":
        shape = getattr(system, part).shape
        change = np.asarray(given.get(part, np.zeros(shape)), float)
        if change.size != shape[0] * shape[1] or not np.isfinite(change).all():
            raise ValueError(f"deviations: {name}.{part} has the shape {change.shape}; allowed are numbers of {shape}")
        out.append(change.reshape(shape))
    return out[0], out[1], out[2], out[3]


def still(time_s: float, airspeed_mps: float, dynamic_pressure_Pa: float, axial_mps2: float) -> FlightCondition:
    """Return the condition of an operating point that is not part of a flight, with the axial load as gravity."""
    return FlightCondition(
        time_s=time_s,
        airspeed_mps=airspeed_mps,
        density_kgpm3=2.0 * dynamic_pressure_Pa / airspeed_mps**2,
        pressure_Pa=math.nan,
        mach=math.nan,
        pitch_rad=0.5 * math.pi,
        gravity_mps2=axial_mps2,
    )
