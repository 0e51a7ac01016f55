"""Tables of aerodynamic coefficients over Mach number and angles: conversion from the long format to a grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from maxq.sim.input.errors import Path
from maxq.sim.input.foreign import DATCOM
from maxq.sim.input.tables_csv import Columns, CsvTable

AXES = {
    "mach": (0.0, np.inf),
    "total_deg": (0.0, 180.0),
    "roll_deg": (-360.0, 720.0),
    "alpha_deg": (-180.0, 180.0),
    "beta_deg": (-90.0, 90.0),
}
"""The variables of a table and their bounds."""
FORCES = ("CA", "CX", "CD", "CY", "CN", "CZ", "CL")
MOMENTS = ("Cl", "Cm", "Cn")
RATES = ("Clp", "Clr", "Cmq", "Cnr", "Cnp", "CYp", "CYr", "CNq")
COEFFICIENT_COLUMNS = Columns("", grid=tuple(AXES), optional=(*FORCES, *MOMENTS, *RATES), foreign=DATCOM)
MOST_AXES = 3


@dataclass(frozen=True, eq=False)
class GridTable:
    """Coefficients over one to three variables, for all combinations of the variables' values."""

    axes: tuple[str, ...]  # in the order of AXES
    breaks: tuple[NDArray[np.float64], ...]  # breakpoints of each variable, increasing; angles in deg
    names: tuple[str, ...]
    values: NDArray[np.float64]  # (number of values of each variable ..., names)


def grid_table(table: CsvTable, at: Path = ()) -> GridTable:
    """Return the grid of a table whose columns have been checked; `at` is the path of its key.

    Rows may be in any order. Raises the refusal of the schema unless each combination of the variables' values has
    exactly one row and all values are allowed. A roll angle is periodic: a table over less than 360 deg is closed by
    its first value, and over 360 deg its ends must be equal.
    """
    made = table.derived
    if not isinstance(made, GridTable):
        made = _grid_table(table, at)
        table.keep(made)
    return made


def _grid_table(table: CsvTable, at: Path) -> GridTable:
    axes = tuple(name for name in AXES if name in table)
    _check_axes(table, axes, at)
    breaks, places = zip(*(np.unique(table[name], return_inverse=True) for name in axes), strict=True)
    shape = tuple(len(b) for b in breaks)
    hits = np.zeros(shape, dtype=np.int64)
    np.add.at(hits, places, 1)
    combination = " and ".join(axes)
    twice = hits[places] > 1
    table.refuse_where(twice, axes[-1], f"this {combination} appears twice", "one row for each combination", at=at)
    if (hits == 0).any():
        missing = np.argwhere(hits == 0)[0]
        where = ", ".join(f"{name} = {b[i]:g}" for name, b, i in zip(axes, breaks, missing, strict=True))
        rows = f"a complete grid: a row for each of {' x '.join(str(n) for n in shape)} combinations"
        raise table.refusal(f"has no row for {where}", rows, at=at)
    names = tuple(name for name in COEFFICIENT_COLUMNS.optional if name in table)
    values = np.empty((*shape, len(names)))
    for c, name in enumerate(names):
        values[(*places, c)] = table[name]
    if "roll_deg" in axes:
        breaks, values = _closed(table, axes, breaks, values, at)
    return GridTable(axes, tuple(breaks), names, values)


def _check_axes(table: CsvTable, axes: tuple[str, ...], at: Path) -> None:
    if len(axes) > MOST_AXES:
        raise table.refusal(f"has {len(axes)} axes", f"at most {MOST_AXES} of {', '.join(AXES)}", at=at)
    if "total_deg" in axes and ("alpha_deg" in axes or "beta_deg" in axes):
        raise table.refusal("total_deg cannot be combined with alpha_deg or beta_deg", "one or the other", at=at)
    if "roll_deg" in axes and "total_deg" not in axes:
        raise table.refusal("roll_deg has no meaning without total_deg", "total_deg with roll_deg", at=at)
    for name in axes:
        low, high = AXES[name]
        outside = (table[name] < low) | (table[name] > high)
        table.refuse_where(outside, name, f"is outside {low:g} .. {high:g}", f"{low:g} .. {high:g}", at=at)


def _closed(
    table: CsvTable,
    axes: tuple[str, ...],
    breaks: tuple[NDArray[np.float64], ...],
    values: NDArray[np.float64],
    at: Path,
) -> tuple[tuple[NDArray[np.float64], ...], NDArray[np.float64]]:
    """Return the table with the first value of the roll angle repeated at its end."""
    k = axes.index("roll_deg")
    roll = breaks[k]
    turn = roll[-1] - roll[0]
    first, last = values.take([0], axis=k), values.take([-1], axis=k)
    if turn > 360.0:
        raise table.refusal(f"roll_deg covers {turn:g} deg", "at most 360 deg", at=at)
    if turn == 360.0:
        if (first != last).any():
            raise table.refusal(
                f"differs between roll_deg = {roll[0]:g} and {roll[-1]:g}", "the same values, 360 deg apart", at=at
            )
        return breaks, values
    longer = np.append(roll, roll[0] + 360.0)
    return (*breaks[:k], longer, *breaks[k + 1 :]), np.concatenate([values, first], axis=k)
