"""maxq as the physics backend of ArduPilot: its JSON interface over UDP, as flight code in Python.

    simrun fly examples/flight_software/ardupilot/ksr3.toml --pace

The bridge follows ArduPilot's description of the interface (libraries/SITL/examples/JSON/readme.md). It was tested with
a substitute for ArduPilot (tests/ardupilot_peer.py), not with ArduPilot.

ArduPilot sends a packet of servo outputs and waits for a line of JSON with the state, in lock-step. The state comes
from the sensors of the scenario: GNSS position and velocity of the antenna relative to the place of the start, attitude
by the gyro, rates and specific force. Ideal sensors give the true state, to which ArduPilot adds its own errors.

The key `settings` contains pairs name=value:

- port: port for ArduPilot's packets on this machine (9002).
- wait_s: time limit for a packet, below vehicle.computer.timeout_s (1.5). The first one may take 30 s.
- pitch, yaw, roll, ignition: servo outputs, from 1; 0: none (1, 2, 3, 0). 1000 to 2000 us are -full_deg to full_deg of
  the gimbals; roll thrusters fire beyond 1300 and 1700 us, and the engines start above 1500 us, which needs
  vehicle.computer.sequencing = "flight-code".
- full_deg: gimbal angle at 1000 and 2000 us (4).
- axes: "plane" (x forward, the nose) or "copter" (z down, to the tail) for the body axes of ArduPilot (plane).
"""

import json
import math
import socket
import struct
import time

PACKETS = {18458: struct.Struct("<HHI16H"), 29569: struct.Struct("<HHI32H")}  # by magic: rate, frame, outputs
START_S = 30.0
FLATTENING = 1.0 / 298.257223563  # WGS 84
HEALTH_ACCELEROMETER, HEALTH_GNSS = 2, 8
DEFAULTS = {"port": 9002, "wait_s": 1.5, "pitch": 1, "yaw": 2, "roll": 3, "ignition": 0, "full_deg": 4.0}
COPTER = (math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0)  # from axes with z to the tail to those with x to the nose


class Bridge:
    """The flight code of one flight, which asks ArduPilot for its commands."""

    interface = 2

    def __init__(self, setup):
        given = dict(pair.split("=", 1) for pair in setup.settings.decode().split())
        self.axes = given.pop("axes", "plane")
        unknown = sorted(given.keys() - DEFAULTS.keys())
        if unknown or self.axes not in ("plane", "copter"):
            raise ValueError(f"settings: {unknown[0] if unknown else self.axes} is unknown")
        self.of = DEFAULTS | {name: type(DEFAULTS[name])(text) for name, text in given.items()}
        self.sample_s = 1e-9 * setup.sample_ns
        self.spin_radps, self.start_q_RI = setup.earth_rate_radps, tuple(setup.start_q_RI)
        self.start_E_m = about_z(tuple(setup.start_r_I_m), -self.spin_radps * 1e-9 * setup.start_ns)
        self.to_ned = level(self.start_E_m, setup.equator_m, FLATTENING if setup.j2 > 0.0 else 0.0)
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", self.of["port"]))
        self.peer, self.frame, self.line = None, None, b""
        self.pwm = self.receive(START_S)

    def step(self, inputs):
        self.line = b"\n" + json.dumps(self.state(inputs), separators=(",", ":")).encode() + b"\n"
        self.socket.sendto(self.line, self.peer)
        self.pwm = self.receive(self.of["wait_s"])
        return self.commands() | {"commanded_q_BR": inputs.q_BR}  # ArduPilot does not send its commanded attitude

    def close(self):
        self.socket.close()

    def receive(self, wait_s):
        """Return the servo outputs of the next frame, us. A frame that is repeated asks for the last state again."""
        until_s = time.monotonic() + wait_s
        while True:
            left_s = until_s - time.monotonic()
            who = f"ArduPilot at {self.peer[0]}:{self.peer[1]}" if self.peer else f"ArduPilot on port {self.of['port']}"
            if left_s <= 0.0:
                raise TimeoutError(f"{who}: no packet within {wait_s:g} s")
            self.socket.settimeout(left_s)
            try:
                packet, sender = self.socket.recvfrom(4096)
            except TimeoutError:
                continue
            if self.peer is not None and sender != self.peer:
                continue
            magic = int.from_bytes(packet[:2], "little")
            if magic not in PACKETS or len(packet) != PACKETS[magic].size:
                raise ValueError(f"{who}: {len(packet)} bytes with magic {magic} are no packet of servo outputs")
            _, _, frame, *pwm = PACKETS[magic].unpack(packet)
            if self.peer is None or frame == self.frame + 1:
                self.peer, self.frame = sender, frame
                return pwm
            if frame != self.frame:
                raise ValueError(f"{who}: frame {frame} after {self.frame}; ArduPilot has been started again")
            self.socket.sendto(self.line, self.peer) if self.line else None

    def output(self, name, otherwise=1500):
        channel = self.of[name]
        return self.pwm[channel - 1] if channel else otherwise

    def commands(self):
        """Return the outputs of flight code for the servo outputs of ArduPilot."""
        full_rad = math.radians(self.of["full_deg"])
        roll = self.output("roll")
        return {
            "gimbal_rad": [full_rad * (self.output(axis) - 1500) / 500 for axis in ("pitch", "yaw")],
            "roll_thruster": 1 if roll > 1700 else -1 if roll < 1300 else 0,
            "ignition": int(self.output("ignition", 0) > 1500),
        }

    def state(self, inputs):
        """Return the state of the vehicle at a sample, in the axes of ArduPilot: north, east, down and body."""
        if not inputs.health & HEALTH_GNSS:
            raise ValueError("the bridge needs a solution of [gnss] at every sample")
        if not any(inputs.delta_velocity_mps):
            raise ValueError("the bridge needs [stage.accelerometer]")
        q_BI = times(self.start_q_RI, inputs.q_BR)
        angle_rad = -self.spin_radps * inputs.time_s
        q_BE = times((math.cos(0.5 * angle_rad), 0.0, 0.0, math.sin(0.5 * angle_rad)), q_BI)
        away_m = [now - start for now, start in zip(inputs.gnss_r_E_m, self.start_E_m, strict=True)]
        gyro = [x / self.sample_s for x in inputs.delta_angle_rad]
        force = [x / self.sample_s for x in inputs.delta_velocity_mps]
        attitude = times(as_quaternion(self.to_ned), q_BE)
        if self.axes == "copter":
            attitude = times(attitude, COPTER)
            gyro, force = ([x[2], x[1], -x[0]] for x in (gyro, force))
        return {
            "timestamp": inputs.time_s,
            "imu": {"gyro": gyro, "accel_body": force},
            "position": turned(self.to_ned, away_m),
            "quaternion": list(attitude),
            "velocity": turned(self.to_ned, inputs.gnss_v_E_mps),
        }


