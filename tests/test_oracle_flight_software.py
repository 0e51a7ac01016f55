"""External flight code agrees with the built-in law, and the interface with a C compiler.

| item | against |
|---|---|
| layout of the structs | offsetof and sizeof of a C compiler |
| PD law by hand in C and in Python, and with an observer | the built-in law, over the nominal flight |
| the same law in a separate process, over TCP and UDP | the built-in law |
| the observer's estimate | angular acceleration of the log less the gimbal's contribution |
"""

from __future__ import annotations

import ctypes
import socket
import subprocess
import threading
from pathlib import Path

import numpy as np
import pytest
from flight_code import EXAMPLES, compiled, flies, needs_compiler

from maxq import Flight
from maxq.control.external import FswInputs, FswOutputs
from maxq.control.kernel.records import dtype_of
from maxq.sim.run.fly import fly
from maxq.sim.run.instances import Outputs, Setup, size_of
from maxq.sim.scenario.loader import load_scenario

POWERED = ["run.duration_s=59", "requirement="]
DAC_STEP_DEG = 0.001  # of KSR-III
COMMANDS = ("gimbal_pitch_command_deg", "gimbal_yaw_command_deg")


@needs_compiler
def test_the_structs_are_those_of_the_header(tmp_path: Path) -> None:
    expected, lines = [], []
    for struct, layout in (("inputs", dtype_of(FswInputs)), ("outputs", dtype_of(FswOutputs))):
        places = {name: place[1] for name, place in (layout.fields or {}).items()}
        places |= {"": layout.itemsize}
        expected += list(places.values())
        lines += [_asked(f"maxq_fsw_{struct}", name) for name in places]
    setup = {name: getattr(Setup, name).offset for name, _ in Setup._fields_} | {"": ctypes.sizeof(Setup)}
    expected += list(setup.values())
    lines += [_asked("maxq_fsw_setup", name) for name in setup]
    source = tmp_path / "layout.c"
    head = '#include <stddef.h>\n#include <stdio.h>\n#include "maxq_fsw.h"\n'
    source.write_text(f"{head}int main(void)\n{{\n" + "\n".join(lines) + "\nreturn 0;\n}\n")
    said = subprocess.run(
        [compiled(tmp_path, source, "layout", program=True)], capture_output=True, text=True, check=True
    )
    assert [int(word) for word in said.stdout.split()] == expected


def _asked(struct: str, name: str) -> str:
    what = f"offsetof({struct}, {name})" if name else f"sizeof({struct})"
    return f'printf("%lu\\n", (unsigned long){what});'


@pytest.fixture(scope="module")
def built_in() -> Flight:
    return fly(load_scenario("nominal", POWERED))


def farthest_deg(flight: Flight, other: Flight) -> float:
    return max(float(np.abs(flight[c] - other[c]).max()) for c in COMMANDS)


@needs_compiler
@pytest.mark.parametrize("guard", ["true", "false"])
def test_the_law_by_hand_in_c_flies_as_the_built_in(tmp_path: Path, built_in: Flight, guard: str) -> None:
    library = compiled(tmp_path, EXAMPLES / "pd_law.c", "pd_law")
    flight = fly(load_scenario("nominal", [*POWERED, *flies(library=library, guard=guard)]))
    assert flight.outcome == "duration"
    assert farthest_deg(flight, built_in) <= 1.001 * DAC_STEP_DEG


@needs_compiler
def test_a_sign_error_shows(tmp_path: Path, built_in: Flight) -> None:
    text = (EXAMPLES / "pd.h").read_text().replace("- k_d_s * in->rate", "+ k_d_s * in->rate")
    (tmp_path / "pd.h").write_text(text)
    (tmp_path / "pd_law.c").write_text((EXAMPLES / "pd_law.c").read_text())
    wrong = fly(
        load_scenario("nominal", [*POWERED, *flies(library=compiled(tmp_path, tmp_path / "pd_law.c", "wrong"))])
    )
    n = len(wrong[COMMANDS[0]])
    assert max(float(np.abs(wrong[c] - built_in[c][:n]).max()) for c in COMMANDS) > 1.0


def test_the_law_by_hand_in_python_flies_as_the_built_in(built_in: Flight) -> None:
    flight = fly(load_scenario("nominal", [*POWERED, *flies(python=f"{EXAMPLES}/pd_law.py:Autopilot")]))
    assert flight.outcome == "duration"
    assert farthest_deg(flight, built_in) <= 1.001 * DAC_STEP_DEG


