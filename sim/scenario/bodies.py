"""Which inertia a body can have."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_SLACK = 1e-9
"""Rounding that is forgiven, relative to the largest principal moment."""


def tensors(diagonal: NDArray[np.float64], products: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inertia tensors (n, 3, 3) from Ixx, Iyy, Izz (n, 3) and the integrals Ixy, Ixz, Iyz (n, 3), positive
    sign.
    """
    out = np.zeros((len(diagonal), 3, 3))
    for axis in range(3):
        out[:, axis, axis] = diagonal[:, axis]
    for column, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        out[:, i, j] = out[:, j, i] = -products[:, column]
    return out


def first_impossible(inertia: NDArray[np.float64]) -> tuple[int, str] | None:
    """Row of the first tensor of (n, 3, 3) that no body can have, and why; None when all are possible.

    A body's principal moments are positive, and none is larger than the sum of the other two.
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
        return row, f"no body has this inertia: principal moments {listed} kg m2 are not all positive"
    return (row, f"no body has this inertia: of the principal moments {listed} kg m2 one exceeds the other two's sum")
