"""The bridge to ArduPilot's JSON interface, flown with a peer that speaks ArduPilot's side (ardupilot_peer.py).

| result | compared with |
|---|---|
| flight with the peer's attitude law behind UDP | the same law in the flight code, bit for bit |
| position, velocity, attitude and specific force of the JSON lines | true motion of the log |
| axes of a copter | rotation matrices in NumPy |
| lost, repeated and wrong packets | the interface's description |
"""

from __future__ import annotations

import importlib.util
import json
import math
import shutil
import socket
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import ardupilot_peer
import numpy as np
import pytest
from ardupilot_peer import Hold, Peer
from flight_code import EXAMPLES
from scipy.spatial.transform import Rotation

from maxq import Flight
from maxq.sim.run.fly import fly
from maxq.sim.run.instances import Setup
from maxq.sim.scenario.loader import load_scenario

BRIDGE = EXAMPLES / "ardupilot"
LIGHT_S = 0.5
SETTINGS = "wait_s=20 pitch=1 yaw=2 roll=3 full_deg=4 ignition=4"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.bind(("127.0.0.1", 0))
        return int(made.getsockname()[1])


def flown(*more: str, settings: str) -> Flight:
    given = ["run.duration_s=6", "vehicle.computer.timeout_s=25", f"vehicle.computer.settings={settings}"]
    given += ["vehicle.computer.sample_s=0.01", "vehicle.computer.delay_s=0.003", "vehicle.gnss.period_s=0.01"]
    given += ["switches.bending=false", "switches.slosh=false", "wind.speed_mps=6", "wind.from_deg=250"]
    return fly(load_scenario(BRIDGE / "ksr3.toml", [*given, *more]))


@pytest.fixture(scope="module")
def flight_and_peer() -> tuple[Flight, Peer]:
    port = free_port()
    peer = Peer(port, Hold(LIGHT_S))
    try:
        return flown(settings=f"port={port} {SETTINGS}"), peer
    finally:
        peer.close()


def test_the_peer_closes_the_attitude_loop(flight_and_peer: tuple[Flight, Peer]) -> None:
    """The vehicle leaves the pad after the engine's start and stays upright in a wind of 6 m/s."""
    flight, peer = flight_and_peer
    assert (flight.outcome, peer.error) == ("duration", "")
    assert len(peer.states) == 599  # the peer answers each sample
    assert peer.states[-1]["timestamp"] == [5.99]
    assert flight.event_s("ignition") == pytest.approx(LIGHT_S + 0.003)
    assert flight.final["altitude_m"] > 150.0
    assert 0.05 < np.abs(flight["gimbal_pitch_command_deg"]).max() < 2.0
    upright = [Rotation.from_quat(s["quaternion"], scalar_first=True).apply([1, 0, 0])[2] for s in peer.states]
    assert max(np.degrees(np.arccos(-np.array(upright)))) < 1.0


def test_the_law_behind_the_socket_has_the_bits_of_the_law_in_the_flight_code(
    flight_and_peer: tuple[Flight, Peer], tmp_path: Path
) -> None:
    shutil.copy(BRIDGE / "bridge.py", tmp_path)
    shutil.copy(ardupilot_peer.__file__, tmp_path)
    (tmp_path / "own.py").write_text(
        "from ardupilot_peer import Hold\n"
        "import bridge\n"
        "class Own(bridge.Bridge):\n"
        "    def __init__(self, setup):\n"
        f"        self.law = Hold({LIGHT_S})\n"
        "        super().__init__(setup)\n"
        "    def receive(self, wait_s): return [1500] * 16\n"
        "    def step(self, inputs):\n"
        "        state = self.state(inputs)\n"
        "        flat = state | state['imu'] | {'timestamp': [state['timestamp']]}\n"
        "        self.pwm = self.law(flat)\n"
        "        return self.commands() | {'commanded_q_BR': inputs.q_BR}\n"
    )
    own = flown(f"vehicle.computer.python={tmp_path}/own.py:Own", settings=f"port={free_port()} {SETTINGS}")
    assert own.state_hash == flight_and_peer[0].state_hash


