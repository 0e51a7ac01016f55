"""The law of the built-in design ksr3-robust in Python: PD, bending filter, roll thrusters.

    simrun nominal --set vehicle.computer.law=external --set vehicle.computer.python=pd_law.py:Autopilot

`setup` and `inputs` have the fields of the structs in maxq_fsw.h (simrun schema flight-software).
"""

import math


class Autopilot:
    """The flight code of one flight."""

    def __init__(self, setup):
        if setup.sample_ns != 10_000_000:
            raise ValueError("this law is made for 100 Hz")
        w = 2 * math.pi * 9.8
        c = w / math.tan(0.5 * w * 1e-9 * setup.sample_ns)
        self.filter = [
            bilinear(c, 28.480032, 0.315292215, 13.7014172, 1.2),
            bilinear(c, 3.76992765, 1.2, 5.73048187, 0.3),
        ]
        self.memory = [[[0.0, 0.0] for _ in self.filter] for _ in ("pitch", "yaw")]
        self.thruster, self.ticks_on = 0, 0

    def step(self, inputs):
        share = min(max((inputs.time_s - 5.0) / 50.0, 0.0), 1.0)
        k_p = 1.09853423 + share * (0.724467989 - 1.09853423)
        k_d_s = 0.467470625 + share * (0.369753066 - 0.467470625)
        error_rad = [a - c for a, c in zip(inputs.angle_rad, inputs.commanded_angle_rad, strict=True)]
        gimbal_rad = [
            self.filtered(axis, -k_p * error_rad[1 + axis] - k_d_s * inputs.rate_radps[1 + axis]) for axis in (0, 1)
        ]
        return {"gimbal_rad": gimbal_rad, "roll_thruster": self.roll(error_rad[0], inputs.rate_radps[0])}

    def filtered(self, axis, value):
        """Transposed direct form II."""
        for (b0, b1, b2, a1, a2), memory in zip(self.filter, self.memory[axis], strict=True):
            out = b0 * value + memory[0]
            memory[:] = b1 * value - a1 * out + memory[1], b2 * value - a2 * out
            value = out
        return value

    def roll(self, error_rad, rate_radps):
        """Switching line with dead band 1 deg, hysteresis 0.2 deg and a shortest firing of 2 samples."""
        on, off, s = math.radians(1.0), math.radians(0.8), error_rad + 0.5 * rate_radps
        wanted = 0
        if self.thruster != 0 and self.ticks_on < 2:
            wanted = self.thruster
        elif s > on or (self.thruster < 0 and s > off):
            wanted = -1
        elif s < -on or (self.thruster > 0 and s < -off):
            wanted = 1
        self.ticks_on = 0 if wanted == 0 else self.ticks_on + 1 if wanted == self.thruster else 1
        self.thruster = wanted
        return wanted


def bilinear(c, zero_hz, zero_zeta, pole_hz, pole_zeta):
    """(s²/wz² + 2 zz s/wz + 1) / (s²/wp² + 2 zp s/wp + 1) with s = c (z - 1)/(z + 1), as b0, b1, b2, a1, a2."""
    rows = []
    for hz, zeta in ((zero_hz, zero_zeta), (pole_hz, pole_zeta)):
        first, second = 2 * zeta * c / (2 * math.pi * hz), (c / (2 * math.pi * hz)) ** 2
        rows.append((1 + first + second, 2 * (1 - second), 1 - first + second))
    (b0, b1, b2), (a0, a1, a2) = rows
    return b0 / a0, b1 / a0, b2 / a0, a1 / a0, a2 / a0
