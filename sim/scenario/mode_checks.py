"""What mode tables must satisfy to be mode shapes: refused where they cannot be, doubted where they are unlikely.

Limits are set by what a good table shows. KSR-III's (44 stations, 3 modes, 25 times, from a finite-element beam):
slopes deviate from the shapes' derivative by 0.8 % at most, successive times agree to a modal assurance criterion of
0.997 and frequencies to 2 %, and the mass forward gives 0.77 to 0.88 of the generalised masses, because the engine's
inertia is not in it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from maxq.sim.scenario.errors import Path
from maxq.sim.scenario.tables_csv import CsvTable

Floats = NDArray[np.float64]

SLOPE_DEVIATION, ASSURANCE, FREQUENCY_STEP, MASS_RATIO, ORTHOGONALITY = 0.2, 0.8, 0.3, 3.0, 0.1
"""Beyond these a table is doubted; see `doubts`."""


class Shapes(Protocol):
    """A mode table as these checks see it."""

    @property
    def time_s(self) -> Floats: ...
    @property
    def station_m(self) -> Floats: ...
    @property
    def frequency_hz(self) -> Floats: ...  # (T, M)
    @property
    def generalized_mass_kg(self) -> Floats: ...  # (T, M)
    @property
    def mass_forward_kg(self) -> Floats: ...  # (T, S)
    @property
    def moved(self) -> Floats:
        """Displacements of each mode, side by side (T, M, k S)."""
        ...

    @property
    def displaced(self) -> Floats:
        """The same without what rotations add."""
        ...

    @property
    def bent(self) -> tuple[tuple[Floats, Floats], ...]:
        """Lateral displacement (T, M, S) and what should be its derivative over the stations."""
        ...

    @property
    def products(self) -> Floats | None:
        """Sum of mass times shape times shape, (T, M, M), where masses are given at the stations."""
        ...


def refuse_impossible(table: CsvTable, modes: Shapes, at: Path) -> None:
    """Raises the schema's refusal for slopes that are not those of the shapes, and for shapes that swap or flip."""
    slope, _ = _slopes(modes)
    if (slope < 0.0).any():
        t, m = (int(i) for i in np.argwhere(slope < 0.0)[0])
        raise table.refusal(
            f"slope of mode {m + 1} at time_s = {modes.time_s[t]:g} has the opposite sign of the shape's derivative "
            f"(correlation {slope[t, m]:.2f})",
            "d(phi)/d(station_m), station_m aft of the nose: slope_pm, theta_y_pm = d(phi_z), theta_z_pm = -d(phi_y)",
            at=at,
        )
    alike = _alike(modes)
    for t, matrix in enumerate(alike):
        span = f"between time_s = {modes.time_s[t]:g} and {modes.time_s[t + 1]:g}"
        for m, row in enumerate(np.abs(matrix)):
            other = int(np.argmax(row))
            if other != m and row[other] ** 2 > ASSURANCE:
                raise table.refusal(
                    f"mode {m + 1} becomes mode {other + 1} {span}", "one number for a shape at all times", at=at
                )
            if matrix[m, m] ** 2 > ASSURANCE and matrix[m, m] < 0.0:
                raise table.refusal(f"mode {m + 1} changes its sign {span}", "shapes that change continuously", at=at)
    products = modes.products
    if products is not None:
        own, across = _orthonormality(products, modes.generalized_mass_kg)
        if (np.abs(np.log(own)) > np.log(2.0)).any() or (across > 0.5).any():
            raise table.refusal(
                f"with the masses at the stations the shapes' products are {own.min():.3g} to {own.max():.3g} of the "
                f"generalised masses, and up to {across.max():.2f} between modes",
                "1 and 0: orthogonal modes",
                at=at,
            )


def doubts(modes: Shapes) -> list[str]:
    """What is unlikely in a table, a sentence each."""
    out = []
    slope, deviation = _slopes(modes)
    if (deviation > SLOPE_DEVIATION).any():
        t, m = _largest(deviation)
        out.append(
            f"slope of mode {m + 1} at {modes.time_s[t]:g} s deviates by {100 * deviation[t, m]:.0f} % from the "
            f"shape's derivative (correlation {slope[t, m]:.3f})"
        )
    if (np.diff(modes.frequency_hz, axis=1) < 0.0).any():
        t, m = (int(i) for i in np.argwhere(np.diff(modes.frequency_hz, axis=1) < 0.0)[0])
        out.append(f"frequencies of modes {m + 1} and {m + 2} at {modes.time_s[t]:g} s are not in rising order")
    jump = np.abs(np.diff(np.log(modes.frequency_hz), axis=0))
    if (jump > np.log(1.0 + FREQUENCY_STEP)).any():
        t, m = _largest(jump)
        out.append(
            f"frequency of mode {m + 1} changes from {modes.frequency_hz[t, m]:.3g} to "
            f"{modes.frequency_hz[t + 1, m]:.3g} Hz between {modes.time_s[t]:g} and {modes.time_s[t + 1]:g} s"
        )
    for t, matrix in enumerate(_alike(modes)):
        own = np.diag(matrix) ** 2
        if (own < ASSURANCE).any():
            m = int(np.argmin(own))
            out.append(
                f"shape of mode {m + 1} changes much between {modes.time_s[t]:g} and {modes.time_s[t + 1]:g} s "
                f"(modal assurance criterion {own[m]:.2f})"
            )
            break
    return out + _mass_doubts(modes)


