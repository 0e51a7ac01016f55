"""PD with a lead compensator, as a law of your own: `simdesign examples/own_law/lead.toml`."""

import math

import numpy as np


def lead(zero_hz, pole_hz, sample_s):
    """Return b0, b1, a1 of (s / z + 1) / (s / p + 1) with s = 2 / T (1 - 1/z) / (1 + 1/z)."""
    z, p = 2.0 / (2.0 * math.pi * zero_hz * sample_s), 2.0 / (2.0 * math.pi * pole_hz * sample_s)
    return (1.0 + z) / (1.0 + p), (1.0 - z) / (1.0 + p), (1.0 - p) / (1.0 + p)


class Lead:
    variables = {  # start, lower and upper bound
        "k_p": (1.0, 0.05, 10.0),
        "k_d_s": (0.6, 0.02, 10.0),
        "lead_zero_hz": (5.0, 1.0, 20.0),
        "lead_pole_hz": (20.0, 2.0, 45.0),
    }
    constant = ("lead_zero_hz", "lead_pole_hz")

    @staticmethod
    def matrices(v, sample_s):
        """Return A, B, C, D from attitude error and rate to the command."""
        b0, b1, a1 = lead(v[2], v[3], sample_s)
        gains = np.array([[-v[0], -v[1]]])
        return [[-a1]], (b1 - a1 * b0) * gains, [[1.0]], b0 * gains

    @staticmethod
    def step(v, memory, error_rad, rate_radps, sample_s):
        """Return the command of one sample, rad."""
        k_p, k_d_s, zero_hz, pole_hz = v[0], v[1], v[2], v[3]
        z, p = 1.0 / (math.pi * zero_hz * sample_s), 1.0 / (math.pi * pole_hz * sample_s)
        law_rad = -k_p * error_rad - k_d_s * rate_radps
        command_rad = (1.0 + z) / (1.0 + p) * law_rad + memory[0]
        memory[0] = (1.0 - z) / (1.0 + p) * law_rad - (1.0 - p) / (1.0 + p) * command_rad
        return command_rad
