"""Monotone cubics against SciPy's, to the bit."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from maxq.control.tables import fit, merge


@pytest.mark.parametrize("n", [3, 4, 5, 20, 143])
def test_pchip_is_scipys_to_the_bit(n: int) -> None:
    rng = np.random.default_rng(n)
    for trial in range(40):
        x = np.cumsum(rng.uniform(0.01, 2.0, n))
        y = rng.normal(size=(n, 6))
        y[:, 1] = np.cumsum(np.abs(y[:, 1]))  # monotone
        y[:, 2] = np.round(y[:, 2])  # flat places
        y[:, 3] = 1.0
        y[:, 4] = np.where(x > x.mean(), 0.0, 5.0)
        theirs = PchipInterpolator(x, y, axis=0).c[::-1].transpose(1, 0, 2)
        assert (fit(x, y).coefficients == theirs).all(), trial


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