def _mass_doubts(modes: Shapes) -> list[str]:
    if not modes.mass_forward_kg.any():
        return [
            "mass_forward_kg is 0 everywhere: the axial load does not soften these modes"
            + ("" if modes.products is not None else ", and their generalised masses and orthogonality are unchecked")
        ]
    products, given = modes.products, modes.generalized_mass_kg
    if products is not None:
        own, across = _orthonormality(products, given)
        if max(np.abs(own - 1.0).max(), across.max()) > ORTHOGONALITY:
            return [
                f"with the masses at the stations the shapes' products are {own.min():.3g} to {own.max():.3g} of the "
                f"generalised masses, and up to {across.max():.2f} between modes"
            ]
        return []
    between = np.maximum(np.diff(modes.mass_forward_kg, axis=1), 0.0)
    if not between.any():
        return []
    square = modes.displaced.reshape(*given.shape, -1, len(modes.station_m)) ** 2
    middle = 0.5 * (square[..., 1:] + square[..., :-1]).sum(axis=2)
    ratio = (middle * between[:, None, :]).sum(axis=-1) / given
    ratio = np.where(twisting(modes), np.maximum(ratio, 1.0), ratio)  # its inertia about x is not known
    if ratio.max() > MASS_RATIO or ratio.min() < 1.0 / MASS_RATIO:
        t, m = _largest(np.abs(np.log(np.maximum(ratio, 1e-300))))
        return [
            f"generalised mass of mode {m + 1} at {modes.time_s[t]:g} s is {given[t, m]:.3g} kg, where shape and "
            f"mass_forward_kg give {given[t, m] * ratio[t, m]:.3g} kg"
        ]
    return []


def twisting(modes: Shapes) -> NDArray[np.bool_]:
    """Which modes twist more than they displace, (T, M)."""
    return np.asarray(2.0 * (modes.displaced**2).sum(axis=2) < (modes.moved**2).sum(axis=2))


def _largest(values: Floats) -> tuple[int, int]:
    """Time and mode of the largest value."""
    t, m = np.unravel_index(int(np.argmax(values)), values.shape)
    return int(t), int(m)


_SHARE = 1e-4
"""Of a mode's bending, squared: a plane with less is left out."""


def _slopes(modes: Shapes) -> tuple[Floats, Floats]:
    """Correlation of the slopes with the differences of the shapes, and their relative deviation, both (T, M).

    1 and 0 for a mode that does not bend. The correlation is the least of the planes, each by itself: the larger one of
    a coupled mode would hide that the other is flipped.
    """
    h = np.diff(modes.station_m)
    d, s = np.stack([(np.diff(p, axis=2) / h, 0.5 * (q[..., 1:] + q[..., :-1])) for p, q in modes.bent], axis=1)
    both, shape, slope, apart = ((h * x).sum(axis=-1) for x in (d * s, d * d, s * s, (d - s) ** 2))  # (planes, T, M)
    # what a displacement of a millionth of the largest would be
    least = (1e-6 * np.abs(modes.moved).max(axis=2)) ** 2 / max(float(h.sum()), 1e-300)
    bends = (shape > np.maximum(least, _SHARE * shape.sum(axis=0))) & (slope > 0.0)
    correlation = np.where(bends, both / np.sqrt(np.where(bends, shape * slope, 1.0)), 1.0)
    whole = np.where(bends.any(axis=0), shape.sum(axis=0), 1.0)
    return correlation.min(axis=0), np.where(bends.any(axis=0), np.sqrt(apart.sum(axis=0) / whole), 0.0)


def _alike(modes: Shapes) -> Floats:
    """Cosine between the shapes of successive times, (T - 1, M, M); its square is the modal assurance criterion."""
    moved = modes.moved
    unit = moved / np.maximum(np.sqrt((moved**2).sum(axis=2, keepdims=True)), 1e-300)
    return np.asarray((unit[:-1, :, None, :] * unit[1:, None, :, :]).sum(axis=-1))


def _orthonormality(products: Floats, given: Floats) -> tuple[Floats, Floats]:
    """Products of each mode with itself over its generalised mass, and the largest with others over both, (T, M)."""
    root = np.sqrt(given)
    scaled = products / (root[:, :, None] * root[:, None, :])
    own = np.maximum(np.diagonal(scaled, axis1=1, axis2=2), 1e-300)
    across = np.abs(scaled * (1.0 - np.eye(given.shape[1]))).max(axis=2)
    return own, across
