"""The random numbers of a campaign, each of which is a function of its place of use, not of earlier draws.

A draw depends on campaign seed, key path and run number alone. Additional runs, keys or workers, another order or
another machine do not change it. There are three further dependences:

- With `latin-hypercube`, a draw depends on the stratum, the fixed number of runs in a hypercube. Run i belongs to
  hypercube i // stratum for any number of runs, so that a campaign can be extended.
- With `sobol`, a draw depends on the position of its key among the dispersed keys, which is its dimension. Keys that
  are appended change no draw, and an inserted key shifts all later keys.
- A rejected draw is replaced by a pseudo-random draw (attempt 1, 2, ...) with any sampling.

The bits are those of Philox4x64-10 (Salmon et al., SC11, 2011). Its key is 16 bytes of the SHA-256 of seed and key
path, and its counter consists of run, attempt and component. NumPy guarantees the streams of its bit generators.
Quantile functions of the distributions convert uniform numbers into draws.
"""

from __future__ import annotations

import hashlib
import warnings
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from maxq.control.kernel.records import Array, IntArray
from maxq.sim.campaign.schema import Disperse

Words = NDArray[np.uint64]

_CELL = 2.0**-53
_SOBOL_BITS = 32


@lru_cache(maxsize=4096)
def _philox_key(seed: int, key: str) -> int:
    return int.from_bytes(hashlib.sha256(f"{seed}\0{key}".encode()).digest()[:16], "little")


def words(seed: int, key: str, first: int, count: int, attempt: int = 0, component: int = 0) -> Words:
    """Return four random words (count, 4) for each of the runs `first` to `first + count - 1`."""
    counter = first | attempt << 64 | component << 128
    return np.random.Philox(key=_philox_key(seed, key), counter=counter).random_raw(4 * count).reshape(count, 4)


def uniforms(seed: int, key: str, first: int, count: int, attempt: int = 0, component: int = 0) -> Array:
    """Return uniform numbers (count,) in the open interval (0, 1), at the centres of 2^52 cells."""
    high = words(seed, key, first, count, attempt, component)[:, 0] >> np.uint64(12)
    return np.asarray((high.astype(np.float64) + 0.5) * 2.0 * _CELL)


def seeds(seed: int, key: str, first: int, count: int, attempt: int = 0) -> IntArray:
    """Return whole numbers (count,) from 0 to 2^63 - 1, the seeds of the noise in each flight."""
    return np.asarray((words(seed, key, first, count, attempt)[:, 1] >> np.uint64(1)).astype(np.int64))


@lru_cache(maxsize=512)
def _permutation(seed: int, key: str, hypercube: int, stratum: int) -> IntArray:
    """Return a random permutation of 0 to stratum - 1 for a hypercube: the ranks of random words."""
    order = np.argsort(words(seed, f"{key}\0latin", 0, stratum, component=hypercube)[:, 0], kind="stable")
    ranks = np.empty(stratum, np.int64)
    ranks[order] = np.arange(stratum)
    return ranks