@pytest.mark.slow
@needs_compiler
def test_an_observer_beside_the_law_sees_a_disturbance(tmp_path: Path, built_in: Flight) -> None:
    """A steady moment of known angular acceleration appears in the estimate, within the accuracy of its model."""
    library = compiled(tmp_path, EXAMPLES / "pd_observer.c", "pd_observer")
    flight = fly(load_scenario("nominal", [*POWERED, *flies(library=library)]))
    assert farthest_deg(flight, built_in) <= 1.001 * DAC_STEP_DEG
    pushed_Nm = 20_000.0
    push = f'injection=[{{at="body_torque",axis="y",kind="step",amplitude_Nm={pushed_Nm},start_s=5.0}}]'
    pushed = fly(load_scenario("nominal", ["run.duration_s=9", "requirement=", push, *flies(library=library)]))
    at = np.searchsorted(pushed.time_s("monitor_1"), 8.5)
    change = pushed["monitor_1"][at] - flight["monitor_1"][at]
    inertia = pushed["Iyy_kgm2"][np.searchsorted(pushed.time_s("Iyy_kgm2"), 8.5)]
    assert change == pytest.approx(pushed_Nm / inertia, rel=0.25)


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_a_computer_behind_a_socket_flies_as_the_built_in(tmp_path: Path, built_in: Flight, kind: str) -> None:
    """A separate process in lock-step, linked with the C law, flies as the built-in law, in two successive flights."""
    program = compiled(tmp_path, EXAMPLES / "computer.c", "computer", str(EXAMPLES / "pd_law.c"), program=True)
    with subprocess.Popen([program, kind, "0"], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            port = int(process.stdout.readline())
            address = flies(address=f"{kind}://127.0.0.1:{port}")
            if kind == "tcp":
                fly(load_scenario("nominal", ["run.duration_s=1", "requirement=", *address]))
            flight = fly(load_scenario("nominal", [*POWERED, *address]))
            assert flight.outcome == "duration"
            assert farthest_deg(flight, built_in) <= 1.001 * DAC_STEP_DEG
        finally:
            process.kill()


def test_a_computer_that_does_not_answer_ends_the_flight() -> None:
    """Silent, wrong and lost computers end the flight, over TCP and UDP."""
    loaded = {}
    for name, kind in (("silent", socket.SOCK_STREAM), ("garbled", socket.SOCK_STREAM), ("lost", socket.SOCK_DGRAM)):
        with socket.socket(socket.AF_INET, kind) as mute:
            mute.bind(("127.0.0.1", 0))
            port = mute.getsockname()[1]
            if kind == socket.SOCK_STREAM:
                mute.listen()
            thread = threading.Thread(target=_answers_three, args=(mute, name), daemon=True)
            thread.start()
            scheme = "udp" if kind == socket.SOCK_DGRAM else "tcp"
            more = flies(address=f"{scheme}://127.0.0.1:{port}", timeout_s=0.3)
            flight = fly(load_scenario("nominal", ["run.duration_s=1", "requirement=", *more]))
            _, named, said = flight.failures[0].partition(f"{scheme}://127.0.0.1:{port}: ")
            assert named
            loaded[name] = (flight.outcome, said, flight.end_s)
            thread.join(2.0)
    silence = "no answer within 0.3 s; its process may be stopped, or too slow"
    assert loaded["silent"] == ("flight_software", silence, 0.03)
    assert loaded["lost"] == ("flight_software", f"{silence}, or a datagram was lost", 0.03)
    assert loaded["garbled"][0] == "flight_software"
    assert loaded["garbled"][1] == "an answer that does not begin with MAXQ"


def _answers_three(where: socket.socket, name: str) -> None:
    """Answer the setup and two samples as a computer, then nothing or invalid data."""
    peer = where.accept()[0] if where.type == socket.SOCK_STREAM else where
    try:
        for number in range(4):
            got, sender = peer.recvfrom(4096) if peer is where else (peer.recv(4096), None)
            size = 0 if number == 0 else size_of(Outputs, 1)
            said = got[:16] + bytes(8 + size) if number < 3 else bytes(24 + size) if name == "garbled" else b""
            if said:
                peer.sendto(said, sender) if sender else peer.sendall(said)
        peer.recv(4096)
    except OSError:
        pass
