"""Tables of given samples: a CSV file of numbers whose columns may have any name."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import GetJsonSchemaHandler
from pydantic_core import CoreSchema, core_schema

from maxq.sim.scenario.documents import Text
from maxq.sim.scenario.errors import refuse


@dataclass(frozen=True, eq=False)
class SampleTable:
    """Columns of numbers of equal length, by name."""

    columns: Mapping[str, NDArray[np.float64]]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    @property
    def only(self) -> str:
        """The name of the only column; empty where there are several."""
        return next(iter(self.columns)) if len(self.columns) == 1 else ""

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: Any) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(_validate)

    @classmethod
    def __get_pydantic_json_schema__(cls, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        numbers = {"type": "array", "items": {"type": "number"}, "minItems": 1}
        return {"anyOf": [{"type": "string"}, {"type": "object", "additionalProperties": numbers}]}


def _validate(value: Any, info: core_schema.ValidationInfo) -> SampleTable:
    if isinstance(value, SampleTable):
        return value
    if isinstance(value, Mapping):
        columns = {str(name): np.array(numbers, dtype=float) for name, numbers in value.items()}
        return _checked(columns, "")
    if not isinstance(value, Text) or info.context is None:
        raise refuse("is no table of samples", "the name of a CSV file with a line of column names")
    shown, text = info.context.read_table(value)
    lines = [line for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if not lines:
        raise refuse("the file is empty", "a line of column names, then lines of numbers", file=shown)
    names = [cell.strip() for cell in lines[0].split(",")]
    rows = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            row = [float(cell) for cell in line.split(",")]
        except ValueError:
            raise refuse("holds what is no number", "numbers", value=line, file=shown, place=f"row {number}") from None
        if len(row) != len(names):
            raise refuse(f"has {len(row)} columns, the first line has {len(names)}", file=shown, place=f"row {number}")
        rows.append(row)
    numbers = np.array(rows, dtype=float).reshape(len(rows), len(names))
    return _checked({name: numbers[:, i].copy() for i, name in enumerate(names)}, shown)


def _checked(columns: dict[str, NDArray[np.float64]], shown: str) -> SampleTable:
    if not columns or min(len(column) for column in columns.values()) == 0:
        raise refuse("has no samples", "one row of numbers or more", file=shown)
    for name, column in columns.items():
        if not np.isfinite(column).all():
            raise refuse("holds what is not finite", "finite numbers", file=shown, place=name)
        column.flags.writeable = False
    return SampleTable(columns)
