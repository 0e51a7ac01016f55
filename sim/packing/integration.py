"""The damping and frequency errors of the Runge-Kutta method for the vehicle's fast oscillations.

In a step h, the method multiplies an oscillation exp(s t) by R(s h), with R(z) = 1 + z + z^2/2 + z^3/6 + z^4/24. The
result is exp(s' t) with s' = ln R(s h) / h. For an undamped oscillation of w rad/s, to leading order, the damping ratio
increases by (w h)^5 / 144, and the frequency decreases by the fraction (w h)^4 / 120. Above w h = 2.83, the oscillation
grows without bound.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

from maxq.sim.input.values import NS_PER_S, to_ns
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_vehicle import Stage
from maxq.sim.vehicle.modes.section import BendingSection, SpatialModesSection
from maxq.sim.vehicle.modes.tables import ModeTable, SpatialModeTable

SHARE = 0.1
"""The largest added damping ratio without a warning, as a share of an oscillation's damping ratio."""
LONGEST_S = 0.01
"""The longest step with run.accuracy, s, because air, slosh and the rigid body change within tenths of a second."""
TVC_LOAD, SENSOR, FEED_LINE = "TVC load", "further sensor", "feed line"
_LEAST = 1e-5  # smaller added damping ratios cause no warning, regardless of their share


class Oscillation(NamedTuple):
    """The pair of poles of an oscillation from the files, at the highest frequency of the flight.

    Coupling and softening by axial load are not included.
    """

    name: str
    frequency_hz: float
    damping_ratio: float


@dataclass(frozen=True)
class MethodError:
    """The error of the method with steps of `step_s` for an oscillation; `frequency_error` is relative."""

    oscillation: Oscillation
    step_s: float
    added_damping_ratio: float
    frequency_error: float

    @property
    def share(self) -> float:
        """Return the ratio of the added to the physical damping ratio; negative if the method reduces damping."""
        own = self.oscillation.damping_ratio
        return self.added_damping_ratio / own if own > 0.0 else math.copysign(math.inf, self.added_damping_ratio)

    @property
    def text(self) -> str:
        """Return a warning if the damping ratio changes by more than SHARE and _LEAST, else an empty string."""
        if abs(self.added_damping_ratio) <= max(SHARE * self.oscillation.damping_ratio, _LEAST):
            return ""
        o, added = self.oscillation, self.added_damping_ratio
        verb = "adds {:.2g} to" if added > 0.0 else "takes {:.2g} from"
        return (
            f"the integrator {verb.format(abs(added))} the damping ratio {o.damping_ratio:g} of {o.name} "
            f"({o.frequency_hz:.4g} Hz) at run.step_s = {self.step_s:g}"
        )


def method_error(oscillation: Oscillation, step_s: float) -> MethodError:
    """Return the error of the classical Runge-Kutta method for an oscillation with a damping ratio below 1.

    Source: Hairer & Wanner, Solving Ordinary Differential Equations II, section IV.2 (stability function).
    """
    w, zeta = 2.0 * math.pi * oscillation.frequency_hz, oscillation.damping_ratio
    z = complex(-zeta, math.sqrt(1.0 - zeta * zeta)) * w * step_s
    s = cmath.log(_amplification(z)) / step_s
    return MethodError(oscillation, step_s, -s.real / abs(s) - zeta, abs(s) / w - 1.0)


def worst_error(scenario: Scenario) -> MethodError | None:
    """Return the error with the largest share of an oscillation's damping, or None if there is no oscillation.

    With run.accuracy, only oscillations that are not propagated exactly are considered.
    """
    stages, step_s, found = scenario.vehicle.stage, scenario.run.step_s, list(oscillations(scenario))
    if scenario.run.accuracy is not None:  # all other oscillations are propagated exactly
        step_s = max(step_ns(scenario, stage) for stage in stages) / NS_PER_S
        found = [o for o in found if o.name.startswith((TVC_LOAD, SENSOR, FEED_LINE))]
    errors = [method_error(o, step_s) for o in found if o.damping_ratio < 1.0]
    return max(errors, key=lambda error: (abs(error.share), abs(error.added_damping_ratio)), default=None)


def unstable(scenario: Scenario) -> Oscillation | None:
    """Return an oscillation that grows without bound for the integrator alone, or None if there is none.

    Steps are not longer than run.step_s, and end at samples and commands of the computer. With run.accuracy, they
    follow from the oscillations.
    """
    if scenario.run.accuracy is not None:
        return None
    delays = scenario.switches.delay
    computers = [c for n in range(len(scenario.vehicle.stage)) if (c := scenario.vehicle.computer_of(n))]
    pieces_s = [max(c.delay_s, c.sample_s - c.delay_s) if delays else c.sample_s for c in computers]
    step_s = min(scenario.run.step_s, max(pieces_s, default=math.inf))
    return next((o for o in oscillations(scenario) if _growth(o, step_s) > 1.0 + 1e-9), None)


def _growth(o: Oscillation, step_s: float) -> float:
    """Return the largest factor by which a step multiplies the amplitude of the two poles of an oscillation."""
    root = cmath.sqrt(o.damping_ratio**2 - 1.0)
    return max(
        abs(_amplification(2.0 * math.pi * o.frequency_hz * step_s * (sign * root - o.damping_ratio)))
        for sign in (1.0, -1.0)
    )


