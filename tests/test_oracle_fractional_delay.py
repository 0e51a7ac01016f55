"""Loops with a delay of a fractional number of samples equal the sum over the images of the sampled spectrum.

The response of a sampled path to exp(j w t) is the sum of its continuous response at all w + 2 pi k / T (Poisson's
summation). The margins use the modified z-transform of each pole, so that the two share no formula.
"""

from __future__ import annotations

import numpy as np
import pytest

from maxq.control.kernel.records import Array
from maxq.design.margins import packed
from maxq.design.margins.response import LoopResponse

PERIOD_S = 0.02
IMAGES = 200_000  # to either side: what is left of the slowest series falls with the square of their number


def summed(hz: Array, poles: np.ndarray, residues: np.ndarray, delay_s: float) -> np.ndarray:
    """Return the response of hold, delay, path by poles and residues, average over a period, and sampler."""
    s = 2j * np.pi * (hz[:, None] + np.arange(-IMAGES, IMAGES + 1) / PERIOD_S)
    path = sum(residue / (s - pole) for pole, residue in zip(poles, residues, strict=True))
    once = -np.expm1(-2j * np.pi * hz * PERIOD_S) / PERIOD_S
    return np.asarray(once**2 * (path * np.exp(-s * delay_s) / s**2).sum(axis=1))


@pytest.mark.parametrize("samples", [0.0, 0.37, 1.0, 1.85, 2.5])
def test_response_of_a_delay_of_any_number_of_samples(samples: float) -> None:
    """A lag of 3 rad/s, a mode of 0.5 % damping at 9 Hz and an actuator pair above the Nyquist frequency agree."""
    poles = np.array([-3.0, -0.28 + 56.5j, -0.28 - 56.5j, -60.0 + 190.0j, -60.0 - 190.0j])
    residues = np.array([4.0, 0.2 + 0.6j, 0.2 - 0.6j, -2.0 + 5.0j, -2.0 - 5.0j])
    whole, rest_s = int(samples), (samples - int(samples)) * PERIOD_S
    pairs, singles, direct = packed._terms(poles, residues, PERIOD_S, rest_s)
    none = np.zeros(0, complex)
    path = LoopResponse(PERIOD_S, pairs, singles, direct, none, none, 1.0 / PERIOD_S, whole + 1, 0, 0, 1)
    hz = np.array([0.01, 0.4, 3.0, 8.99, 17.0, 24.9])
    found, wanted = packed._values(hz, path), summed(hz, poles, residues, samples * PERIOD_S)
    assert np.abs(found / wanted - 1.0).max() < 1e-9
