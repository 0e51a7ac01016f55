"""The variables of a law that a case fixes or bounds: `[[variable]]` of the case file.

A name selects variables of `LawVariables.names`: one variable ("k_p at 35 s"), all of one kind ("k_p",
"quadratic[0].zero_hz"), a section of the filter ("quadratic[0]"), or a group of `GROUPS`. A later entry has priority
over an earlier one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from maxq.control.kernel.records import Array, IntArray
from maxq.control.structures import OWN
from maxq.design.laws.schedule import UnsolvableError

if TYPE_CHECKING:
    from maxq.design.case.schema import VariableSection

GROUPS = {"gains": ("k_", OWN), "filter": ("quadratic[", "first_order["), "blend": ("weight of gyro ",)}
"""The beginnings of the names of variables in each group."""


def kind_of(variable: str) -> str:
    """Return the name of a variable without its point in the schedule, such as "k_p" of "k_p at 35 s"."""
    return variable.split(" at ", maxsplit=1)[0]


def is_logarithmic(variable: str) -> bool:
    """Return True for a variable that is the logarithm of the quantity in its name."""
    return kind_of(variable).endswith("_hz") or variable.startswith(GROUPS["gains"])


def in_units(variable: str, value: float) -> float:
    """Return the value of a variable in the unit of its name."""
    return math.exp(value) if is_logarithmic(variable) else value


def selected(name: str, names: Sequence[str]) -> IntArray:
    """Return the indices of the variables that a name selects. Raises UnsolvableError if there is none."""
    beginnings = GROUPS.get(name, ())

    def meant(variable: str) -> bool:
        kind = kind_of(variable)
        return name in (variable, kind) or kind.startswith((f"{name}.", *beginnings))

    found = np.array([k for k, variable in enumerate(names) if meant(variable)], np.int64)
    if not len(found):
        kinds = ", ".join([*GROUPS, *dict.fromkeys(map(kind_of, names))])
        raise UnsolvableError(f"variable.name = {name!r}: is not a variable of the case; allowed are {kinds}")
    return found


def bounded(given: Sequence[VariableSection], names: Sequence[str], lower: Array, upper: Array) -> tuple[Array, Array]:
    """Return the bounds of the variables, replaced by the bounds of a case where it has any.

    A fixed variable has equal bounds. Entries with `from_start` must have been replaced by values. Raises
    UnsolvableError for an unknown name, and for a frequency or gain that is not positive.
    """
    lower, upper = lower.copy(), upper.copy()
    for one in given:
        ends = one.ends
        for k in selected(one.name, names):
            if is_logarithmic(names[k]) and ends[0] <= 0.0:
                raise UnsolvableError(f"variable.name = {one.name!r}: {ends[0]:g} is not above 0")
            lower[k], upper[k] = (math.log(end) if is_logarithmic(names[k]) else end for end in ends)
    return lower, upper