def _amplification(z: complex) -> complex:
    """Return R(z)."""
    return 1.0 + z * (1.0 + z / 2.0 * (1.0 + z / 3.0 * (1.0 + z / 4.0)))


def step_ns(scenario: Scenario, stage: Stage) -> int:
    """Return the step of a stage, ns: run.step_s, or the longest step that satisfies run.accuracy, after its halvings.

    Modes, actuators and the first gyro are propagated exactly (sim/flight/step.py). Simpson's rule integrates their
    inputs, with a relative error of (w h)^4 / 2880 for a force of w rad/s. Further sensors, feed lines, a TVC load, and
    modes with a TVC load are not propagated exactly; their frequencies have a relative error of (w h)^4 / 120.
    """
    accuracy = scenario.run.accuracy
    if accuracy is None:
        return to_ns(scenario.run.step_s)
    found = list(_of_stage(scenario, stage))
    loaded = any(name.startswith(TVC_LOAD) for name, _, _ in found)
    fastest_hz = [
        (
            hz,
            120.0
            if SENSOR in name or FEED_LINE in name or (loaded and ("mode" in name or TVC_LOAD in name))
            else 2880.0,
        )
        for name, hz, _ in found
    ]
    fastest_hz += [(hz, 2880.0) for given in scenario.injection for hz in given.highest_hz]
    fastest_hz += [(0.5 / (math.pi * line.chamber_lag_s), 120.0) for line in stage.feed_line]
    fastest_hz += [(float(stage.buffet.frequency_hz[-1]), 2880.0)] if stage.buffet is not None else []
    longest_s = [(share * accuracy) ** 0.25 / (2.0 * math.pi * hz) for hz, share in fastest_hz if hz > 0.0]
    return int(NS_PER_S * min((LONGEST_S, *longest_s))) >> scenario.run.halvings


def oscillations(scenario: Scenario) -> Iterator[Oscillation]:
    """Yield the oscillations of all stages that are switched on: modes, actuators, TVC loads and sensors."""
    several = len(scenario.vehicle.stage) > 1
    for number, stage in enumerate(scenario.vehicle.stage, start=1):
        for name, frequency_hz, zeta in _of_stage(scenario, stage):
            yield Oscillation(name + (f" (stage {number})" if several else ""), frequency_hz, zeta)


def _of_stage(scenario: Scenario, stage: Stage) -> Iterator[tuple[str, float, float]]:
    switches = scenario.switches
    if switches.bending and stage.bending is not None:
        yield from _modes("pitch mode", stage.bending, stage.bending.pitch_modes)
        yield from _modes("yaw mode", stage.bending, stage.bending.yaw_modes)
    if switches.bending and stage.spatial_modes is not None:
        yield from _modes("spatial mode", stage.spatial_modes, stage.spatial_modes.modes)
    for given in stage.actuators[: 1 if not isinstance(stage.actuator, tuple) else None]:
        group = "" if given.group is None else f" of group {given.group!r}"
        for plane, axis in zip(("pitch", "yaw"), given.axes if switches.actuator != "ideal" else (), strict=False):
            last = 3 if axis.exchange_a3_a4 else 2  # either a3 or a4 is a pair of zeros
            for k in (0, 1, last)[: len(axis.omega_hz)]:
                yield f"{plane} actuator{group}, a{k + 1}", axis.omega_hz[k], axis.zeta[k]
    loads = stage.tvc_loads if switches.tvc_load and switches.engine_inertia else {}
    for number, engine in enumerate(stage.engines):
        if engine.gimbal != "fixed" and (load := loads.get(engine.group)) is not None:
            stiffness, inertia = load.stiffness_Nmprad, engine.inertia_about_gimbal_kgm2
            own_hz = load.frequency_hz if stiffness is None else math.sqrt(stiffness / inertia) / (2.0 * math.pi)
            if load.bearing_stiffness_Nmprad > 0.0:
                bearing_hz = math.sqrt(load.bearing_stiffness_Nmprad / inertia) / (2.0 * math.pi)
                own_hz = math.hypot(own_hz or 0.0, bearing_hz)
            name = f" of engine {number}" if len(stage.engines) > 1 else ""
            yield f"{TVC_LOAD}{name}", own_hz or 0.0, load.damping_ratio
    for number, line in enumerate(stage.feed_line, start=1):
        yield f"{FEED_LINE} {number}", *line.fastest
    if switches.gyro != "ideal":
        if stage.gyro is not None:
            yield "gyro", stage.gyro.omega_hz, stage.gyro.zeta
        for number, sensor in enumerate(stage.sensors, start=1):
            yield f"{SENSOR} {number}", sensor.omega_hz, sensor.zeta


def _modes(
    name: str, given: BendingSection | SpatialModesSection, table: ModeTable | SpatialModeTable | None
) -> Iterator[tuple[str, float, float]]:
    """Yield name, highest frequency (Hz) and damping ratio of each mode."""
    highest = [] if table is None else table.frequency_hz.max(axis=0).tolist()
    factors = zip(highest, given.frequency_factor, given.damping_ratio, strict=False)
    for number, (frequency_hz, factor, zeta) in enumerate(factors, start=1):
        yield f"{name} {number}", factor * frequency_hz, zeta
