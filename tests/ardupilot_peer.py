"""ArduPilot's side of its JSON interface, from libraries/SITL/examples/JSON/readme.md in its repository.

The peer sends servo outputs and waits for a line of JSON, as ArduPilot does, and closes an attitude loop. Like
ArduPilot, it reads a line between two line ends by searching for keys, without a general parser.
"""

from __future__ import annotations

import math
import re
import socket
import struct
import threading
from collections.abc import Callable
from typing import Any

RESEND_S = 1.0
_NUMBER = r"(-?[\d.]+(?:e[-+]?\d+)?)"
_SIZES = {"timestamp": 1, "gyro": 3, "accel_body": 3, "position": 3, "quaternion": 4, "velocity": 3}
State = dict[str, list[float]]


def parsed(data: bytes) -> State:
    """Return the fields of the line between the last two line ends. Keys are followed by `":` and no space."""
    if data[:1] != b"\n" or data[-1:] != b"\n":
        raise ValueError("a line without line ends")
    line = data[1:-1].decode("ascii")
    found = {}
    for key, size in _SIZES.items():
        pattern = f'"{key}":' + (rf"\[{','.join(size * [_NUMBER])}\]" if size > 1 else _NUMBER)
        match = re.search(pattern, line)
        if match is None:
            raise ValueError(f"{key} is missing in {line}")
        found[key] = [float(text) for text in match.groups()]
    return found


class Peer:
    """A thread in place of ArduPilot, whose servo outputs are `law` of the states. `states` keeps all of them."""

    def __init__(self, port: int, law: Callable[[State], list[int]], outputs: int = 16) -> None:
        self.law, self.states, self.frame, self.resent, self.error = law, list[State](), 0, 0, ""
        magic = {16: 18458, 32: 29569}[outputs]
        self._packet, self._magic = struct.Struct(f"<HHI{outputs}H"), magic
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._place, self._ends = ("127.0.0.1", port), threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        outputs = self._packet.size // 2 - 4
        pwm = [1500] * outputs
        while not self._ends.is_set():
            self._socket.sendto(self._packet.pack(self._magic, 100, self.frame, *pwm), self._place)
            state = self._state()
            if state is None:
                self.resent += 1
                continue
            self.states.append(state)
            self.frame += 1
            pwm = self.law(state) + [1500] * (outputs - 4)

    def _state(self) -> State | None:
        self._socket.settimeout(0.1 if not self.states else RESEND_S)
        try:
            return parsed(self._socket.recv(65000))
        except TimeoutError:
            return None
        except ValueError as error:
            self.error = str(error)
            self._ends.set()
            return None

    def close(self) -> None:
        self._ends.set()
        self._thread.join(5.0)
        assert not self._thread.is_alive()
        self._socket.close()


class Hold:
    """A PD law that holds the first attitude, and starts the engine at `light_s`; its outputs are in us."""

    def __init__(self, light_s: float = math.inf, full_deg: float = 4.0) -> None:
        self.light_s, self.full_rad, self.first = light_s, math.radians(full_deg), list[float]()

    def __call__(self, state: State) -> list[int]:
        q, gyro = state["quaternion"], state["gyro"]
        self.first = self.first or q
        error = product([self.first[0], *(-x for x in self.first[1:])], q)  # from the first to the present body axes
        pitch, yaw = (-1.1 * 2.0 * error[k + 1] - 0.47 * gyro[k] for k in (1, 2))
        s = 2.0 * error[1] + 0.5 * gyro[0]
        roll = 1100 if s > 0.017 else 1900 if s < -0.017 else 1500
        gimbal = [min(max(round(1500 + 500 * angle / self.full_rad), 1000), 2000) for angle in (pitch, yaw)]
        return [*gimbal, roll, 1900 if state["timestamp"][0] >= self.light_s else 1000]


def product(p: Any, q: Any) -> list[float]:
    """Return the product of two quaternions, scalar first."""
    a, b, c, d = p
    e, f, g, h = q
    return [
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    ]
