"""Counter-based random numbers: no draw depends on an earlier draw.

A draw is a function of (seed, stream, index). The seed belongs to the flight and the stream to a component; the index
counts the component's draws. There is no generator state. Hence a flight that skips, repeats or reorders components has
the same noise, and any run of a campaign can be repeated alone.

The bits come from Philox4x32-10 (Salmon, Moraes, Dror & Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC11,
2011). The normal deviate is the inverse of the normal distribution at a uniform draw (Wichura, algorithm AS 241,
Applied Statistics 37, 1988; 16 digits). All integers are masked to 32 bits after every product, so that wrapping 64-bit
integers (compiled) and unbounded integers (plain Python) give the same bits.
"""

from __future__ import annotations

import math

from maxq.control.kernel.jit import kernel, routine

# Streams in use, so that no two components share a sequence: 1 turbulence, 16 to 18 the three axes of the gyro
# (GYRO_STREAM in sim/vehicle/sensor/gyro.py), 32 to 51 further sensors (SENSOR_STREAM in
# sim/vehicle/sensor/further.py), 64 to 79 buffet (BUFFET_STREAM in sim/vehicle/buffet/kernel.py), 80 to 85 GNSS,
# 86 barometer, 88 to 90 magnetometer.
TURBULENCE_STREAM = 1

_MASK = 0xFFFFFFFF
_MULTIPLIER_0 = 0xD2511F53
_MULTIPLIER_1 = 0xCD9E8D57
_WEYL_0 = 0x9E3779B9  # golden ratio
_WEYL_1 = 0xBB67AE85  # sqrt(3) - 1
_ROUNDS = 10


@kernel
def philox(c0: int, c1: int, c2: int, c3: int, k0: int, k1: int) -> tuple[int, int, int, int]:
    """Return four 32-bit words of Philox4x32-10 from a counter of four and a key of two such words.

    All words are integers in 0..2^32-1.
    """
    for _ in range(_ROUNDS):
        product_0 = _MULTIPLIER_0 * c0
        product_1 = _MULTIPLIER_1 * c2
        # A wrapped product may be negative; the mask after the shift restores its upper half.
        c0, c1, c2, c3 = (
            ((product_1 >> 32) & _MASK) ^ c1 ^ k0,
            product_1 & _MASK,
            ((product_0 >> 32) & _MASK) ^ c3 ^ k1,
            product_0 & _MASK,
        )
        k0 = (k0 + _WEYL_0) & _MASK
        k1 = (k1 + _WEYL_1) & _MASK
    return c0, c1, c2, c3


@kernel
def uniform_pair(seed: int, stream: int, index: int) -> tuple[float, float]:
    """Return two independent uniform numbers in the open interval (0, 1), at the centres of 2^52 equal cells.

    `seed`, `stream` and `index` are signed 64-bit integers of any value.
    """
    # Records contain NumPy scalars, which warn when they wrap; the conversion to integers avoids the warning.
    seed, stream, index = int(seed), int(stream), int(index)
    w0, w1, w2, w3 = philox(
        index & _MASK, (index >> 32) & _MASK, stream & _MASK, (stream >> 32) & _MASK, seed & _MASK, (seed >> 32) & _MASK
    )
    # Numbers of 52 bits plus one half are exact in a double; those of 53 bits plus one half could round to 1.
    return (
        (float((w0 << 20) | (w1 >> 12)) + 0.5) * 2.220446049250313e-16,
        (float((w2 << 20) | (w3 >> 12)) + 0.5) * 2.220446049250313e-16,
    )


@routine
def standard_normal(seed: int, stream: int, index: int) -> float:
    """Return one draw of the standard normal distribution; its magnitude is at most 8.21, the last cell's quantile."""
    return normal_quantile(uniform_pair(seed, stream, index)[0])


@routine
def standard_normal_pair(seed: int, stream: int, index: int) -> tuple[float, float]:
    """Return two independent standard normal draws, of which the first equals `standard_normal`.

    A pair takes little longer than a single draw.
    """
    first, second = uniform_pair(seed, stream, index)
    return normal_quantile(first), normal_quantile(second)


# AS 241: numerators a, c, e and denominators b, d, f of degree 7, interleaved, highest power first.
_CENTRE = (
    (2.5090809287301226727e3, 5.2264952788528545610e3),
    (3.3430575583588128105e4, 2.8729085735721942674e4),
    (6.7265770927008700853e4, 3.9307895800092710610e4),
    (4.5921953931549871457e4, 2.1213794301586595867e4),
    (1.3731693765509461125e4, 5.3941960214247511077e3),
    (1.9715909503065514427e3, 6.8718700749205790830e2),
    (1.3314166789178437745e2, 4.2313330701600911252e1),
    (3.3871328727963666080e0, 1.0),
)
_TAIL = (
    (7.74545014278341407640e-4, 1.05075007164441684324e-9),
    (2.27238449892691845833e-2, 5.47593808499534494600e-4),
    (2.41780725177450611770e-1, 1.51986665636164571966e-2),
    (1.27045825245236838258e0, 1.48103976427480074590e-1),
    (3.64784832476320460504e0, 6.89767334985100004550e-1),
    (5.76949722146069140550e0, 1.67638483018380384940e0),
    (4.63033784615654529590e0, 2.05319162663775882187e0),
    (1.42343711074968357734e0, 1.0),
)
_FAR_TAIL = (
    (2.01033439929228813265e-7, 2.04426310338993978564e-15),
    (2.71155556874348757815e-5, 1.42151175831644588870e-7),
    (1.24266094738807843860e-3, 1.84631831751005468180e-5),
    (2.65321895265761230930e-2, 7.86869131145613259100e-4),
    (2.96560571828504891230e-1, 1.48753612908506148525e-2),
    (1.78482653991729133580e0, 1.36929880922735805310e-1),
    (5.46378491116411436990e0, 5.99832206555887937690e-1),
    (6.65790464350110377720e0, 1.0),
)


@kernel
def _ratio(coefficients: tuple[tuple[float, float], ...], r: float) -> float:
    """Return the ratio of two polynomials at `r`; rows are (numerator, denominator), highest power first."""
    above, below = 0.0, 0.0
    for a, b in coefficients:
        above = above * r + a
        below = below * r + b
    return above / below


@kernel
def normal_quantile(probability: float) -> float:
    """Return x with P(X <= x) = `probability` for a standard normal X.

    Valid for 0 < `probability` < 1, with a relative accuracy of 1e-15. Source: Wichura, AS 241, routine PPND16.
    """
    q = probability - 0.5
    if abs(q) <= 0.425:  # 85 % of all draws, without a library call
        r = 0.180625 - q * q
        return q * _ratio(_CENTRE, r)
    r = math.sqrt(-math.log(min(probability, 1.0 - probability)))
    x = _ratio(_TAIL, r - 1.6) if r <= 5.0 else _ratio(_FAR_TAIL, r - 5.0)
    return x if q > 0.0 else -x
