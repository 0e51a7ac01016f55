"""RocketPy rockets (rocketpy 1.x) as airframes. Only documented attributes are read, so RocketPy is not imported.

RocketPy's positions along the axis are converted to stations by the orientation of its coordinate system. Functions of
RocketPy (drag, thrust) are called with one number.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.input.errors import ScenarioError
from maxq.tools.vehicle.airframe import (
    Airframe,
    AirframeStage,
    Body,
    FinSet,
    Motor,
    Piece,
    RadiusProfile,
    Remark,
    equivalent_trapezoid,
    revolved,
)
from maxq.tools.vehicle.openrocket import SHAPES

_KINDS = {
    "conical": ("conical", 0.0),
    "tangent": ("ogive", 1.0),
    "ogive": ("ogive", 1.0),
    "vonkarman": ("haack", 0.0),
    "lvhaack": ("haack", 1.0 / 3.0),
    "elliptical": ("ellipsoid", 0.0),
    "parabolic": ("parabolic", 1.0),
    "powerseries": ("power", 0.5),
}
_MACH = np.concatenate([np.arange(0.01, 2.0, 0.01), np.arange(2.0, 5.01, 0.25)])
_WALL_m, _MODULUS_Pa = 0.002, 20e9
_TIMES = 400  # of a thrust curve that is not a table


def read_rocketpy(rocket: Any, flight: Any = None, environment: Any = None, *, name: str = "rocket") -> Airframe:
    """Return a RocketPy rocket with the site and rail of a flight, or the site of an environment.

    Raises ScenarioError for a rocket without nose or solid motor, and for surfaces that cannot be imported.
    """
    return _Reading(rocket, flight, environment, name).airframe()


class _Reading:
    def __init__(self, rocket: Any, flight: Any, environment: Any, name: str) -> None:
        self.rocket, self.flight, self.name = rocket, flight, name
        self.environment = environment if environment is not None else getattr(flight, "env", None)
        self.remarks = list[Remark]()
        self.sign = self._sign(rocket.coordinate_system_orientation)
        surfaces = [(surface, self._along(position)) for surface, position in rocket.aerodynamic_surfaces]
        noses = [(s, at) for s, at in surfaces if _kind(s) == "NoseCone"]
        if len(noses) != 1:
            raise self._error("aerodynamic_surfaces", f"has {len(noses)} noses", "one NoseCone")
        (self.nose, self.tip), self.surfaces = noses[0], surfaces

    def _error(self, key: str, problem: str, allowed: str = "") -> ScenarioError:
        return ScenarioError(f"rocket {self.name}", problem, key, allowed=allowed)

    def _sign(self, orientation: str) -> float:
        signs = {"tail_to_nose": -1.0, "nose_to_tail": 1.0}
        if orientation not in signs:
            raise self._error("coordinate_system_orientation", f"is {orientation}", ", ".join(signs))
        return signs[orientation]

    @staticmethod
    def _along(position: Any) -> float:
        """Return the coordinate along the axis of a position, which is a number or a vector."""
        try:
            return float(position[2])
        except (TypeError, IndexError):
            return float(position)

    def station(self, position: Any) -> float:
        """Return the station of a position, m aft of the nose."""
        return self.sign * (self._along(position) - self.tip)

    def airframe(self) -> Airframe:
        rocket = self.rocket
        motor = self._motor()
        fins = tuple(found for s, at in self.surfaces if (found := self._fins(s, self.station(at))) is not None)
        bodies = self._bodies(motor, fins)
        lateral, roll = 0.5 * (rocket.I_11_without_motor + rocket.I_22_without_motor), rocket.I_33_without_motor
        roll_m2, mass = roll / rocket.mass, float(rocket.mass)
        along = lateral / mass - 0.5 * roll_m2
        if along < 0.0:
            raise self._error(
                "I_11_without_motor", f"is {lateral:g}, below half of I_33", "moments of inertia of a body"
            )
        centre = self.station(rocket.center_of_mass_without_motor)
        pieces = (Piece("rocket without motor", mass, centre, along, roll_m2, 0.5 * roll_m2), self._case())
        mach = _MACH
        axial = tuple(self._curve(names, mach) for names in (_POWERED, _COASTING))
        self.remarks.insert(0, Remark("taken", "rocket", f"mass, centre of mass, inertia: {mass:g} kg without motor"))
        self.remarks.insert(1, Remark("taken", "drag", "as axial force, with and without thrust"))
        self.remarks += [
            Remark("missing", "stiffness", "rigid (modes = 0); the walls of the layout are placeholders"),
            Remark("missing", "atmosphere", "the US Standard Atmosphere in place of the environment's"),
            Remark("missing", "wind", "none; give [wind] of the scenario"),
            Remark("missing", "recovery", "the flight ends at the apogee"),
        ]
        return Airframe(
            name=self.name,
            source="a RocketPy rocket",
            stages=(AirframeStage("rocket", pieces, bodies, fins, motor),),
            nose="cone" if self.nose.kind == "conical" else "ogive",
            axial=(mach, axial[0], axial[1]),
            reference_diameter_m=2.0 * float(rocket.radius),
            rigid=True,
            remarks=self.remarks,
            **self._launch(),
        )

    def _launch(self) -> dict[str, Any]:
        """Return the site and the rail. Without a flight, the rail is 5 m long and vertical."""
        out: dict[str, Any] = {"latitude_deg": 0.0, "longitude_deg": 0.0, "altitude_m": 0.0}
        if self.environment is None:
            self.remarks.append(Remark("missing", "launch site", "latitude, longitude and altitude are 0"))
        else:
            keys = {"latitude_deg": "latitude", "longitude_deg": "longitude", "altitude_m": "elevation"}
            out = {key: float(getattr(self.environment, of)) for key, of in keys.items()}
            self.remarks.append(Remark("taken", "launch site", "that of the environment"))
        if self.flight is None:
            self.remarks.append(Remark("missing", "rail", "5 m, vertical"))
            return out | {"azimuth_deg": 90.0, "rail_m": 5.0, "elevation_deg": 90.0}
        travel = float(getattr(self.flight, "effective_1rl", self.flight.rail_length))
        self.remarks.append(Remark("taken", "rail", f"travel of {travel:.4g} m until the first button leaves"))
        angles = {"azimuth_deg": float(self.flight.heading), "elevation_deg": float(self.flight.inclination)}
        return out | angles | {"rail_m": travel}

    def _curve(self, names: tuple[str, ...], mach: Array) -> Array:
        """Return a drag coefficient of the rocket over Mach number."""
        for name in names:
            function = getattr(self.rocket, name, None)
            if callable(function):
                return np.array([float(function(m)) for m in mach])
        raise self._error(names[-1], "is not a function of Mach number")

    def _motor(self) -> Motor:
        m = self.rocket.motor
        wanted = ("grain_number", "grain_initial_height", "grain_outer_radius", "propellant_initial_mass", "thrust")
        if missing := [key for key in wanted if getattr(m, key, None) is None]:
            raise self._error("motor", f"has no {missing[0]}", "a SolidMotor")
        times, thrust = _table(m.thrust, float(m.burn_start_time), float(m.burn_out_time))
        number, height = int(m.grain_number), float(m.grain_initial_height)
        length = number * height + (number - 1) * float(m.grain_separation)
        middle = self.station(_at(self.rocket.center_of_propellant_position, times[0]))
        nozzle = self.station(self.rocket.nozzle_position)
        area, pressure = 0.0, getattr(m, "reference_pressure", None)
        if pressure is not None:
            area = math.pi * float(m.nozzle_radius) ** 2
            thrust = np.where(thrust > 0.0, thrust + float(pressure) * area, thrust)
            self.remarks.append(Remark("taken", "thrust", f"that at {pressure:g} Pa, corrected by the nozzle area"))
        else:
            self.remarks.append(Remark("assumed", "thrust", "without reference pressure: that at any altitude"))
        self.remarks.append(Remark("taken", "motor", f"{number} grains, {float(m.propellant_initial_mass):.4g} kg"))
        return Motor(
            "motor",
            times - times[0],
            thrust,
            float(m.propellant_initial_mass),
            0.0,
            middle - 0.5 * length,
            nozzle,
            float(m.grain_outer_radius),
            grain=(middle - 0.5 * length, middle + 0.5 * length),
            port_radius_m=float(m.grain_initial_inner_radius),
            exit_area_m2=area,
        )

    def _case(self) -> Piece:
        """Return the motor without propellant, with its inertia about its own centre of mass."""
        m = self.rocket.motor
        mass, at = float(m.dry_mass), self.station(self.rocket.motor_center_of_dry_mass_position)
        if mass <= 0.0:
            return Piece("motor without propellant", 0.0, at)
        roll = float(m.dry_I_33) / mass
        return Piece(
            "motor without propellant", mass, at, max(float(m.dry_I_11) / mass - 0.5 * roll, 0.0), roll, 0.5 * roll
        )

    def _fins(self, s: Any, station: float) -> FinSet | None:
        kind, name = _kind(s), str(getattr(s, "name", "fins"))
        if kind in ("NoseCone", "Tail", "RailButtons"):
            return None
        if kind not in ("TrapezoidalFins", "EllipticalFins"):
            raise self._error(name, f"is of the class {kind}", "NoseCone, Tail, TrapezoidalFins, EllipticalFins")
        if float(getattr(s, "cant_angle", 0.0) or 0.0) != 0.0:
            self.remarks.append(Remark("missing", name, "roll torque of canted fins"))
        radius, root, span, count = float(s.rocket_radius), float(s.root_chord), float(s.span), int(s.n)
        if kind == "TrapezoidalFins":
            return FinSet(name, count, root, float(s.tip_chord), span, float(s.sweep_length), station, radius)
        y = span * np.sin(np.linspace(0.0, 0.5 * math.pi, 2001))
        chord = root * np.sqrt(np.maximum(1.0 - (y / span) ** 2, 0.0))
        as_root, tip, sweep, shift = equivalent_trapezoid(y, 0.5 * (root - chord), chord)
        self.remarks.append(Remark("assumed", name, "trapezoid of the same area, span and mean chord"))
        return FinSet(name, count, as_root, tip, span, sweep, station + shift, radius)

    def _bodies(self, motor: Motor, fins: tuple[FinSet, ...]) -> tuple[Body, ...]:
        nose, length = self.nose, float(self.nose.length)
        kind = str(nose.kind).lower().replace(" ", "").replace("_", "")
        if kind not in _KINDS:
            raise self._error("nose", f"is {nose.kind}", ", ".join(_KINDS))
        if getattr(nose, "bluffness", None):
            self.remarks.append(Remark("missing", "nose", "bluffness"))
        shape, parameter = _KINDS[kind]
        if kind == "powerseries":
            parameter = float(nose.power)
        base, radius = float(nose.base_radius or self.rocket.radius), float(self.rocket.radius)
        out = [_body("nose", 0.0, length, 0.0, base, lambda x: SHAPES[shape](x, base, length, parameter))]
        tails = sorted(
            ((self.station(at), s) for s, at in self.surfaces if _kind(s) == "Tail"), key=lambda each: each[0]
        )
        ends = [motor.rear_station_m, *(f.leading_edge_station_m + f.root_chord_m for f in fins)]
        ends += [at + float(tail.length) for at, tail in tails]
        begin = length
        for at, tail in tails:
            if at > begin + 1e-9:
                out.append(_body("tube", begin, at, radius, radius))
            out.append(
                _body(
                    "tail", max(at, begin), at + float(tail.length), float(tail.top_radius), float(tail.bottom_radius)
                )
            )
            begin = at + float(tail.length)
        if max(ends) > begin + 1e-9:
            last = radius if not tails else float(tails[-1][1].bottom_radius)
            out.append(_body("rear tube", begin, max(ends), last, last))
        return tuple(out)


_POWERED = ("power_on_drag_by_mach", "power_on_drag")
_COASTING = ("power_off_drag_by_mach", "power_off_drag")


def _kind(surface: Any) -> str:
    return type(surface).__name__


def _at(function: Any, t: float) -> float:
    return float(function(t)) if callable(function) else float(function)


def _table(thrust: Callable[[float], float], begin_s: float, end_s: float) -> tuple[Array, Array]:
    """Return times and thrusts of a motor: the points of a table, or samples of a function."""
    points = getattr(thrust, "source", None)
    if isinstance(points, np.ndarray) and points.ndim == 2 and len(points) > 2:
        inside = (points[:, 0] >= begin_s - 1e-9) & (points[:, 0] <= end_s + 1e-9)
        times = points[inside, 0].astype(float)
    else:
        times = np.linspace(begin_s, end_s, _TIMES)
    values = np.array([max(float(thrust(t)), 0.0) for t in times])
    return times, values


def _body(
    name: str, front: float, rear: float, front_radius: float, rear_radius: float, profile: RadiusProfile | None = None
) -> Body:
    length = rear - front

    def cone(x: Array) -> Array:
        return front_radius + (rear_radius - front_radius) * x / length

    _, volume, side, middle = revolved(profile or cone, length, _WALL_m)
    ends = front, rear, front_radius, rear_radius
    return Body(name, *ends, volume.volume_m3, side, front + middle, _WALL_m, _MODULUS_Pa)
