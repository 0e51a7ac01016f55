"""Flight computers behind a socket: their messages, and faults of the network and of the peer.

Each fault ends the flight in one line that names the peer, or changes nothing.
"""

from __future__ import annotations

import csv
import ctypes
import io
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from flight_code import EXAMPLES, compiled, flies, needs_compiler

from maxq import Flight
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.fly import fly
from maxq.sim.run.instances import Inputs, Outputs, Setup, size_of
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simrun

Sends = Callable[[bytes], None]
SETUP, STEP, END = 1, 2, 3
V1, V2 = 104, 216  # bytes of the outputs
SILENCE = "no answer within 0.4 s; its process may be stopped, or too slow"


class Peer:
    """A flight computer whose commands are a constant pitch angle. `reply` decides what is sent for an answer."""

    def __init__(self, kind: str, reply: Callable[[int, bytes, Sends], Any] | None = None) -> None:
        self.kind, self.reply, self.seen = kind, reply or (lambda number, answer, send: send(answer)), list[int]()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.address = f"{kind}://127.0.0.1:{self._socket.getsockname()[1]}"
        if kind == "tcp":
            self._socket.listen()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        try:
            while True:
                if self.kind == "udp":
                    given, sender = self._socket.recvfrom(65536)
                    if not given:
                        return
                    self._answer(given, lambda data, to=sender: self._socket.sendto(data, to))  # type: ignore[misc]
                    continue
                connected = self._socket.accept()[0]
                with connected:
                    while given := connected.recv(65536):  # lock-step: one message at a time
                        self._answer(given, connected.sendall)
        except OSError:
            pass

    def _answer(self, given: bytes, send: Sends) -> None:
        kind, number = int.from_bytes(given[4:8], "little"), int.from_bytes(given[8:16], "little")
        self.seen.append(number)
        outputs = Outputs(size_of(Outputs, 1))
        outputs.gimbal_rad[0] = 0.01
        if kind != END:
            self.reply(number, given[:16] + bytes(8) + bytes(outputs)[: V1 if kind == STEP else 0], send)

    def close(self) -> None:
        """End the thread first: a call that waits on a closed socket may continue on another one with its number."""
        if self.kind == "tcp":
            self._socket.shutdown(socket.SHUT_RDWR)
        else:
            self._socket.sendto(b"", self._socket.getsockname())
        self._thread.join(10.0)
        assert not self._thread.is_alive()
        self._socket.close()


@contextmanager
def peer(kind: str, reply: Callable[[int, bytes, Sends], Any] | None = None) -> Iterator[Peer]:
    made = Peer(kind, reply)
    try:
        yield made
    finally:
        made.close()


def flown(there: Peer, *more: str, timeout_s: float = 30.0) -> Flight:
    code = flies(address=there.address, timeout_s=timeout_s)
    return fly(load_scenario("nominal", ["run.duration_s=0.08", "requirement=", *code, *more]), log=False)


def at(number: int, change: Callable[[bytes], bytes]) -> Callable[[int, bytes, Sends], Any]:
    """Return a reply that changes the answer to one message; empty: no answer."""

    def reply(this: int, answer: bytes, send: Sends) -> None:
        if changed := change(answer) if this == number else answer:
            send(changed)

    return reply


def twice(number: int, answer: bytes, send: Sends) -> None:
    send(answer)
    send(answer)


class Delayed:
    """A network that delivers an answer to an earlier message just before each answer."""

    def __init__(self) -> None:
        self.before = b""

    def __call__(self, number: int, answer: bytes, send: Sends) -> None:
        if self.before:
            send(self.before)
        send(answer)
        self.before = answer


def test_duplicated_and_reordered_answers_change_nothing() -> None:
    hashes = set()
    for reply in (None, twice, Delayed()):
        with peer("udp", reply) as there:
            flight = flown(there)
            assert flight.outcome == "duration"
            assert flight.final["gimbal_pitch_command_deg"] == pytest.approx(0.573)
            hashes.add(flight.state_hash)
    assert len(hashes) == 1