def about_z(v, angle_rad):
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return c * v[0] - s * v[1], s * v[0] + c * v[1], v[2]


def level(r_E_m, equator_m, flattening):
    """Return north, east and down at an Earth-fixed position as rows (3, 3). On a flat Earth, E is this frame."""
    x, y, z = r_E_m
    p = math.hypot(x, y)
    if math.hypot(p, z) < 1e6:
        return (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    latitude, e2 = math.atan2(z, p), flattening * (2.0 - flattening)
    for _ in range(6):  # geodetic; each pass reduces the error by the factor e2
        normal_m = equator_m / math.sqrt(1.0 - e2 * math.sin(latitude) ** 2)
        latitude = math.atan2(z, p - e2 * normal_m * math.cos(latitude))
    sin_lat, cos_lat, sin_lon, cos_lon = math.sin(latitude), math.cos(latitude), y / p, x / p
    north = (-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat)
    return north, (-sin_lon, cos_lon, 0.0), (-cos_lat * cos_lon, -cos_lat * sin_lon, -sin_lat)


def turned(rows, v):
    return [sum(a * b for a, b in zip(row, v, strict=True)) for row in rows]


def times(p, q):
    """Return the product of two quaternions, scalar first."""
    return (
        p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
        p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
        p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
        p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
    )


def as_quaternion(m):
    """Return the quaternion, scalar first, of a rotation matrix (3, 3)."""
    sizes = [m[0][0] + m[1][1] + m[2][2], m[0][0], m[1][1], m[2][2]]
    largest = sizes.index(max(sizes))
    if largest == 0:
        q = [1.0 + sizes[0], m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]]
    else:
        i, j, k = largest - 1, largest % 3, (largest + 1) % 3
        q = [m[k][j] - m[j][k], 0.0, 0.0, 0.0]
        q[1 + i] = 1.0 + m[i][i] - m[j][j] - m[k][k]
        q[1 + j], q[1 + k] = m[j][i] + m[i][j], m[k][i] + m[i][k]
    length = math.sqrt(sum(x * x for x in q))
    return tuple(x / length for x in q)
