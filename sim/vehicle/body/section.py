"""The schema of the mass, inertia and reference lengths of a vehicle in its file."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from maxq.sim.input.errors import refuse
from maxq.sim.input.tables_csv import Columns, CsvTable
from maxq.sim.input.values import NotNegative, Positive, Section, ThreeRows, optional

MASS_COLUMNS = Columns(
    "time_s",
    sets=(("mass_kg", "x_cg_m", "Ixx_kgm2", "Iyy_kgm2", "Izz_kgm2"),),
    optional=("y_cg_m", "z_cg_m", "Ixy_kgm2", "Ixz_kgm2", "Iyz_kgm2"),
    positive=("mass_kg", "Ixx_kgm2", "Iyy_kgm2", "Izz_kgm2"),
    begins_by=0.0,
)


RATE_DAMPING_COLUMNS = Columns("time_s", sets=(("x_Nms", "y_Nms", "z_Nms"),), begins_by=0.0)


_SYMMETRY = 1e-9


class Mass(Section):
    """The mass properties of the whole vehicle while this stage flies: a table, or constants."""

    table: Annotated[CsvTable, MASS_COLUMNS] | None = optional(
        "whole vehicle with frozen liquid, inertia about its CG, over the stage clock; x_cg_m is the station aft of "
        "the nose, y and z are body axes; products of inertia are integrals, Ixz = int x z dm"
    )
    mass_kg: Positive | None = optional("constant mass, or mass at ignition with mass_flow_kgps, kg")
    x_cg_m: float | None = optional("station of the CG aft of the nose, m")
    y_cg_m: float | None = optional("CG in body y, m (default 0)")
    z_cg_m: float | None = optional("CG in body z, m (default 0)")
    inertia_kgm2: ThreeRows | None = optional(
        "inertia tensor about the CG in B, with negative products off the diagonal, kg m2"
    )
    mass_flow_kgps: NotNegative | None = optional("mass expelled per second, kg/s (default 0)")
    burn_s: NotNegative | None = optional("duration of the mass flow, s")
    rate_damping: Annotated[CsvTable, RATE_DAMPING_COLUMNS] | None = optional(
        "damping moment per body rate about x, y and z, N m s/rad, over the stage clock; negative: destabilising"
    )

    def _check(self) -> None:
        if self.table is None:
            self._check_constants()
            return
        self.at_most_one("table", "mass_kg")
        constants = ("x_cg_m", "y_cg_m", "z_cg_m", "inertia_kgm2", "mass_flow_kgps", "burn_s")
        self.only_with(constants, False, "constant mass_kg")
        table = self.table
        x, y, z = diagonal = [table[f"I{a}{a}_kgm2"] for a in "xyz"]
        xy, xz, yz = (-table.get(f"I{a}_kgm2") for a in ("xy", "xz", "yz"))  # integrals, positive sign
        found = first_impossible(np.stack([x, xy, xz, xy, y, yz, xz, yz, z], axis=1).reshape(-1, 3, 3))
        if found:
            row, problem = found
            value = [float(moment[row]) for moment in diagonal]
            raise table.refusal(problem, column="Ixx_kgm2", row=row, value=value, at=("table",))

    def finely(
        self, ignition_s: float, interpolation: Literal["pchip", "linear"]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times of the stage clock (s) and the mass (kg) at these times, as interpolated in flight."""
        from maxq.control.kernel.tables import fit  # noqa: PLC0415  # lazy: it imports the compiler

        if self.table is None:
            spent = np.array([0.0, (self.mass_flow_kgps or 0.0) * (self.burn_s or 0.0)])
            return ignition_s + np.array([0.0, self.burn_s or 0.0]), (self.mass_kg or 0.0) - spent
        times, mass = self.table["time_s"], self.table["mass_kg"]
        fine = np.unique(np.concatenate([times, *(np.linspace(a, b, 65) for a, b in pairwise(times))]))
        return fine, fit(times, mass[:, None], interpolation).at(fine)[:, 0]

    def spent_s(self, ignition_s: float) -> float:
        """Return the time of the tables from which on the mass does not decrease; 0 for a constant mass."""
        times, rows = self.rows(ignition_s)
        falls = np.flatnonzero(np.diff(rows[:, 0]) < 0.0)
        return float(times[falls[-1] + 1]) if len(falls) else 0.0

    def rows(self, ignition_s: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times (n,) and rows (n, 10): mass, CG station, y, z, and integrals Ixx, Iyy, Izz, Ixy, Ixz, Iyz."""
        if self.table is not None:
            table = self.table
            names = ("y_cg_m", "z_cg_m"), ("Ixy_kgm2", "Ixz_kgm2", "Iyz_kgm2")
            rows = [table["mass_kg"], table["x_cg_m"], *[table.get(n) for n in names[0]]]
            rows += [table["Ixx_kgm2"], table["Iyy_kgm2"], table["Izz_kgm2"], *[table.get(n) for n in names[1]]]
            return table["time_s"], np.stack(rows, axis=1)
        assert self.mass_kg is not None
        assert self.x_cg_m is not None
        j = np.array(self.inertia_kgm2)
        row = np.array(
            [
                *(self.mass_kg, self.x_cg_m, self.y_cg_m or 0.0, self.z_cg_m or 0.0),
                *(j[0, 0], j[1, 1], j[2, 2], -j[0, 1], -j[0, 2], -j[1, 2]),
            ]
        )
        if not self.mass_flow_kgps or not self.burn_s:
            return np.array([0.0]), row[None]
        end = row.copy()
        end[0] -= self.mass_flow_kgps * self.burn_s
        return np.array([ignition_s, ignition_s + self.burn_s]), np.stack([row, end])

    def _check_constants(self) -> None:
        mass = self.needs("mass_kg", "mass needs a table or constants", "a number > 0")
        self.needs("x_cg_m", "mass_kg is given", "a number")
        inertia = np.array(self.needs("inertia_kgm2", "mass_kg is given", "a 3 x 3 tensor"))
        if np.abs(inertia - inertia.T).max() > _SYMMETRY * np.abs(inertia).max():
            raise refuse("an inertia tensor is symmetric", key="inertia_kgm2")
        found = first_impossible(0.5 * (inertia + inertia.T)[None])
        if found:
            raise refuse(found[1], key="inertia_kgm2")
        if (self.mass_flow_kgps is None) != (self.burn_s is None):
            missing = "burn_s" if self.burn_s is None else "mass_flow_kgps"
            raise refuse("required key is missing: they go together", "mass_flow_kgps and burn_s", missing)
        if self.mass_flow_kgps is not None and self.burn_s is not None:
            spent = self.mass_flow_kgps * self.burn_s
            if spent >= mass:
                raise refuse(f"expels {spent:g} kg of {mass:g} kg", f"burn_s * mass_flow_kgps < {mass:g}", ("burn_s",))


def joined(parts: Sequence[tuple[NDArray[np.float64], tuple[float, float]]]) -> NDArray[np.float64]:
    """Return the rows (n, 10) of `Mass.rows` of several bodies combined.

    Each part is the rows of a body and the position y, z (m) of its axis.
    """
    total = [moments(rows, place) for rows, place in parts]
    return about_centre(np.sum(total, axis=0))


def moments(rows: NDArray[np.float64], place: tuple[float, float]) -> NDArray[np.float64]:
    """Return mass, its first moments (aft, y, z) and its second-order integrals about the nose, (n, 10).

    The values of a vehicle are the sums over its bodies. `place`: y, z of the body's axis, m.
    """
    mass = rows[:, 0]
    aft, y, z = rows[:, 1], rows[:, 2] + place[0], rows[:, 3] + place[1]
    return np.column_stack([mass, mass * aft, mass * y, mass * z, rows[:, 4:] + mass[:, None] * squares(aft, y, z)])


def about_centre(total: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rows of `Mass.rows` from the sums of `moments`."""
    mass, (aft, y, z) = total[:, 0], total[:, 1:4].T / total[:, 0]
    return np.column_stack([mass, aft, y, z, total[:, 4:] - mass[:, None] * squares(aft, y, z)])


def squares(aft: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the second-order integrals of a unit point mass at a station and y, z in B, (n, 6)."""
    x = -aft
    return np.stack([y * y + z * z, x * x + z * z, x * x + y * y, x * y, x * z, y * z], axis=1)


_SLACK = 1e-9
"""The tolerance for rounding, relative to the largest principal moment."""


def first_impossible(inertia: NDArray[np.float64]) -> tuple[int, str] | None:
    """Return the index of the first impossible tensor of (n, 3, 3) and the reason, or None if all are possible.

    The principal moments of a body are positive, and none is larger than the sum of the other two.
    """
    moments = np.linalg.eigvalsh(inertia)
    smallest, largest = moments[:, 0], moments[:, 2]
    not_definite = smallest <= 0.0
    not_a_triangle = largest > smallest + moments[:, 1] + _SLACK * np.abs(largest)
    wrong = not_definite | not_a_triangle
    if not wrong.any():
        return None
    row = int(np.argmax(wrong))
    listed = ", ".join(f"{moment:.6g}" for moment in moments[row])
    if not_definite[row]:
        return row, f"no rigid body has this inertia: principal moments {listed} kg m2 are not all positive"
    return (
        row,
        f"no rigid body has this inertia: of the principal moments {listed} kg m2 one exceeds the sum of the others",
    )


def _first(*keys: str) -> Any:
    """Return the default factory of a field: the value of the first of `keys`, which are earlier fields."""

    def default(data: dict[str, Any]) -> float:
        return float(next((data[key] for key in keys if key in data), 1.0))

    return default


class Reference(Section):
    """The reference lengths of the aerodynamic coefficients."""

    length_m: Positive = Field(description="length of the vehicle, m")
    diameter_m: Positive = Field(description="diameter of the vehicle, m")
    area_m2: Positive = Field(description="reference area, m2")
    chord_m: Positive = Field(
        default_factory=_first("diameter_m"), description="pitch moment and damping length, m (default diameter_m)"
    )
    span_m: Positive = Field(
        default_factory=_first("chord_m"), description="roll moment and damping length, m (default chord_m)"
    )
    yaw_chord_m: Positive = Field(
        default_factory=_first("chord_m"), description="yaw moment and damping length, m (default chord_m)"
    )
