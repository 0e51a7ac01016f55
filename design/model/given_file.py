"""Files of published derivatives over time (scenarios/points/), and the operating points that they define."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from maxq.control.kernel.limits import MAX_LATENCY
from maxq.design.model.given import GivenMode, GivenPoint, PlaneCoefficients, given_instruments, of_coefficients, still
from maxq.design.model.instruments import Plane
from maxq.sim.input.errors import refuse
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import NotNegative, Positive, Section, optional
from maxq.sim.scenario.loader import load_file
from maxq.sim.vehicle.actuator.kernel import Actuator
from maxq.sim.vehicle.sensor.gyro import Gyro, pack_gyro

_COEFFICIENTS = ("V_mps", "A6_1ps2", "K1_1ps2", "a1_1ps", "a3_mps2", "a4_mps2")
_MODE = ("omega_radps", "phi_gimbal_1pkg", "phi_gyro", "slope_gyro_1pm")
_PLANT_COLUMNS = Columns(
    "time_s", sets=(_COEFFICIENTS,), optional=("control_thrust_N", "dynamic_pressure_Pa"), not_negative=("V_mps",)
)
_MODE_COLUMNS = Columns(
    "time_s",
    sets=(_MODE,),
    optional=("zeta", "rotation_1pms2", "translation_1ps2"),
    positive=("omega_radps",),
    not_negative=("zeta",),
)


class GivenModeSection(Section):
    """A bending mode over time. Its displacement eta may have any scale."""

    table: Annotated[CsvTable, _MODE_COLUMNS] = Field(
        description="omega_radps; phi_gimbal_1pkg (shape at the gimbal over the generalised mass); phi_gyro and "
        "slope_gyro_1pm (shape and slope at the instruments); optional: zeta, rotation_1pms2 and translation_1ps2 (the "
        "rotational and lateral acceleration per eta of a thrust line that follows the bent body)"
    )
    zeta: NotNegative = optional("damping ratio, if the table has none", 0.005)


class GivenActuator(Section):
    """The actuator, with one or two pole pairs."""

    omega_radps: tuple[Positive, ...] = Field(description="natural frequencies, rad/s", min_length=1, max_length=2)
    zeta: tuple[Positive, ...] = Field(description="damping ratios in the same order", min_length=1, max_length=2)

    def _check(self) -> None:
        if len(self.zeta) != len(self.omega_radps):
            raise refuse(f"has {len(self.zeta)} numbers", f"a list of {len(self.omega_radps)}, as omega_radps", "zeta")

    def record(self) -> Actuator:
        """Return the parameters of the linear actuator."""
        omega, zeta = ((*x, *[1.0] * (4 - len(x))) for x in (self.omega_radps, self.zeta))
        none = math.inf
        w_1, w_2, w_3, w_4 = omega
        z_1, z_2, z_3, z_4 = zeta
        order = 2 * len(self.zeta)
        return Actuator(w_1, w_2, w_3, w_4, z_1, z_2, z_3, z_4, none, none, 0.0, 0.0, 0, order, 0, none)


class GivenSensor(Section):
    """A gyro or an accelerometer with one pole pair."""

    omega_radps: Positive = Field(description="natural frequency, rad/s")
    zeta: Positive = Field(description="damping ratio")

    def record(self) -> Gyro:
        """Return the parameters of the sensor, without errors."""
        ideal = pack_gyro(None, ideal=True)
        return type(ideal)(**{**vars(ideal), "omega_radps": self.omega_radps, "zeta": self.zeta, "ideal": 0})


class GivenAccelerometer(GivenSensor):
    """The accelerometer, at the station of the gyro."""

    latency_samples: Annotated[int, Field(ge=0, le=MAX_LATENCY)] = optional("delay of the output, samples", 0)


class GivenComputer(Section):
    """The timing of the flight computer."""

    sample_s: NotNegative = optional("sample period, s; 0: none, the loop is continuous", 0.0)
    delay_s: NotNegative = optional("delay from a sample to its command, s; may be longer than a sample", 0.0)


class GivenPoints(Section):
    """The contents of a file of published derivatives over time."""

    schema_version: Literal[1] = optional("version of the format", 1, alias="schema")
    name: str = optional("name of the vehicle", "")
    description: str = optional("description, one sentence", "")
    source: str = optional("publication from which the numbers are", "")
    plane: Plane = optional("plane of the coefficients", "pitch")
    coefficients: Annotated[CsvTable, _PLANT_COLUMNS] = Field(
        description="V_mps and the coefficients of docs/model.md, linear between rows; control_thrust_N for the modes; "
        "dynamic_pressure_Pa for loads in wind"
    )
    mode: tuple[GivenModeSection, ...] = optional("bending modes in rising order of frequency", ())
    actuator: GivenActuator | None = optional("absent: ideal")
    gyro: GivenSensor | None = optional("absent: ideal")
    accelerometer: GivenAccelerometer | None = optional("absent: ideal")
    computer: GivenComputer = GivenComputer()

    def _check(self) -> None:
        if self.mode and "control_thrust_N" not in self.coefficients:
            raise self.coefficients.refusal(
                "a mode needs the thrust that excites it", "a column control_thrust_N", at=("coefficients",)
            )

    @property
    def times_s(self) -> tuple[float, ...]:
        """Return the times of the rows at which all tables have values and the speed is positive, s."""
        first, last = self._span_s
        rows = zip(self.coefficients["time_s"].tolist(), self.coefficients["V_mps"].tolist(), strict=True)
        return tuple(t for t, speed in rows if first <= t <= last and speed > 0.0)

    @property
    def _span_s(self) -> tuple[float, float]:
        tables = [self.coefficients, *(mode.table for mode in self.mode)]
        return max(float(t["time_s"][0]) for t in tables), min(float(t["time_s"][-1]) for t in tables)

    def point(self, time_s: float) -> GivenPoint:
        """Return the operating point at a time. Raises ValueError for a time outside the tables and for zero speed."""
        first, last = self._span_s
        if not first <= time_s <= last:
            raise ValueError(f"node at {time_s:g} s: {self.name or 'the table'} holds {first:g} s to {last:g} s")

        def at(table: CsvTable, name: str, default: float = 0.0) -> float:
            return float(np.interp(time_s, table["time_s"], table.get(name, default)))

        modes = tuple(
            GivenMode(
                **{name: at(mode.table, name) for name in (*_MODE, "rotation_1pms2", "translation_1ps2")},
                zeta=at(mode.table, "zeta", mode.zeta),
            )
            for mode in self.mode
        )
        values = {name: at(self.coefficients, name) for name in (*_COEFFICIENTS, "control_thrust_N")}
        given = PlaneCoefficients(**values, modes=modes)
        try:
            plant = given.plant()
        except ValueError as problem:
            raise ValueError(f"node at {time_s:g} s: {problem}") from None
        accelerometer = self.accelerometer
        empty = GivenPoint(
            time_s=time_s,
            condition=still(
                time_s, given.V_mps, at(self.coefficients, "dynamic_pressure_Pa", math.nan), -given.a4_mps2
            ),
            instruments=given_instruments(
                self.computer.sample_s,
                self.computer.delay_s,
                None if self.actuator is None else self.actuator.record(),
                None if self.gyro is None else self.gyro.record(),
                None if accelerometer is None else accelerometer.record(),
                accelerometer.latency_samples if accelerometer else 0,
            ),
            plane=self.plane,
            label=f"{time_s:g} s",
            speed_mps=given.V_mps,
            given=plant,
        )
        return of_coefficients(empty, given)


@dataclass(frozen=True)
class PointList:
    """Operating points in the place of a file of derivatives, in rising order of time.

    Raises ValueError without a point, for points of two planes, and for times that do not rise.
    """

    points: tuple[GivenPoint, ...]
    name: str = "given points"

    def __post_init__(self) -> None:
        planes = {point.plane for point in self.points}
        rising = all(a.time_s < b.time_s for a, b in pairwise(self.points))
        if len(planes) != 1 or not rising:
            raise ValueError(f"points: {len(self.points)} given; allowed are points of one plane with rising time_s")

    @property
    def plane(self) -> Plane:
        return self.points[0].plane

    @property
    def times_s(self) -> tuple[float, ...]:
        return tuple(point.time_s for point in self.points)

    def point(self, time_s: float) -> GivenPoint:
        """Return the operating point at a time. Raises ValueError for a time that no point has."""
        found = [point for point in self.points if point.time_s == time_s]
        if not found:
            times = ", ".join(f"{t:g}" for t in self.times_s)
            raise ValueError(
                f"node at {time_s:g} s: {self.name} are at {times} s only; allowed is between_nodes = 'ignore'"
            )
        return found[0]


def read_points(name: str | Path, overrides: Iterable[str] = ()) -> GivenPoints:
    """Read a file of derivatives, or a built-in file, with `key=value` overrides. Raises ScenarioError."""
    return load_file(GivenPoints, "points", name, overrides)[0]


def given_points(
    file: GivenPoints | PointList | str | Path, times_s: Iterable[float] | None = None, overrides: Iterable[str] = ()
) -> list[GivenPoint]:
    """Return the operating points of a file of derivatives at times (s), by default at all of its rows.

    Raises ScenarioError, and ValueError for a time outside the tables or with zero speed.
    """
    read = file if isinstance(file, GivenPoints | PointList) else read_points(file, overrides)
    return [read.point(float(t)) for t in (read.times_s if times_s is None else times_s)]