def late(number: int, answer: bytes, send: Sends) -> None:
    if number == 4:
        time.sleep(0.6)
    send(answer)


FAULTS: dict[str, tuple[Callable[[int, bytes, Sends], Any], str]] = {
    "lost": (at(4, lambda answer: b""), f"{SILENCE}, or a datagram was lost"),
    "late": (late, f"{SILENCE}, or a datagram was lost"),
    "repeats an earlier one": (
        at(4, lambda answer: answer[:8] + bytes([3]) + answer[9:]),
        "no answer within 0.4 s (ignored answers to earlier messages: 1); its process may be stopped, or too slow, "
        "or a datagram was lost",
    ),
    "of a later message": (
        at(4, lambda answer: answer[:8] + bytes([9]) + answer[9:]),
        "an answer to message 9, of kind 2; expected is that to message 4, of kind 2",
    ),
    "of another kind": (
        at(4, lambda answer: answer[:4] + bytes([1]) + answer[5:]),
        "an answer to message 4, of kind 1; expected is that to message 4, of kind 2",
    ),
    "without magic": (at(4, lambda answer: b"maxq" + answer[4:]), "an answer that does not begin with MAXQ"),
    "cut": (at(4, lambda answer: answer[:20]), "an answer of 20 bytes, without a header and code of 24 bytes"),
    "short": (
        at(4, lambda answer: answer[:-8]),
        "an answer with 96 bytes of outputs; expected are 104, of version 1 (key interface)",
    ),
    "long": (
        at(4, lambda answer: answer + bytes(8)),
        "an answer with 112 bytes of outputs; expected are 104, of version 1 (key interface)",
    ),
    "of another version": (
        at(4, lambda answer: answer + bytes(V2 - V1)),
        "an answer with 216 bytes of outputs, of version 2; expected are 104, of version 1 (key interface)",
    ),
    "with a wrong size field": (
        at(4, lambda answer: answer[:24] + bytes([V2]) + answer[25:]),
        "an answer with 216 bytes of outputs, of version 2; expected are 104, of version 1 (key interface)",
    ),
    "of an error": (at(4, lambda answer: answer[:16] + bytes([7]) + answer[17:]), "its step returned 7"),
}
"""The faults of an answer over UDP, and the message of the flight. Message 4 is that of the third sample."""


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_datagram_ends_the_flight_in_a_line_that_names_the_peer(fault: str) -> None:
    """A flight with the same peer follows a late answer, which does not disturb it."""
    reply, said = FAULTS[fault]
    with peer("udp", reply) as there:
        flight = flown(there, timeout_s=0.4 if "no answer" in said else 30.0)
        assert (flight.outcome, flight.end_s) == ("flight_software", 0.03)
        assert flight.failures == (f"flight software at 0.030 s: {there.address}: {said}",)
        if fault == "late":
            there.reply = lambda number, answer, send: send(answer)
            time.sleep(0.3)
            assert flown(there).outcome == "duration"


@pytest.mark.parametrize("fault", ["of a later message", "without magic", "of another kind"])
def test_a_faulty_answer_of_a_stream_ends_the_flight(fault: str) -> None:
    reply, said = FAULTS[fault]
    with peer("tcp", reply) as there:
        assert flown(there).failures == (f"flight software at 0.030 s: {there.address}: {said}",)


@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_a_peer_of_another_version_is_named_with_both_versions(kind: str) -> None:
    with peer(kind) as there:
        flight = flown(there, "vehicle.computer.interface=2")
        said = "an answer with 104 bytes of outputs, of version 1; expected are 216, of version 2 (key interface)"
        assert flight.failures == (f"flight software at 0.010 s: {there.address}: {said}",)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda answer: answer[:16] + bytes([9]) + answer[17:], "answered its setup with code 9"),
        (lambda answer: answer + bytes(V1), "an answer with 104 bytes of outputs, of version 1; expected are none"),
        (lambda answer: b"", f"{SILENCE}, or a datagram was lost"),
    ],
)
def test_a_refused_setup_is_bad_input(change: Callable[[bytes], bytes], said: str) -> None:
    with peer("udp", at(1, change)) as there, pytest.raises(ScenarioError) as error:
        flown(there, timeout_s=0.4 if "no answer" in said else 30.0)
    assert said in str(error.value)
    assert there.address in str(error.value)