def test_the_lines_contain_the_motion_of_the_log(flight_and_peer: tuple[Flight, Peer]) -> None:
    """Compare with the log: rotations to 0.01 deg, velocities to the motion of the antenna about the CG.

    The peer's first frame is at the CG of the start; the antenna is a constant lever arm ahead of it.
    """
    flight, peer = flight_and_peer
    times = np.array([state["timestamp"][0] for state in peer.states])

    def logged(name: str) -> Any:
        return np.interp(times, flight.time_s(name), flight[name])

    velocity = np.array([state["velocity"] for state in peer.states])
    truth = np.column_stack([logged(f"v_N_{axis}_mps") for axis in ("north", "east", "down")])
    assert np.abs(velocity - truth).max() < 0.05
    down = np.array([state["position"][2] for state in peer.states])
    climb = logged("altitude_m") - logged("altitude_m")[0]
    assert np.abs(down - down[0] + climb).max() < 0.1
    for k in (300, 598):  # on the pad, yaw and roll of the log are about the same axis
        angles = [float(logged(f"{name}_deg")[k]) for name in ("yaw", "pitch", "roll")]
        expected = Rotation.from_euler("ZYX", angles, degrees=True)
        found = Rotation.from_quat(peer.states[k]["quaternion"], scalar_first=True)
        assert np.degrees((expected.inv() * found).magnitude()) < 0.01
    # specific force over a second of steady thrust: change of velocity less gravity
    late = slice(400, 501)
    force = np.array([s["accel_body"] for s in peer.states[late]])
    turned = [
        Rotation.from_quat(s["quaternion"], scalar_first=True).apply(f)
        for s, f in zip(peer.states[late], force, strict=True)
    ]
    gained = velocity[500] - velocity[400]
    assert np.mean(turned[1:], axis=0) == pytest.approx(gained - [0.0, 0.0, 9.799], abs=0.06)


# --- the bridge alone