def latin(seed: int, key: str, first: int, count: int, stratum: int) -> Array:
    """Return Latin hypercube numbers (count,) in the open interval (0, 1).

    The runs of a hypercube, `stratum` consecutive runs from a multiple of `stratum` on, are in different cells of the
    width 1 / `stratum`.
    """
    runs = np.arange(first, first + count)
    cells = np.empty(count, np.int64)
    for hypercube in range(first // stratum, (first + count - 1) // stratum + 1):
        inside = runs // stratum == hypercube
        cells[inside] = _permutation(seed, key, hypercube, stratum)[runs[inside] % stratum]
    u = (cells + uniforms(seed, key, first, count)) / stratum
    return np.asarray(np.minimum(u, 1.0 - _CELL))  # the sum may be rounded up to 1


class Sobol:
    """The Sobol' points of consecutive runs with Owen scrambling, separately for each dimension.

    The sequence is that of SciPy (direction numbers of Joe & Kuo). Each bit is scrambled by a hash of the more
    significant bits, as in Laine & Karras (Comput. Graph. Forum 30, 2011), with the constants of Burley (J. Comput.
    Graph. Tech. 9(4), 2020). The scrambling of a key therefore depends on campaign seed and key alone, unlike SciPy's
    scrambling, which depends on all dimensions.
    """

    def __init__(self, seed: int, keys: tuple[str, ...], first: int, count: int) -> None:
        from scipy.stats import qmc  # noqa: PLC0415  # lazy: a second to import, for this sampling only

        if len(keys) > qmc.Sobol.MAXDIM:
            raise ValueError(f"{len(keys)} dispersed keys; Sobol' points have at most {qmc.Sobol.MAXDIM} dimensions")
        self._seed, self._dimension = seed, {key: n for n, key in enumerate(keys)}
        engine: Any = qmc.Sobol(len(keys), scramble=False, bits=_SOBOL_BITS)
        if first:
            engine.fast_forward(first)
        with warnings.catch_warnings():  # SciPy warns if the number of points is not a power of two
            warnings.simplefilter("ignore", UserWarning)
            self._points = (engine.random(count) * 2.0**_SOBOL_BITS).astype(np.uint32)

    def __call__(self, key: str) -> Array:
        hashed = int(words(self._seed, f"{key}\0sobol", 0, 1)[0, 0])
        bits = _scrambled(self._points[:, self._dimension[key]], np.uint32(hashed & 0xFFFFFFFF))
        return np.asarray((bits.astype(np.float64) + 0.5) * 2.0**-_SOBOL_BITS)


def _reversed_bits(x: NDArray[np.uint32]) -> NDArray[np.uint32]:
    for shift, mask in ((1, 0x55555555), (2, 0x33333333), (4, 0x0F0F0F0F), (8, 0x00FF00FF)):
        keep = np.uint32(mask)
        x = ((x >> np.uint32(shift)) & keep) | ((x & keep) << np.uint32(shift))
    return (x >> np.uint32(16)) | (x << np.uint32(16))


def _scrambled(x: NDArray[np.uint32], seed: np.uint32) -> NDArray[np.uint32]:
    """Return nested uniformly scrambled numbers, in which a hash of the more significant bits may flip each bit.

    Products overflow by design.
    """
    x = _reversed_bits(x)
    x = x + seed
    for factor in (0x6C50B47C, 0xB82F1E52, 0xC7AFE638, 0x8D22F6E6):
        x = x ^ (x * np.uint32(factor))
    return _reversed_bits(x)


def quantile(spec: Disperse, u: Array, nominal: float) -> Array:
    """Return the draws (runs,) of a distribution of numbers for uniform numbers `u` (runs,).

    `nominal` is the default centre. The formulas are written out, because scipy.stats takes a second to import. Its ppf
    also rounds differently for the triangular and the truncated normal distribution, and is nan for a spread of zero.
    """
    centre, sigma, (low, high) = spec.centre(nominal), spec.sigma_of_normal, spec.ends
    if spec.distribution == "normal":
        return np.asarray(centre + sigma * ndtri(u))
    if spec.distribution == "truncated-normal":
        return _truncated(centre, sigma, low, high, u)
    if spec.distribution == "log-normal":
        with np.errstate(over="ignore"):  # infinite values are out of range, and drawn again
            return np.asarray((spec.median or centre) * np.exp(sigma * ndtri(u)))
    if spec.distribution == "uniform":
        return np.asarray(low + (high - low) * u)
    assert spec.mode is not None
    return _triangular(low, spec.mode, high, u)


def box(spec: Disperse, nominal: float, sigmas: float = 3.0) -> tuple[float, float]:
    """Return the least and greatest draw of a search.

    These are the ends of a uniform or triangular distribution. For the others, they are the quantiles that correspond
    to `sigmas` of a normal distribution on either side.
    """
    if spec.distribution in ("uniform", "triangular"):
        return spec.ends
    tail = float(ndtr(-sigmas))
    low, high = quantile(spec, np.array([tail, 1.0 - tail]), nominal)
    return float(low), float(high)


def chosen(spec: Disperse, u: Array) -> IntArray:
    """Return indices (runs,) of `spec.values` with frequencies proportional to their weights."""
    assert spec.values is not None
    weights = np.array(spec.weights or (1.0,) * len(spec.values), dtype=float)
    edges = np.cumsum(weights / weights.sum())
    return np.minimum(np.searchsorted(edges, u, side="right"), len(weights) - 1)


def correlated(matrix: tuple[tuple[float, ...], ...], scores: list[Array]) -> list[Array]:
    """Return zero-mean normal draws, an array (runs,) for each key, with the covariance `matrix`.

    `scores` are independent standard normal numbers of the same shapes. Draw j depends on the scores of keys 0 to j.
    Sums are written out, so that they do not depend on the processor.
    """
    factor = cholesky(np.array(matrix))
    nothing = np.zeros_like(scores[0])
    return [sum((factor[j, k] * scores[k] for k in range(j + 1)), nothing) for j in range(len(scores))]


def cholesky(matrix: Array) -> Array:
    """Return the lower Cholesky factor of a covariance matrix, which may be singular."""
    n = len(matrix)
    factor = np.zeros((n, n))
    for j in range(n):
        rest = matrix[j, j] - sum(factor[j, k] ** 2 for k in range(j))
        factor[j, j] = np.sqrt(rest) if rest > 1e-12 * max(matrix[j, j], 1e-300) else 0.0
        for i in range(j + 1, n):
            if factor[j, j] > 0.0:
                factor[i, j] = (matrix[i, j] - sum(factor[i, k] * factor[j, k] for k in range(j))) / factor[j, j]
    return factor


def _truncated(mean: float, sigma: float, low: float, high: float, u: Array) -> Array:
    """Return draws (runs,) of a normal distribution truncated to `low` and `high`.

    They are computed in the lower tail, where probabilities have full precision.
    """
    if sigma == 0.0:
        return np.clip(np.full_like(u, mean), low, high)
    a, b = (low - mean) / sigma, (high - mean) / sigma
    if a > 0.0:
        return np.asarray(np.clip(mean - sigma * ndtri(ndtr(-b) + (1.0 - u) * (ndtr(-a) - ndtr(-b))), low, high))
    return np.asarray(np.clip(mean + sigma * ndtri(ndtr(a) + u * (ndtr(b) - ndtr(a))), low, high))


def _triangular(low: float, mode: float, high: float, u: Array) -> Array:
    width = high - low
    if width == 0.0:
        return np.full_like(u, low)
    left = low + np.sqrt(u * width * (mode - low))
    right = high - np.sqrt((1.0 - u) * width * (high - mode))
    return np.where(u * width < mode - low, left, right)
