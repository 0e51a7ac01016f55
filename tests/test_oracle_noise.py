"""The noise generator has Random123's known answers and SciPy's normal distribution and statistics."""

from __future__ import annotations

import os
import subprocess
import sys

import numba
import numpy as np
import pytest
import scipy.special
import scipy.stats

from maxq.control.kernel.noise import normal_quantile, philox, standard_normal, standard_normal_pair, uniform_pair

N = 20_000 if numba.config.DISABLE_JIT else 200_000  # every bound below follows from it


@numba.njit
def sequence(seed, stream, out):
    for i in range(len(out)):
        out[i] = standard_normal(seed, stream, i)


def normals(seed, stream, n=N):
    out = np.empty(n)
    sequence(seed, stream, out)
    return out


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [  # kat_vectors of Random123 (Salmon et al. 2011)
        ((0,) * 4, (0,) * 2, (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
        (
            (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
            (0xA4093822, 0x299F31D0),
            (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
        ),
    ],
)
def test_philox_known_answers(counter, key, expected):
    assert philox(*counter, *key) == expected


def test_quantile_is_the_inverse_normal():
    p = np.concatenate(
        [np.linspace(1e-6, 1 - 1e-6, 3001), np.geomspace(1.2e-16, 0.1, 400), 1 - np.geomspace(1.2e-16, 0.1, 50)]
    )
    got = np.array([normal_quantile(float(v)) for v in p])
    assert got == pytest.approx(scipy.special.ndtri(p), rel=2e-14, abs=1e-15)


def test_uniforms_stay_inside_the_open_interval():
    largest = (float(2**52 - 1) + 0.5) * 2.0**-52
    assert 0.0 < 0.5 * 2.0**-52 < largest < 1.0
    assert np.isfinite(normal_quantile(largest))
    assert normal_quantile(largest) == -normal_quantile(0.5 * 2.0**-52)


def test_uniforms_are_the_upper_52_bits_of_two_words_each():
    """Uniforms equal Python integers; `philox` takes index, stream and seed as pairs of words, the lower one first."""
    for seed, stream, index in ((0, 0, 0), (1, 2, 3), (2**40 + 5, 7, 2**33 + 1), (-1, -2, -3)):
        words = philox(*(w for n in (index, stream, seed) for w in (n % 2**32, (n >> 32) % 2**32)))
        pairs = ((int(words[0]), int(words[1])), (int(words[2]), int(words[3])))
        exact = tuple((2 * ((upper * 2**32 + lower) // 2**12) + 1) / 2**53 for upper, lower in pairs)
        assert uniform_pair(seed, stream, index) == exact


def test_moments():
    x = normals(7, 3)
    assert abs(x.mean()) < 4 / np.sqrt(N)
    assert abs(x.var() - 1) < 4 * np.sqrt(2 / N)
    assert abs((x**3).mean()) < 4 * np.sqrt(15 / N)
    assert abs((x**4).mean() - 3) < 4 * np.sqrt(96 / N)


@pytest.mark.parametrize(("seed", "stream"), [(0, 0), (1, 0), (0, 1), (123456789012345, 17), (-5, 2)])
def test_kolmogorov_smirnov(seed, stream):
    assert scipy.stats.kstest(normals(seed, stream), "norm").pvalue > 1e-3


def test_sequence_is_white():
    x = normals(11, 4)
    for lag in (1, 2, 3, 5, 100):
        assert abs(np.corrcoef(x[:-lag], x[lag:])[0, 1]) < 4 / np.sqrt(N)


@pytest.mark.parametrize("other", [(12, 4), (11, 5), (11 + 2**32, 4), (11, 4 + 2**32), (-11, 4), (4, 11)], ids=str)
def test_seeds_and_streams_are_independent(other):
    """Seeds and streams are independent, also those that differ only in the upper half of the 64 bits."""
    assert abs(np.corrcoef(normals(11, 4), normals(*other))[0, 1]) < 4 / np.sqrt(N)


def test_index_uses_all_its_bits():
    assert len({standard_normal(1, 1, i) for i in (0, 1, 2**32, 2**33, 2**62, -1)}) == 6


def test_pair_is_two_independent_draws():
    pairs = np.array([standard_normal_pair(3, 9, i) for i in range(20_000)])
    assert pairs[:100, 0] == pytest.approx(normals(3, 9, 100), abs=0.0)
    assert abs(np.corrcoef(pairs.T)[0, 1]) < 4 / np.sqrt(20_000)
    assert scipy.stats.kstest(pairs[:, 1], "norm").pvalue > 1e-3


def test_numpy_and_python_integers_give_the_same():
    draw = uniform_pair(5, 6, 7)
    assert uniform_pair(np.int64(5), np.int64(6), np.int64(7)) == draw
    assert uniform_pair(-(2**63), 2**63 - 1, -1) == uniform_pair(np.int64(-(2**63)), np.int64(2**63 - 1), np.int64(-1))


PROGRAM = """
import warnings; warnings.simplefilter("error")
import numpy as np
from maxq.control.kernel.noise import standard_normal
seeds = (0, 1, -1, 2**63 - 1, -2**63, np.int64(2**62 + 12345))
print(" ".join(standard_normal(s, 3, i).hex() for s in seeds for i in range(200)))
"""


@pytest.mark.slow
def test_identical_with_and_without_compilation():
    """The bits are identical with and without compilation, and no overflow warning appears."""
    answers = []
    for disable in ("0", "1"):
        environment = {**os.environ, "NUMBA_DISABLE_JIT": disable}
        run = subprocess.run(
            [sys.executable, "-c", PROGRAM], env=environment, capture_output=True, text=True, check=True
        )
        answers.append(run.stdout.split())
    assert len(answers[0]) == 1200
    assert answers[0] == answers[1]
