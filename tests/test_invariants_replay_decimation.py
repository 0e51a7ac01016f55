"""Decimation keeps samples, extremes and gaps."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from maxq.tools.replay.decimate import changed, extremes, extremes_on_grid
from maxq.tools.replay.sheets import envelope
from maxq.tools.replay.text import sparkline

MS = 1_000_000
VALUES = arrays(float, st.integers(0, 400), elements=st.one_of(st.floats(-1e3, 1e3), st.just(np.nan), st.just(0.5)))


@given(VALUES, st.integers(1, 50), st.integers(0, 10_000))
def test_every_interval_keeps_its_extremes(values: np.ndarray, interval_ms: int, start_ms: int) -> None:
    times = (start_ms + np.arange(len(values))) * MS
    kept = extremes(times, values, interval_ms * MS)
    assert (np.diff(kept) > 0).all()
    if len(values):
        assert kept[0] == 0
        assert kept[-1] == len(values) - 1
    bins = times // (interval_ms * MS)
    line = np.interp(times, times[kept], values[kept]) if len(kept) else values
    for which in np.unique(bins):
        whole = values[bins == which]
        if np.isfinite(whole).all():
            seen = line[bins == which]  # a stretch of equal values is kept by its ends alone
            assert np.nanmin(seen) <= whole.min()
            assert np.nanmax(seen) >= whole.max()
        elif np.isfinite(whole).any():
            left = values[kept[bins[kept] == which]]
            low, high = np.nanmin(whole), np.nanmax(whole)
            assert low in left or (values[kept] == low).any()
            assert high in left or (values[kept] == high).any()


@given(VALUES)
def test_without_interval_the_line_is_the_same(values: np.ndarray) -> None:
    times = np.arange(len(values)) * MS
    kept = extremes(times, values, 0)
    if len(values):
        again = np.interp(times, times[kept], values[kept])
        finite = np.isfinite(again) & np.isfinite(values)
        np.testing.assert_allclose(again[finite], values[finite], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("hertz", [9.0, 27.0, 45.0, 49.9, 333.0])
def test_an_oscillation_keeps_its_amplitude(hertz: float) -> None:
    """The amplitude survives at frequencies where the mean of 20 ms, or every 20th sample, would change it."""
    times = np.arange(20_000) * MS
    values = 0.05 * np.sin(2.0 * np.pi * hertz * times / 1e9)
    kept = extremes(times, values, 20 * MS)
    assert len(kept) <= 2 * 1000 + 4
    for second in range(20):
        here = (times >= second * 1000 * MS) & (times < (second + 1) * 1000 * MS)
        seen = values[kept][here[kept]]
        assert seen.max() == values[here].max()
        assert seen.min() == values[here].min()


def test_a_viewer_that_merges_a_number_of_samples_gets_them_at_an_even_rate() -> None:
    """A viewer that merges a number of samples receives them at an even rate.

    Rerun drew thrust over weight at 0.8 after burnout, because it merged the two samples that followed.
    """
    times = np.arange(20_000) * MS
    values = np.where(times < 5_000 * MS, 4.0 - times / (5_000 * MS), 0.0)
    assert np.diff(times[extremes(times, values, 20 * MS)]).max() == 14_999 * MS
    kept = extremes(times, values, 20 * MS, even=True)
    assert np.diff(times[kept]).max() <= 20 * MS
    assert len(kept) <= 2 * 1000 + 2
    constant = np.full(20_000, 3.0)
    assert extremes(times, constant, 20 * MS, even=True).tolist() == [0, 19_999]


def test_a_gap_stays_a_gap() -> None:
    values = np.sin(np.arange(1000) / 7.0)
    values[300:600] = np.nan
    times = np.arange(1000) * MS
    kept = extremes(times, values, 20 * MS)
    assert np.isnan(values[kept][(kept >= 300) & (kept < 600)]).all()
    assert ((kept >= 300) & (kept < 600)).any()


@given(arrays(float, (50, 3), elements=st.floats(-1.0, 1.0)), st.floats(1e-4, 0.5))
def test_rows_that_are_not_sent_lie_within_the_tolerance_of_those_that_are(rows: np.ndarray, tolerance: float) -> None:
    kept = changed(rows, tolerance)
    assert kept[0] == 0
    last = kept[np.searchsorted(kept, np.arange(len(rows)), side="right") - 1]
    assert np.abs(rows - rows[last]).max() <= tolerance * (1.0 + 1e-9)


def test_an_envelope_holds_every_sample() -> None:
    random = np.random.default_rng(1)
    times = np.sort(random.integers(0, 10_000 * MS, 5000))
    values = random.normal(size=5000)
    low, high = envelope(times, values, (0, 10_000 * MS), 100)
    place = times // (100 * MS)
    assert (values >= low[place]).all()
    assert (values <= high[place]).all()


def test_a_peak_of_one_sample_is_seen_in_a_sparkline() -> None:
    values = np.zeros(10_000)
    values[4321] = 1.0
    line = sparkline(np.arange(10_000) * MS, values, (0, 10_000 * MS), 40)
    assert line.count("█") == 1
    assert line.index("█") == 4321 * 40 // 10_000


@given(VALUES, st.integers(1, 50), st.integers(-500, 500))
def test_a_family_keeps_the_extremes_of_every_interval(values: np.ndarray, interval_ms: int, start_ms: int) -> None:
    times, count = np.arange(len(values)) * MS, 12
    rows = extremes_on_grid(times, values, start_ms * MS, interval_ms * MS, count).reshape(count, 2)
    for number in range(count):
        begin = (start_ms + number * interval_ms) * MS
        here = values[(times >= begin) & (times < begin + interval_ms * MS)]
        here = here[np.isfinite(here)]
        if len(here):
            assert rows[number].min() == here.min()
            assert rows[number].max() == here.max()
        else:
            assert np.isnan(rows[number]).all()
