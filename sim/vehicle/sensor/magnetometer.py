"""The magnetometer: the Earth's magnetic field in body axes, at each sample, with bias, misalignment and noise.

The field is that of the dipole of IGRF-13 for 2020 (Alken et al., Earth, Planets and Space 73, 49, 2021), centred in
the Earth and fixed to it. It differs from the complete field by about a tenth.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import numpy as np

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.noise import standard_normal
from maxq.control.kernel.records import Array
from maxq.control.kernel.vectors import Matrix, Vector, add, cross, norm, rotate_back, scaled, vector_at
from maxq.sim.vehicle.faults import MAGNETOMETER_ADDED, MAGNETOMETER_DEAD, MAGNETOMETER_STUCK

if TYPE_CHECKING:
    from maxq.sim.vehicle.sensor.section import MagnetometerSection

MAGNETOMETER_STREAM = 88  # streams of the noise generator, one for each axis
DIPOLE_T = (-1450.9e-9, 4652.5e-9, -29404.8e-9)  # g_1^1, h_1^1, g_1^0 along x, y, z of E, at the reference radius
REFERENCE_m = 6371200.0


@dataclass(frozen=True)
class Magnetometer:
    """The parameters of the magnetometer, in B. `on`: 0 without one."""

    on: int = 0
    bias_T: Annotated[Array, (3,)] = field(default_factory=lambda: np.zeros(3))
    misalignment_rad: Annotated[Array, (3,)] = field(default_factory=lambda: np.zeros(3))
    noise_T: float = 0.0


def pack_magnetometer(given: MagnetometerSection | None) -> Magnetometer:
    if given is None:
        return Magnetometer()
    turned = np.radians(given.misalignment_deg)
    return Magnetometer(1, 1e-9 * np.array(given.bias_nT), turned, 1e-9 * given.noise_nT)


@kernel
def dipole_field(x: float, y: float, z: float) -> Vector:
    """Return the field at a position in E (m), in E, T: the gradient -grad(a^3 g.r / r^3) of the dipole g."""
    radius = norm((x, y, z))
    k = (REFERENCE_m / radius) ** 3
    along = 3.0 * (DIPOLE_T[0] * x + DIPOLE_T[1] * y + DIPOLE_T[2] * z) / (radius * radius)
    return (k * (along * x - DIPOLE_T[0]), k * (along * y - DIPOLE_T[1]), k * (along * z - DIPOLE_T[2]))


@routine
def measure_field(
    m: Magnetometer, field_I_T: Vector, rotation: Matrix, seed: int, sample: int, faults: Array, out: Array
) -> None:
    """Write the output in body axes, T, to `out`; a stuck sensor keeps it."""
    if faults[MAGNETOMETER_STUCK] > 0.0:
        return
    true = rotate_back(rotation, field_I_T)
    seen = add(true, scaled(-1.0, cross(vector_at(m.misalignment_rad, 0), true)))
    for axis in range(3):
        out[axis] = seen[axis] + m.bias_T[axis] + faults[MAGNETOMETER_ADDED + axis]
        if m.noise_T > 0.0:
            out[axis] += m.noise_T * standard_normal(seed, MAGNETOMETER_STREAM + axis, sample)
        if faults[MAGNETOMETER_DEAD] > 0.0:
            out[axis] = 0.0
