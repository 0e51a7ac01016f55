"""The flight computer of flight_computer.c in Python, for petrel: navigation, guidance, sequence and control.

The gains are read from the design file of simvehicle, which is named by `settings` and hashed as `data`:

    simrun petrel/scenario.toml --set vehicle.computer.law=external \\
        --set vehicle.computer.python=flight_computer.py:Computer --set vehicle.computer.sequencing=flight-code \\
        --set vehicle.computer.data=petrel/design.toml --set vehicle.computer.settings=petrel/design.toml
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

LIFTOFF, SEPARATED = 1, (2, 4)  # bits of `discretes`
PAD, FIRST_STAGE, BURNED_OUT, WAITING, SECOND_STAGE, CUT_OFF = range(6)
PITCH_DEG = (
    0.0,
    1.85,
    3.70,
    5.97,
    8.79,
    11.87,
    15.08,
    18.35,
    21.61,
    24.84,
    27.98,
    31.00,
    33.86,
    36.54,
    39.02,
    41.30,
    43.39,
    45.30,
    47.04,
    48.62,
    50.05,
    51.35,
    52.53,
    53.60,
)  # every 5 s from 5 s on, from the vertical: a gravity turn without wind
TURN_RATE_RADPS = 0.0524
SEPARATION_S, IGNITION_S, FAIRING_S, EXHAUST_MPS = 1.0, 2.0, 39.87, 343.0 * 9.80665
GNSS_POSITION_M, GNSS_VELOCITY_MPS, DRIFT_M2PS3, GATE, HISTORY = 5.0, 0.1, 1e-4, 6.0, 64
APART_SAMPLES, APART_RADPS, APART_MPS2 = 50.0, 3.5e-4, 0.1
STEPS, SLOPE_S, ENDING_S = 24, 100.0, 8.0


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def norm(a):
    return math.sqrt(dot(a, a))


def cross(a, b):
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


def added(a, k, b):
    return (a[0] + k * b[0], a[1] + k * b[1], a[2] + k * b[2])


def unit(a):
    k = 1.0 / (norm(a) or 1.0)
    return (k * a[0], k * a[1], k * a[2])


def product(a, b):
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


def conjugate(q):
    return (q[0], -q[1], -q[2], -q[3])


def turned(q, by):
    half = 0.5 * norm(by)
    k = 0.5 * math.sin(half) / half if half > 1e-12 else 0.5
    q = product(q, (math.cos(half), k * by[0], k * by[1], k * by[2]))
    length = math.sqrt(sum(x * x for x in q))
    return tuple(x / length for x in q)


def rotate(q, a):
    t = cross(q[1:], a)
    return added(added(a, 2.0 * q[0], t), 2.0, cross(q[1:], t))


def about_z(angle, a):
    c, s = math.cos(angle), math.sin(angle)
    return (c * a[0] - s * a[1], s * a[0] + c * a[1], a[2])


class Units:
    """The inertial units: the middle increment of three, or the mean of two after one has failed (navigation.h)."""

    def __init__(self, sample_s):
        self.limits, self.failed = (APART_RADPS * sample_s,) * 3 + (APART_MPS2 * sample_s,) * 3, set()
        self.apart = [[0.0] * 6 for _ in range(3)]

    def select(self, i):
        units = [(*i.imu_delta_angle_rad[k], *i.imu_delta_velocity_mps[k]) for k in range(3)]
        good = [k for k in range(min(i.imu_count, 3)) if i.imu_health >> k & 1 and k not in self.failed] or [0]
        columns = [sorted(units[k][axis] for k in good) for axis in range(6)]
        out = tuple(0.5 * (x[(len(x) - 1) // 2] + x[len(x) // 2]) for x in columns)
        for k in range(3) if len(good) == 3 else ():
            mean = self.apart[k]
            self.apart[k] = [d + (x - y - d) / APART_SAMPLES for d, x, y in zip(mean, units[k], out, strict=True)]
            if any(abs(d) > most for d, most in zip(self.apart[k], self.limits, strict=True)):
                self.failed.add(k)
                break
        return out[:3], out[3:]


class Navigation:
    """Strapdown integration, corrected by GNSS; position, velocity and tilt in I (navigation.h)."""

    def __init__(self, setup):
        self.s = setup
        self.q, self.last = tuple(setup.start_q_RI), (0.0, 0.0, 0.0)
        self.r, self.v = tuple(setup.start_r_I_m), tuple(setup.start_v_I_mps)
        self.p_rr, self.p_rv, self.p_vv = 100.0, 0.0, 0.01
        self.past, self.number, self.rejected, self.started = [], 0, 0, False
        self.tilt, self.force, self.corrected = (0.0, 0.0, 0.0), 0.0, None
        self.units = Units(1e-9 * setup.sample_ns)

    def gravitation(self, r):
        s, radius = self.s, norm(r)
        k = -s.mu_m3ps2 / radius**3
        bulge, lift = 1.5 * s.j2 * (s.equator_m / radius) ** 2, 5.0 * (r[2] / radius) ** 2
        across = k * (1.0 + bulge * (1.0 - lift))
        return (across * r[0], across * r[1], k * (1.0 + bulge * (3.0 - lift)) * r[2])

    def ground(self, r):
        return (-self.s.earth_rate_radps * r[1], self.s.earth_rate_radps * r[0], 0.0)

    def step(self, i):
        s, h = self.s, 1e-9 * self.s.sample_ns
        angle, velocity = self.units.select(i)
        by = added(angle, 1.0 / 12.0, cross(self.last, angle))  # coning, Savage, J. Guidance 21(1), 1998
        before, self.last, self.q = self.q, angle, turned(self.q, by)
        if not i.discretes & LIFTOFF and not self.started:
            self.r = about_z(s.earth_rate_radps * (i.time_s - 1e-9 * s.start_ns), s.start_r_I_m)
            self.v = self.ground(self.r)
        else:
            self.started = True
            gained = rotate(turned(before, tuple(0.5 * x for x in by)), velocity)
            self.force = norm(gained) / h
            v = added(added(self.v, 1.0, gained), self.force * h, self.tilt)
            v = added(v, h, self.gravitation(added(self.r, 0.5 * h, self.v)))
            self.r, self.v = added(added(self.r, 0.5 * h, self.v), 0.5 * h, v), v
            self.p_rr += h * (2.0 * self.p_rv + h * self.p_vv)
            self.p_rv += h * self.p_vv
            self.p_vv += h * DRIFT_M2PS3
        self.past = [*self.past[1 - HISTORY :], (self.r, self.v)]
        if i.gnss_number != self.number:
            self.number = i.gnss_number
            if self.started:
                self.correct(i, h)

    def correct(self, i, h):
        ago = math.floor((i.time_s - i.gnss_time_s) / h + 0.5)
        if not 0 <= ago < len(self.past):
            return
        r_then, v_then = self.past[-1 - ago]
        angle, lever = self.s.earth_rate_radps * i.gnss_time_s, tuple(self.s.gnss_lever_B_m)
        r = about_z(angle, tuple(i.gnss_r_E_m))
        v = added(about_z(angle, tuple(i.gnss_v_E_mps)), 1.0, self.ground(r))
        swing = rotate(self.q, cross(tuple(x / h for x in self.last), lever))
        miss_r = added(added(r, -1.0, rotate(self.q, lever)), -1.0, r_then)
        miss_v = added(added(v, -1.0, swing), -1.0, v_then)
        rr, rv, vv = self.p_rr, self.p_rv, self.p_vv
        s_rr, s_vv = rr + GNSS_POSITION_M**2, vv + GNSS_VELOCITY_MPS**2
        if max(*(x * x / s_rr for x in miss_r), *(x * x / s_vv for x in miss_v)) > GATE**2:
            self.rejected += 1
            return
        det = s_rr * s_vv - rv * rv
        k_rr, k_rv = (rr * s_vv - rv * rv) / det, (rv * s_rr - rr * rv) / det
        k_vr, k_vv = (rv * s_vv - vv * rv) / det, (vv * s_rr - rv * rv) / det
        self.r = added(added(self.r, k_rr, miss_r), k_rv, miss_v)
        self.v = added(added(self.v, k_vr, miss_r), k_vv, miss_v)
        if self.corrected is not None and self.force > 1.0:
            since = max(i.gnss_time_s - self.corrected, h)
            self.tilt = added(self.tilt, 0.05 * k_vv * k_vv / since / self.force, miss_v)
        self.corrected = i.gnss_time_s
        self.p_rr, self.p_rv = rr - k_rr * rr - k_rv * rv, rv - k_rr * rv - k_rv * vv
        self.p_vv = vv - k_vr * rv - k_vv * vv


class Guidance:
    """The linear tangent law to the target orbit, solved once per second (guidance.h)."""

    def __init__(self, nav, i):
        s = nav.s
        self.nav, self.mu = nav, s.mu_m3ps2
        self.radius = s.equator_m + i.target_perigee_m
        self.semimajor = s.equator_m + 0.5 * (i.target_perigee_m + i.target_apogee_m)
        self.speed = math.sqrt(self.mu * (2.0 / self.radius - 1.0 / self.semimajor))
        self.phase, self.next_s, self.solved_s, self.begun_s, self.cutoff_s = "waiting", -1.0, 0.0, 0.0, -1.0
        self.accel, self.last, self.x = 0.0, None, [0.0] * 5

    def direction(self, x, t):
        s = (t - self.begun_s) / SLOPE_S
        forward, normal, up = self.axes
        return unit(added(added(forward, x[0] + x[1] * s, up), x[2] + x[3] * s, normal))

    def thrust(self, t):
        return self.accel / max(1.0 - self.accel * (t - self.last[0]) / EXHAUST_MPS, 0.01)

    def predict(self, x, t):
        """Return the residuals at the end of the burn, km and m/s."""

        def acceleration(time_s, at):
            return added(self.nav.gravitation(at), self.thrust(time_s), self.direction(x, time_s))

        r, v, h = self.nav.r, self.nav.v, SLOPE_S * x[4] / STEPS
        for step in range(STEPS):
            now = t + step * h
            a_1 = acceleration(now, r)
            v_2 = added(v, 0.5 * h, a_1)
            a_2 = acceleration(now + 0.5 * h, added(r, 0.5 * h, v))
            v_3 = added(v, 0.5 * h, a_2)
            a_3 = acceleration(now + 0.5 * h, added(r, 0.5 * h, v_2))
            v_4 = added(v, h, a_3)
            a_4 = acceleration(now + h, added(r, h, v_3))
            r = added(r, h / 6.0, added(added(v, 1.0, v_4), 2.0, added(v_2, 1.0, v_3)))
            v = added(v, h / 6.0, added(added(a_1, 1.0, a_4), 2.0, added(a_2, 1.0, a_3)))
        radius, normal = norm(r), self.axes[1]
        across = dot(r, normal) / 1e3, dot(v, normal)
        return [(radius - self.radius) / 1e3, dot(v, r) / radius, norm(v) - self.speed, *across]

    def solve(self, t, trials):
        for _ in range(trials):
            base = self.predict(self.x, t)
            if max(map(abs, base)) < 1e-3:
                break
            columns = []
            for k in range(5):
                by = 1e-5 if k < 4 else 1e-4
                moved = self.predict([x + by * (j == k) for j, x in enumerate(self.x)], t)
                columns.append([(a - b) / by for a, b in zip(moved, base, strict=True)])
            step = solve_rows([[*(c[i] for c in columns), -base[i]] for i in range(5)])
            if step is None:
                break
            share = min(1.0, 0.3 / max(*map(abs, step), 1e-300))
            self.x = [x + share * d for x, d in zip(self.x, step, strict=True)]
            self.x[4] = min(max(self.x[4], 1e-3), 0.95 * EXHAUST_MPS / self.thrust(t) / SLOPE_S)
        return max(map(abs, self.predict(self.x, t)))

    def choose_axes(self, inclination_rad, t):
        r, v = self.nav.r, self.nav.v
        radius, speed, flat = norm(r), norm(v), math.hypot(r[0], r[1])
        normal = unit(cross(r, v))
        if inclination_rad >= 0.0:
            east = (-r[1] / flat, r[0] / flat, 0.0)
            cosine = min(max(math.cos(inclination_rad) * radius / flat, -1.0), 1.0)
            sine = math.copysign(math.sqrt(1.0 - cosine * cosine), dot(normal, east))
            normal = added(tuple(cosine * x for x in unit(cross(r, east))), sine, east)
        missing = abs(self.speed - speed) + 9.8 * abs(dot(r, v)) / radius / max(self.accel, 1.0)
        burn_s = EXHAUST_MPS / self.accel * (1.0 - math.exp(-missing / EXHAUST_MPS))
        angle = 0.5 * (speed + self.speed) * burn_s / radius
        up = added(tuple(math.cos(angle) * x for x in r), math.sin(angle), cross(normal, r))
        up = unit(added(up, -dot(up, normal), normal))
        self.axes, self.begun_s, self.x = (cross(normal, up), normal, up), t, [0.4, -0.2, 0.0, 0.0, burn_s / SLOPE_S]

    def measure(self, t):
        """Measure the thrust acceleration over the last cycle, and return True if it is steady."""
        r, v, steady = self.nav.r, self.nav.v, False
        if self.last is not None and t - self.last[0] < 2.5:
            since, middle = t - self.last[0], tuple(0.5 * (a + b) for a, b in zip(r, self.last[1], strict=True))
            gained = tuple((a - b) / since for a, b in zip(v, self.last[2], strict=True))
            mean = norm(added(gained, -1.0, self.nav.gravitation(middle)))
            now = mean * (1.0 + 0.5 * since * mean / EXHAUST_MPS)
            steady, self.accel = abs(now - self.accel) < 0.1 * now, now
        self.last = (t, r, v)
        return steady and self.accel > 1.0

    def step(self, i, h):
        """Return the direction of thrust in I, or None before the first solution."""
        t = i.time_s
        if self.phase in ("waiting", "steering") and t >= self.next_s:
            self.next_s = t + 1.0
            if self.measure(t):
                if self.phase == "waiting":
                    self.choose_axes(i.target_inclination_rad, t)
                if self.solve(t, 3 if self.phase == "steering" else 40) < 1.0:
                    self.phase, self.solved_s = "steering", t
                elif t - self.solved_s > 10.0:
                    self.phase = "waiting"
        if self.phase == "steering" and self.solved_s + SLOPE_S * self.x[4] - t < ENDING_S:
            self.phase = "ending"
        if self.phase == "waiting":
            return None
        u = self.direction(self.x, t)
        if self.phase == "ending":
            r, v, a = self.nav.r, self.nav.v, self.thrust(t)
            wanted = 0.5 * self.mu * (2.0 / norm(r) - 1.0 / self.semimajor) - 0.5 * dot(v, v)
            power = a * dot(u, v)
            growth = a * a + power * a / EXHAUST_MPS
            left_s = wanted / (power + 0.5 * growth * wanted / power)
            if left_s < 1.5 * h:
                self.cutoff_s, self.phase = max(left_s, 0.0), "ended"
        return u


def solve_rows(m):
    """Solve five equations by Gauss-Jordan elimination; the last column is the right-hand side. None if singular."""
    for k in range(5):
        best = max(range(k, 5), key=lambda i: abs(m[i][k]))
        if not abs(m[best][k]) > 1e-12:
            return None
        m[k], m[best] = m[best], m[k]
        m[k] = [x / m[k][k] for x in m[k]]
        m = [row if i == k else [a - row[k] * b for a, b in zip(row, m[k], strict=True)] for i, row in enumerate(m)]
    return [row[5] for row in m]


class Law:
    """PD with the bending filter of each stage, roll by gimbals and by thrusters, from a design of simvehicle."""

    def __init__(self, path, sample_s):
        design = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        self.gains = [(row["time_s"], row["k_p"], row["k_d_s"]) for row in design["gains"]["table"]]
        self.roll, self.gimbal = design["roll"], design["roll_gimbal"]
        filters = [own.get("filter") or design["filter"] for own in design.get("stage") or [{}]]
        self.filters = [[section(q, f["prewarp_hz"], sample_s) for q in f.get("quadratic", ())] for f in filters]
        self.stage, self.memory, self.fired, self.ticks = 0, [], 0, 0
        self.shortest = round(self.roll["minimum_on_s"] / sample_s)

    def step(self, i, error, rate):
        t, rows = i.time_s, self.gains
        k = max(1, min(len(rows) - 1, sum(row[0] <= t for row in rows)))
        (t_0, *first), (t_1, *then) = rows[k - 1], rows[k]
        share = min(max((t - t_0) / (t_1 - t_0), 0.0), 1.0)
        k_p, k_d = (a + share * (b - a) for a, b in zip(first, then, strict=True))
        commands = [-k_p * error[axis] - k_d * rate[axis] for axis in (1, 2)]
        filters = self.filters[min(i.stage, len(self.filters) - 1)]
        if not self.memory or i.stage != self.stage:
            self.memory = [[settled(f, c) for f in filters] for c in commands]
            self.stage = i.stage
        for axis in range(2):
            for f, m in zip(filters, self.memory[axis], strict=True):
                value = commands[axis]
                commands[axis] = f[0] * value + m[0]
                m[0] = f[1] * value - f[3] * commands[axis] + m[1]
                m[1] = f[2] * value - f[4] * commands[axis]
        limit = math.radians(self.gimbal["limit_deg"])
        roll = -self.gimbal["k_p"] * error[0] - self.gimbal["k_d_s"] * rate[0]
        return commands, min(max(roll, -limit), limit), self.thruster(error[0], rate[0])

    def thruster(self, error, rate):
        if self.fired != 0 and self.ticks < self.shortest:
            self.ticks += 1
            return self.fired
        band, line = math.radians(self.roll["dead_band_deg"]), error + self.roll["k_rate_s"] * rate
        off = band - math.radians(self.roll["hysteresis_deg"])
        wanted = 0
        if line > band or (self.fired < 0 and line > off):
            wanted = -1
        elif line < -band or (self.fired > 0 and line < -off):
            wanted = 1
        self.ticks = 0 if wanted == 0 else self.ticks + 1 if wanted == self.fired else 1
        self.fired = wanted
        return wanted


def section(q, prewarp_hz, sample_s):
    """Return b0, b1, b2, a1, a2 of a quadratic section by the prewarped bilinear transform."""
    w = 2.0 * math.pi * prewarp_hz
    c = w / math.tan(0.5 * w * sample_s)
    (n_1, n_2), (d_1, d_2) = (
        (2.0 * q[f"{part}_zeta"] * c / wp, (c / wp) ** 2)
        for part in ("zero", "pole")
        for wp in (2.0 * math.pi * q[f"{part}_hz"],)
    )
    a_0 = 1.0 + d_1 + d_2
    values = 1.0 + n_1 + n_2, 2.0 * (1.0 - n_2), 1.0 - n_1 + n_2, 2.0 * (1.0 - d_2), 1.0 - d_1 + d_2
    return tuple(x / a_0 for x in values)


def settled(f, value):
    """Return the memory of a section whose input and output have been `value`."""
    second = (f[2] - f[4]) * value
    return [(f[1] - f[3]) * value + second, second]


class Computer:
    interface = 2

    def __init__(self, setup):
        self.s, self.h = setup, 1e-9 * setup.sample_ns
        self.nav, self.law = Navigation(setup), Law(setup.settings.decode(), self.h)
        self.orbit, self.command, self.phase, self.since, self.lit = None, (1.0, 0.0, 0.0, 0.0), PAD, 0.0, False

    def step(self, i):
        self.nav.step(i)
        self.steer(i)
        out = self.sequence(i)
        q = product(conjugate(self.command), product(conjugate(tuple(self.s.start_q_RI)), self.nav.q))
        y, z = 2.0 * (q[1] * q[3] + q[0] * q[2]), 2.0 * (q[0] * q[3] - q[1] * q[2])
        sine, cosine = math.hypot(y, z), q[0] ** 2 + q[1] ** 2 - q[2] ** 2 - q[3] ** 2
        k = 1.0 if sine < 1e-9 else math.atan2(sine, cosine) / sine
        limit, roll = self.s.angle_error_limit_rad, 2.0 * math.atan2(math.copysign(1.0, q[0]) * q[1], abs(q[0]))
        error = [min(max(angle, -limit), limit) for angle in (roll, k * y, k * z)]
        gimbal, roll_gimbal, thruster = self.law.step(i, error, [x / self.h for x in self.nav.last])
        monitor = [*self.nav.r, *self.nav.v, self.phase, self.nav.rejected]
        own = {"gimbal_rad": gimbal, "roll_gimbal_rad": roll_gimbal, "roll_thruster": thruster, "monitor": monitor}
        return {**own, "commanded_q_BR": self.command, **out}

    def enter(self, phase, t):
        self.phase, self.since = phase, t

    def sequence(self, i):
        t, out, pressure = i.time_s, {}, i.chamber_pressure[0]
        if self.phase == PAD:
            out["ignition"] = 1
            self.enter(FIRST_STAGE, t)
        elif self.phase == FIRST_STAGE:
            self.lit |= pressure > 0.5
            if self.lit and pressure < 0.01:
                self.enter(BURNED_OUT, t)
        elif self.phase == BURNED_OUT:
            out["stage_separation"] = int(t - self.since > SEPARATION_S)
            if i.discretes & SEPARATED[0]:
                self.enter(WAITING, t)
        elif self.phase == WAITING and t - self.since > IGNITION_S:
            out["ignition"], self.lit, self.orbit = 1, False, Guidance(self.nav, i)
            self.enter(SECOND_STAGE, t)
        elif self.phase == SECOND_STAGE:
            self.lit |= pressure > 0.5
            out["fairing_separation"] = int(t - self.since > FAIRING_S and not i.discretes & SEPARATED[1])
            if self.orbit.cutoff_s >= 0.0:
                out["cutoff"], out["cutoff_delay_s"] = 1, max(self.orbit.cutoff_s - 1e-9 * self.s.delay_ns, 0.0)
            if self.orbit.cutoff_s >= 0.0 or (self.lit and pressure < 0.01):
                self.enter(CUT_OFF, t)
        return out

    def steer(self, i):
        place = min(max((i.time_s - 5.0) / 5.0, 0.0), len(PITCH_DEG) - 1.0)
        k, u = min(int(place), len(PITCH_DEG) - 2), None
        if self.phase == SECOND_STAGE and self.lit:
            u = self.orbit.step(i, self.h)
        elif self.phase < WAITING:
            half = -0.5 * math.radians(PITCH_DEG[k] + (place - k) * (PITCH_DEG[k + 1] - PITCH_DEG[k]))
            self.command = (math.cos(half), 0.0, math.sin(half), 0.0)
        if u is None:
            return
        own = rotate(conjugate(product(tuple(self.s.start_q_RI), self.command)), u)
        sine = math.hypot(own[1], own[2])
        angle = min(math.atan2(sine, own[0]), TURN_RATE_RADPS * self.h)
        if sine > 0.0:
            self.command = turned(self.command, (0.0, -angle * own[2] / sine, angle * own[1] / sine))
