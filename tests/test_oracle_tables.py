"""Tables with cubics equal SciPy's interpolators, whose formulas they use without importing them.

Coefficients are equal to the bit, because both are NumPy's arithmetic in the same order. Values come from compiled
loops in SciPy, which may fuse a multiplication and an addition: four roundings of the largest term.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline, PchipInterpolator

from maxq.control.kernel.records import Array
from maxq.control.kernel.tables import fit, hermite, merge
from maxq.sim.vehicle.modes.shapes import ModeShapes
from maxq.sim.vehicle.modes.tables import ModeTable

EPS = float(np.finfo(float).eps)

steps = st.lists(st.floats(1e-3, 1e3), min_size=2, max_size=12)
values = st.one_of(st.floats(-1e6, 1e6), st.sampled_from([0.0, 1.0, -1.0]))  # flat pieces and turns among them


@st.composite
def tables(draw: st.DrawFn) -> tuple[Array, Array, Array]:
    """Return the breakpoints (n,), and two tables (n, 3) over them."""
    x = np.cumsum([draw(st.floats(-1e3, 1e3)), *draw(steps)])
    rows = st.lists(st.tuples(values, values, values), min_size=len(x), max_size=len(x))
    return x, np.array(draw(rows)), np.array(draw(rows))


def rising_powers(theirs: CubicHermiteSpline) -> Array:
    return np.asarray(theirs.c[::-1].transpose(1, 0, 2))


@pytest.mark.filterwarnings(
    "ignore:overflow encountered:RuntimeWarning:scipy"
)  # 1 over next to nothing; then 1 over that
@given(tables())
def test_monotone_cubics_are_those_of_scipy(table: tuple[Array, Array, Array]) -> None:
    x, y, _ = table
    np.testing.assert_array_equal(fit(x, y).coefficients, rising_powers(PchipInterpolator(x, y, axis=0)))


@pytest.mark.slow
@given(tables())
def test_hermite_cubics_are_those_of_scipy(table: tuple[Array, Array, Array]) -> None:
    x, y, slopes = table
    np.testing.assert_array_equal(hermite(x, y, slopes).coefficients, rising_powers(CubicHermiteSpline(x, y, slopes)))


@pytest.mark.parametrize("y", [[0.0, 1.0, 1.1], [0.0, 1.0, -9.0], [0.0, 5.0, 5.0], [2.0, 2.0, 7.0]])
def test_three_points_take_every_branch_of_the_ends(y: list[float]) -> None:
    x, column = np.array([0.0, 1.0, 3.0]), np.array(y)[:, None]
    for rows in (column, column[::-1]):
        np.testing.assert_array_equal(fit(x, rows).coefficients, rising_powers(PchipInterpolator(x, rows, axis=0)))


def test_mode_shapes_and_their_slopes_are_those_of_scipy() -> None:
    random = np.random.default_rng(7)
    times, modes, stations = 4, 3, np.array([0.0, 0.7, 2.0, 2.5, 6.0])
    phi, slope = random.normal(size=(2, times, modes, len(stations)))
    ones = np.ones((times, modes))
    shapes = ModeShapes(ModeTable(np.arange(4.0), stations, ones, ones, phi, slope, np.ones((times, len(stations)))))
    points = np.array([0.0, 0.3, 0.7, 1.9, 2.5, 5.999, 6.0, -0.5, 7.0])
    for t in range(times):
        for m in range(modes):
            theirs = CubicHermiteSpline(stations, phi[t, m], slope[t, m])
            terms = np.abs(theirs.c).max() * np.maximum(1.0, 4.0**3)  # the longest interval is 4 m, with what is beyond
            np.testing.assert_allclose(shapes.value(points)[:, t, m], theirs(points), rtol=0, atol=4 * EPS * terms)
            np.testing.assert_allclose(shapes.slope(points)[:, t, m], theirs(points, 1), rtol=0, atol=4 * EPS * terms)


def test_all_rows_at_once_are_those_one_by_one() -> None:
    rng = np.random.default_rng(0)
    table = fit(np.cumsum(rng.uniform(0.1, 1.0, 20)), rng.normal(size=(20, 3)))
    xs = np.concatenate([rng.uniform(-1.0, 15.0, 200), table.breaks])
    assert table.at(xs).tobytes() == np.array([table(float(x)) for x in xs]).tobytes()


def test_a_merged_table_is_its_parts() -> None:
    rng = np.random.default_rng(1)
    parts = [fit(np.cumsum(rng.uniform(0.1, 1.0, n)), rng.normal(size=(n, 2))) for n in (3, 8, 21)]
    together = merge(parts)
    xs = rng.uniform(-1.0, 14.0, 500)
    # a cubic that is re-centred loses a few ulp of its largest term
    assert together.at(xs) == pytest.approx(np.concatenate([p.at(xs) for p in parts], axis=1), rel=1e-9, abs=1e-11)
