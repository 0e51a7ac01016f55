"""Columns of the data set equal pyarrow's conversion."""

from __future__ import annotations

import math
import subprocess
import sys
from typing import Any

import numpy as np
import pyarrow as pa
import pytest

from maxq.sim.campaign.runs import array_of

COLUMNS: list[tuple[pa.DataType, list[Any]]] = [
    (pa.float64(), [1.5, -0.0, math.inf, 5e-324]),
    (pa.float64(), [1.5, None, 0.0, None, *([2.5] * 20)]),
    (pa.int64(), [0, -(2**63), 2**63 - 1]),
    (pa.int64(), [None, 3]),
    (pa.int32(), [0, -7, 2**31 - 1]),
    (pa.bool_(), [True, False, True, *([False] * 9), True]),
    (pa.string(), ["", "liquid oxygen", "Größe", "日本\n"]),
    (pa.string(), [None, "a", None]),
    (pa.list_(pa.float32()), [np.arange(3, dtype=np.float32), np.zeros(0, np.float32), np.ones(1, np.float32)]),
]


@pytest.mark.parametrize(("kind", "values"), COLUMNS)
def test_as_pyarrow_does_it(kind: pa.DataType, values: list[Any]) -> None:
    found, expected = array_of(values, kind), pa.array(values, kind)
    found.validate(full=True)
    assert found.equals(expected)
    assert found.null_count == expected.null_count
    assert array_of([], kind).equals(pa.array([], kind))


def test_bits_of_numbers_are_kept() -> None:
    values = [-0.0, math.nan, 5e-324, 0.1]
    assert np.asarray(array_of(values, pa.float64())).tobytes() == np.array(values).tobytes()


@pytest.mark.slow
def test_without_pandas() -> None:
    """The data set does not import pandas, which takes as long as five flights."""
    code = (
        "import sys, pyarrow as pa; from maxq.sim.campaign.runs import array_of\n"
        "array_of([1.0, None], pa.float64()); array_of(['a'], pa.string()); sys.exit('pandas' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