def test_a_port_without_a_peer_is_bad_input() -> None:
    for kind in ("udp", "tcp"):
        with peer(kind) as there:
            pass
        with pytest.raises(ScenarioError, match="connection refused") as error:
            flown(there)
        assert there.address in str(error.value)


# --- the messages, and the examples in C


def test_the_list_of_messages_has_the_places_of_the_structs(capsys: pytest.CaptureFixture[str]) -> None:
    """Compare with ctypes, which test_oracle_flight_software compares with a C compiler."""
    assert simrun.main(["schema", "messages"]) == 0
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    for message, struct, first in (("setup", Setup, 16), ("step", Inputs, 16), ("answer to step", Outputs, 24)):
        listed = {r["name"]: (int(r["offset"]), int(r["bytes"])) for r in rows if r["message"] == message}
        head = ["magic", "kind", "number", *(["code"] if first == 24 else [])]
        assert list(listed) == [*head, *(name for name, _ in struct._fields_)]
        for name, kind in struct._fields_:
            assert listed[name] == (first + getattr(struct, name).offset, ctypes.sizeof(kind)), name
        of_1 = [r for r in rows if r["message"] == message and r["version"] == "1"]
        assert int(of_1[-1]["offset"]) + int(of_1[-1]["bytes"]) == first + size_of(struct, 1)
    assert [r["offset"] for r in rows if r["message"] == "end"] == ["0", "4", "8"]


@contextmanager
def process(program: Path, kind: str) -> Iterator[str]:
    """Start an example on a free port, and yield its address."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM if kind == "tcp" else socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with subprocess.Popen([program, kind, str(port)], stdout=subprocess.PIPE, text=True) as started:
        try:
            assert started.stdout is not None
            assert str(port) in started.stdout.readline()
            yield f"{kind}://127.0.0.1:{port}"
        finally:
            started.kill()


@needs_compiler
def test_the_application_for_cfs_flies_as_the_library(tmp_path: Path) -> None:
    """Fly two flights over TCP and UDP with the functions of cFE and OSAL on POSIX, and compare the bits.

    A duplicate of a sample, which a network may produce, has no answer and does not reach the flight code.
    """
    law, app = EXAMPLES / "pd_law.c", EXAMPLES / "cfs"
    given = ["run.duration_s=3", "requirement="]
    in_process = fly(load_scenario("nominal", [*given, *flies(library=compiled(tmp_path, law, "pd_law"))]))
    sources = [str(law), str(app / "posix/cfe.c"), *(f"-I{place}" for place in (EXAMPLES, app, app / "posix"))]
    program = compiled(tmp_path, app / "maxq_app.c", "maxq_app", *sources, program=True)
    for kind in ("tcp", "udp"):
        with process(program, kind) as address:
            for version in (1, 2):
                flight = fly(load_scenario("nominal", [*given, *flies(address=address, interface=version)]))
                assert flight.outcome == "duration"
                assert flight.state_hash == in_process.state_hash
            if kind == "udp":
                _duplicates_have_no_answer(int(address.rsplit(":", 1)[1]))


def _duplicates_have_no_answer(port: int) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as simulator:
        simulator.connect(("127.0.0.1", port))
        simulator.settimeout(5.0)
        setup = Setup(bytes=ctypes.sizeof(Setup), abi=2, sample_ns=10_000_000)
        inputs = Inputs(bytes=ctypes.sizeof(Inputs))
        for number, kind, struct in ((1, SETUP, setup), (2, STEP, inputs), (2, STEP, inputs), (3, STEP, inputs)):
            head = b"MAXQ" + kind.to_bytes(4, "little") + number.to_bytes(8, "little")
            simulator.send(head + bytes(struct))
        assert [simulator.recv(4096)[8] for _ in range(3)] == [1, 2, 3]
