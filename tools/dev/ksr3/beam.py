"""Free-free bending: Euler-Bernoulli elements with cubic shapes, engine locked to the tail, sloshing masses
removed.

No shear, no rotary inertia, no joint compliance beyond EI. Mode shapes are 1 at the gimbal; slope is
d(phi)/d(x_n).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from maxq.control.kernel.records import Array
from maxq.tools.dev.ksr3 import assumptions as a
from maxq.tools.dev.ksr3.mass_model import Part, dry_parts, fills
from maxq.tools.dev.ksr3.propulsion import Burn
from maxq.tools.dev.ksr3.slosh import slosh_mass_kg

NODES_M = np.linspace(0.0, a.GIMBAL_STATION_M, a.BEAM_ELEMENTS + 1)
ELEMENT_M = float(NODES_M[1])
MIDDLES_M = (NODES_M[:-1] + NODES_M[1:]) / 2
# Rear end of a section, EI there in N m2 before scaling: shell, avionics bay, fuel tank (thick pressure-fed
# wall), pressurant bay, LOX tank, aft skirt.
SECTIONS = ((3.5, 0.50e8), (5.6, 1.60e8), (8.0, 0.55e8), (11.25, 1.60e8), (a.GIMBAL_STATION_M, 0.55e8))
NOSE_CONE_M = 2.5


@dataclass(frozen=True)
class Mode:
    """One free-free mode at the nodes of the beam."""

    frequency_hz: float
    generalized_mass_kg: float
    phi: Array
    slope_pm: Array


def bending_stiffness_Nm2(station_m: float) -> float:
    if station_m < NOSE_CONE_M:
        return 0.10e8 + 0.40e8 * station_m / NOSE_CONE_M
    return next(stiffness for end, stiffness in SECTIONS if station_m < end)


def shell_strength_N(stiffness_scale: float, station_m: float) -> float:
    """Axial load at the allowable stress of a thin shell with the beam's EI (area 2 pi R t, EI = E pi R^3 t)."""
    stiffness = stiffness_scale * bending_stiffness_Nm2(station_m)
    return 2.0 * stiffness * a.SHELL_STRESS_PA / (a.SHELL_MODULUS_PA * (a.DIAMETER_M / 2) ** 2)


def line_density_kgpm(parts: list[Part]) -> Array:
    """Mass per length of each element; a part is spread over the elements it overlaps."""
    density = np.zeros(a.BEAM_ELEMENTS)
    for part in parts:
        rear = min(part.rear_station_m, a.GIMBAL_STATION_M)
        front = part.front_station_m
        overlap = np.clip(np.minimum(NODES_M[1:], rear) - np.maximum(NODES_M[:-1], front), 0.0, None)
        if part.mass_kg > 0:
            density += part.mass_kg * overlap / overlap.sum() / ELEMENT_M
    return density


def structure_and_liquid(burn: Burn, t: float, *, sloshing: bool) -> list[Part]:
    """What rides on the beam, engine apart; `sloshing` keeps the pendulum masses in their liquid columns."""
    parts = dry_parts(burn)
    for fill in fills(burn, t):
        mass = fill.mass_kg - (0.0 if sloshing else slosh_mass_kg(fill))
        parts.append(Part(mass, fill.surface_station_m, fill.tank.bottom_station_m, 0.0))
    return parts


def mass_forward_kg(burn: Burn, t: float) -> Array:
    """Mass forward of each node, all liquid included: times the acceleration it is the axial force there."""
    density = line_density_kgpm(structure_and_liquid(burn, t, sloshing=True))
    return np.concatenate([[0.0], np.cumsum(density * ELEMENT_M)])


def modes(burn: Burn, t: float, stiffness_scale: float, count: int = a.MODE_COUNT) -> list[Mode]:
    """The first `count` bending modes at time t."""
    density = line_density_kgpm(structure_and_liquid(burn, t, sloshing=False))
    stiffness = stiffness_scale * np.array([bending_stiffness_Nm2(float(x)) for x in MIDDLES_M])
    k, m = assemble(stiffness, density)
    _lock_engine(m)
    squares, vectors = eigh(k, m, subset_by_index=[2, 1 + count])  # 0 and 1 are the rigid motions
    return [_mode(w2, vectors[:, i], m) for i, w2 in enumerate(squares)]


def fit_stiffness(burn: Burn) -> float:
    """Scale of EI that puts the first mode at 9 Hz at lift-off."""
    return (a.FIRST_MODE_HZ / modes(burn, 0.0, 1.0, count=1)[0].frequency_hz) ** 2


def assemble(stiffness_Nm2: Array, density_kgpm: Array) -> tuple[Array, Array]:
    """Stiffness and consistent mass matrices over (displacement, slope) of each node."""
    h = ELEMENT_M
    k_unit = np.array(
        [[12, 6 * h, -12, 6 * h], [6 * h, 4 * h * h, -6 * h, 2 * h * h],
         [-12, -6 * h, 12, -6 * h], [6 * h, 2 * h * h, -6 * h, 4 * h * h]]
    ) / h**3  # fmt: skip  # seven more lines otherwise
    m_unit = np.array(
        [[156, 22 * h, 54, -13 * h], [22 * h, 4 * h * h, 13 * h, -3 * h * h],
         [54, 13 * h, 156, -22 * h], [-13 * h, -3 * h * h, -22 * h, 4 * h * h]]
    ) * h / 420  # fmt: skip  # eight more lines otherwise
    size = 2 * len(NODES_M)
    k, m = np.zeros((size, size)), np.zeros((size, size))
    for e in range(a.BEAM_ELEMENTS):
        span = slice(2 * e, 2 * e + 4)
        k[span, span] += stiffness_Nm2[e] * k_unit
        m[span, span] += density_kgpm[e] * m_unit
    return k, m


def _lock_engine(m: Array) -> None:
    """Adds the engine as a rigid body behind the last node."""
    moment = a.ENGINE_MASS_KG * a.ENGINE_CG_BEHIND_GIMBAL_M
    m[-2, -2] += a.ENGINE_MASS_KG
    m[-1, -1] += a.ENGINE_MASS_KG * a.ENGINE_GYRATION_M2 + moment * a.ENGINE_CG_BEHIND_GIMBAL_M
    m[-2, -1] += moment
    m[-1, -2] += moment


def _mode(omega_squared: float, vector: Array, m: Array) -> Mode:
    shape = vector / vector[-2]
    return Mode(float(np.sqrt(omega_squared) / (2 * np.pi)), float(shape @ m @ shape), shape[0::2], shape[1::2])