def bridge_module() -> ModuleType:
    spec = importlib.util.spec_from_file_location("ardupilot_bridge", BRIDGE / "bridge.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


BRIDGE_MODULE = bridge_module()


class Autopilot:
    """ArduPilot's socket, with packets that a test sends one by one, and a bridge that receives them."""

    def __init__(self, settings: str, outputs: int) -> None:
        self.outputs, self.port = outputs, free_port()
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", 0))
        self.socket.settimeout(5.0)
        self.name = f"ArduPilot at 127.0.0.1:{self.socket.getsockname()[1]}"
        setup = Setup(sample_ns=10_000_000, settings=f"port={self.port} wait_s=0.2 {settings}".encode())
        setup.start_q_RI[:] = (math.sqrt(0.5), 0.0, math.sqrt(0.5), 0.0)  # on a flat Earth: x upwards
        self.before = BRIDGE_MODULE.Bridge.receive
        BRIDGE_MODULE.Bridge.receive = lambda bridge, wait_s: []
        try:
            self.bridge = BRIDGE_MODULE.Bridge(setup)
        finally:
            BRIDGE_MODULE.Bridge.receive = self.before

    def send(self, frame: int, *pwm: int, magic: int = 0) -> None:
        magic = magic or {16: 18458, 32: 29569}[self.outputs]
        values = [*pwm, *((self.outputs - len(pwm)) * [1500])]
        packet = struct.pack(f"<HHI{self.outputs}H", magic, 100, frame, *values)
        self.socket.sendto(packet, ("127.0.0.1", self.port))

    def receive(self) -> list[int]:
        self.bridge.pwm = self.bridge.receive(0.2)
        return list(self.bridge.pwm)


@contextmanager
def autopilot(settings: str = "", outputs: int = 16) -> Iterator[Autopilot]:
    made = Autopilot(settings, outputs)
    try:
        yield made
    finally:
        made.bridge.close()
        made.socket.close()


def inputs(**changed: Any) -> SimpleNamespace:
    values = {"health": 15, "time_s": 0.25, "q_BR": (1.0, 0.0, 0.0, 0.0), "delta_angle_rad": (1e-4, 2e-4, 3e-4)}
    values |= {
        "gnss_r_E_m": (1.0, 2.0, -3.0),
        "gnss_v_E_mps": (4.0, 5.0, -6.0),
        "delta_velocity_mps": (0.1, 0.02, 0.03),
    }
    return SimpleNamespace(**values | changed)


@pytest.mark.parametrize("outputs", [16, 32])
def test_servo_outputs_are_commands(outputs: int) -> None:
    with autopilot("ignition=4 full_deg=5", outputs) as there:
        there.send(7, 1750, 1400, 1900, 1600)
        assert len(there.receive()) == outputs
        commands = there.bridge.commands()
        assert np.degrees(commands["gimbal_rad"]) == pytest.approx([2.5, -1.0])
        assert (commands["roll_thruster"], commands["ignition"]) == (1, 1)
        there.send(8, 1500, 1500, 1100, 1400)
        there.receive()
        assert there.bridge.commands() == {"gimbal_rad": [0.0, 0.0], "roll_thruster": -1, "ignition": 0}


def test_a_repeated_frame_asks_for_the_last_line_again() -> None:
    with autopilot() as there:
        there.send(0)
        there.receive()
        there.send(1, 1600)
        assert there.bridge.step(inputs())["gimbal_rad"][0] == pytest.approx(math.radians(0.8))
        there.send(1, 1600)
        there.send(2, 1700)
        there.receive()
        first, second = there.socket.recv(4096), there.socket.recv(4096)
        assert first == second
        assert ardupilot_peer.parsed(first)["position"] == [1.0, 2.0, -3.0]


@pytest.mark.parametrize(
    ("frames", "magic", "said"),
    [
        ((0, 1, 0), 0, "{}: frame 0 after 1; ArduPilot has been started again"),
        ((0, 2), 0, "{}: frame 2 after 0; ArduPilot has been started again"),
        ((0, 1), 4711, "{}: 40 bytes with magic 4711 are no packet of servo outputs"),
        ((0,), 0, "{}: no packet within 0.2 s"),
    ],
)
def test_a_fault_of_the_peer_is_a_line_that_names_it(frames: tuple[int, ...], magic: int, said: str) -> None:
    with autopilot() as there:
        for k, frame in enumerate(frames):
            there.send(frame, magic=magic if k > 0 else 0)
        for _ in range(len(frames) - 1 if len(frames) > 1 else 1):
            there.receive()
        with pytest.raises((ValueError, TimeoutError)) as error:
            there.receive()
        assert str(error.value) == said.format(there.name)


def test_the_axes_of_a_copter_have_z_to_the_tail() -> None:
    """The same directions in both axes, and a level attitude of a copter on the pad."""
    with autopilot() as plane, autopilot("axes=copter") as copter:
        states = [there.bridge.state(inputs()) for there in (plane, copter)]
        turns = [Rotation.from_quat(state["quaternion"], scalar_first=True) for state in states]
        for name in ("gyro", "accel_body"):
            in_ned = [turn.apply(state["imu"][name]) for turn, state in zip(turns, states, strict=True)]
            assert in_ned[0] == pytest.approx(in_ned[1], abs=1e-12)
        assert turns[0].apply([1, 0, 0]) == pytest.approx([0, 0, -1], abs=1e-12)
        assert turns[1].apply([0, 0, 1]) == pytest.approx([0, 0, 1], abs=1e-12)
        assert json.loads(json.dumps(states[1]))["timestamp"] == 0.25


@pytest.mark.parametrize(
    ("changed", "said"),
    [({"health": 7}, r"a solution of \[gnss\]"), ({"delta_velocity_mps": (0.0, 0.0, 0.0)}, "accelerometer")],
)
def test_sensors_that_are_missing_are_an_error(changed: dict[str, Any], said: str) -> None:
    with autopilot() as there, pytest.raises(ValueError, match=said):
        there.bridge.state(inputs(**changed))


def test_unknown_settings_are_an_error() -> None:
    with pytest.raises(ValueError, match="settings: gain is unknown"), autopilot("gain=2"):
        pass
