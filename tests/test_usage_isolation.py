"""Attacks of flight code on the simulator: on its memory, arithmetic, processes and terminal."""

from __future__ import annotations

import contextlib
import platform
import socket
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from flight_code import compiled, flies, needs_compiler

from maxq import Flight
from maxq.control.kernel.records import dtype_of
from maxq.sim.flight.parameters import Memory
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.fly import fly
from maxq.sim.run.instances import HEADER
from maxq.sim.run.sandbox import sandbox_problem
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simrun

Printed = pytest.CaptureFixture[str]
needs_linux = pytest.mark.skipif(sys.platform != "linux", reason="reads /proc, and relies on F_SETSIG of Linux")

CODE = """
#define _GNU_SOURCE
#include "maxq_fsw.h"
#include <fcntl.h>
#include <fenv.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <unistd.h>

static void scale(double *first, int count) { for (int i = 0; i < count; i++) first[i] *= 1.01; }
static void scale_shared(void)
{
    char line[256];
    FILE *maps = fopen("/proc/self/maps", "r");
    unsigned long from, to;
    while (fgets(line, sizeof line, maps))
        if (strstr(line, "rw-s") && sscanf(line, "%lx-%lx", &from, &to) == 2)
            scale((double *)from, (int)((to - from) / 8));
    fclose(maps);
}
static long offset;
static void poke(void)
{
    char line[256];
    FILE *maps = fopen("/proc/self/maps", "r");
    unsigned long from, to;
    while (fgets(line, sizeof line, maps))
        if (strstr(line, "rw-s") && sscanf(line, "%lx-%lx", &from, &to) == 2)
            ((unsigned char *)from)[offset] ^= 1;
    fclose(maps);
}
static int tried(void)
{
    int fd = open("written", O_WRONLY | O_CREAT, 0600), memory = open("/proc/self/mem", O_RDWR);
    int made = fd >= 0, child = fork();
    if (child == 0) _exit(0);
    made |= (memory >= 0) << 1 | (child > 0) << 2 | (socket(AF_INET, SOCK_STREAM, 0) >= 0) << 3;
    made |= (kill(getppid(), 0) == 0) << 4 | (mkdir("made", 0700) == 0) << 5 | (setsid() >= 0) << 6;
    return made | (open("/etc/passwd", O_RDONLY) >= 0) << 7;
}
static void forked(void)
{
    pid_t child = fork();
    if (child == 0) for (;;) pause();
    FILE *file = fopen("children", "a");
    fprintf(file, "%d %d\\n", (int)getpid(), (int)child);
    fclose(file);
}

int32_t maxq_fsw_abi(void) { return MAXQ_FSW_ABI; }
int64_t maxq_fsw_bytes(void) { return 200; }
int32_t maxq_fsw_init(void *self, const maxq_fsw_setup *setup)
{
    (void)self, (void)forked, (void)scale_shared, (void)tried, (void)poke;
    offset = atol(setup->settings);
    INIT;
    return 0;
}
int32_t maxq_fsw_step(void *self, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    (void)self;
    out->monitor[0] = fegetround();
    out->gimbal_rad[0] = -1.1 * in->attitude_error_rad[1] - 0.4 * in->rate_radps[1];
    if (in->tick == 50) { STEP; }
    return 0;
}
void maxq_fsw_close(void *self) { (void)self; CLOSE; }
"""
AFTER, BEFORE = "scale((double *)(out + 1), 8192)", "scale((double *)in - 8192, 8192)"


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def attacking(**macros: str) -> list[str]:
    """Return the overrides that fly the C code with these statements in its functions.

    Only code that does not return has a short time limit, because every other step may wait on a loaded machine.
    """
    Path("attack.c").write_text(CODE)
    name = f"attack{zlib.crc32(repr(macros).encode())}"  # warnings are shown once for each name
    flags = [f"-D{place}={macros.get(place, '(void)0')}" for place in ("INIT", "STEP", "CLOSE")]
    library = compiled(Path(), Path("attack.c"), name, *flags, "-Wno-array-bounds", "-Wno-stringop-overflow")
    waits = any("for (;;)" in code or "SIGSTOP" in code for code in macros.values())
    return flies(library=library.resolve(), timeout_s=1.0 if waits else 60.0)


def flown(*computer: str) -> Flight:
    return fly(load_scenario("nominal", ["design=", "run.duration_s=2", "requirement=", *computer]))


def run(*computer: str) -> int:
    given = ["run.duration_s=2", "requirement=", *computer]
    return simrun.main(["nominal", "--out", "out", *(word for change in given for word in ("--set", change))])


@needs_compiler
@pytest.mark.parametrize(
    "attack",
    [
        {"STEP": AFTER},
        {"STEP": BEFORE},
        {"STEP": "memset(out + 1, 255, 65536)"},
        {"STEP": "memset((char *)out - 65536, 255, 65536)"},
        {"STEP": "scale((double *)(in + 1), 1)"},
        {"STEP": "scale((double *)(out + 1), 1)"},
        {"STEP": "memset((char *)self + 256, 1, 1)"},
        {"INIT": "memset((char *)setup + setup->bytes, 1, 1)"},
    ],
)
@pytest.mark.parametrize("version", [1, 2])
def test_writing_beyond_the_own_structs_is_a_crash_of_the_code(
    attack: dict[str, str], version: int, capsys: Printed
) -> None:
    """Also of version 1, whose structs are shorter."""
    if version == 1:
        Path("maxq_fsw.h").write_text((Path(__file__).parent / "data" / "maxq_fsw_version_1.h").read_text())
    starting = "INIT" in attack
    assert run(*attacking(**attack)) == (2 if starting else 1)
    printed = capsys.readouterr()
    last = (printed.err if starting else printed.out).splitlines()[-1]
    assert f"crashed {'at its start' if starting else 'in its step'}: SIGSEGV, access to memory that is not its" in last
    if not starting:
        assert "FAILED: flight software at 0.510 s" in last


@needs_compiler
def test_writing_shortly_before_the_own_structs_changes_nothing() -> None:
    """The bytes before the outputs and the inputs, in the same page, are not used by the simulator."""
    step = "memset((char *)out - 256, 255, 256); memset((char *)in - 256, 255, 256)"
    assert flown(*attacking(STEP=step)).state_hash == flown(*attacking()).state_hash


@needs_compiler
@needs_linux
def test_a_stray_pointer_into_the_flight_is_detected() -> None:
    """The code multiplies all memory that is shared with the simulator by 1.01, wherever it is."""
    flight = flown(*attacking(STEP="scale_shared()"))
    assert flight.outcome == "flight_software"
    assert flight.failures == ("flight software at 0.510 s: overwrote memory of the simulator in its step",)
    assert flight.state_hash == flown(*attacking(STEP="return 7")).state_hash


def places(*paths: str) -> dict[str, int]:
    """Return the offset of the last byte of each part of Memory, which is the first record in shared memory."""
    out = {}
    for path in paths:
        layout, at = dtype_of(Memory), 0
        for name in path.split("."):
            layout, begins, *_ = dict(layout.fields or {})[name]
            at += begins
        out[path] = at + layout.itemsize - 1
    return out


USED = (
    *("clock", "held.faults", "computer.law", "computer.external.call", "computer.loops.fading", "faults.next_ns"),
    *("extremes", "waves", "errors", "gimbal_replaces"),
)
SENSORS = ["vehicle.stage.0.accelerometer={station_m=4.0, omega_hz=80, zeta=0.7}"]
NOT_USED = ("computer.sensors", "computer.loops", "faults", "history")


@needs_compiler
@needs_linux
def test_each_part_of_the_flight_that_is_used_is_compared() -> None:
    """The code changes a bit of one byte, also in the last part of the memory, and where this flight reads nothing."""
    code, plain = attacking(STEP="poke()"), flown(*attacking())
    ended, hashes = {}, set()
    for path, place in places(*USED, *NOT_USED).items():
        flight = flown(*code, f"vehicle.computer.settings='{place}'")
        ended[path] = flight.outcome
        if path in NOT_USED:
            hashes.add((flight.state_hash, tuple(flight.metrics.values()) == tuple(plain.metrics.values())))
    assert ended == {**dict.fromkeys(USED, "flight_software"), **dict.fromkeys(NOT_USED, "duration")}
    assert hashes == {(plain.state_hash, True)}
    using = [*SENSORS, "fault=[{kind='gyro-bias',at_s=1.9,bias_degps=1.0}]"]
    for path, place in places("computer.sensors", "faults").items():
        assert flown(*code, *using, f"vehicle.computer.settings='{place}'").outcome == "flight_software", path


def test_python_code_cannot_change_the_flight_through_ctypes() -> None:
    Path("own.py").write_text(
        "import ctypes\n"
        "class Autopilot:\n"
        "    def __init__(self, setup): pass\n"
        "    def step(self, inputs):\n"
        "        for line in open('/proc/self/maps') if inputs.tick == 50 else ():\n"
        "            if 'rw-s' in line:\n"
        "                first, last = (int(part, 16) for part in line.split()[0].split('-'))\n"
        "                ctypes.memset(first, 0, last - first)\n"
        "        return {}\n"
    )
    flight = flown(*flies(python="own.py:Autopilot"))
    assert flight.failures[0].endswith("overwrote memory of the simulator in its step")


@needs_compiler
@pytest.mark.parametrize("guard", ["true", "false"])
def test_the_rounding_of_the_code_is_its_own(guard: str) -> None:
    """Flights of code that rounds up or down from its start or from a sample on equal the flight of code that does not.

    The code retains its mode from call to call.
    """
    plain = flown(*attacking(), f"vehicle.computer.guard={guard}")
    rounded = {}
    for place in ("INIT", "STEP"):
        for mode in ("FE_UPWARD", "FE_DOWNWARD"):
            change = {place: f"fesetround({mode})", "CLOSE": "fesetround(FE_TOWARDZERO)"}
            rounded[place, mode] = flown(*attacking(**change), f"vehicle.computer.guard={guard}")
    assert {f.outcome for f in rounded.values()} == {"duration"}
    assert plain.final["monitor_1"] == 0.0
    assert len({f.final["monitor_1"] for f in rounded.values()}) == 2
    # The commands differ by a rounding at most, which the output converter removes: a leak would change the states
    assert {f.state_hash for f in rounded.values()} == {plain.state_hash}
    assert 1.0 + 2.0**-53 == 1.0  # rounds to nearest in this process


@needs_compiler
@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="sets the register MXCSR of x86-64")
@pytest.mark.parametrize("place", ["INIT", "STEP"])
def test_the_flush_to_zero_of_the_code_is_its_own(place: str) -> None:
    """Code without a guard, as if linked with -ffast-math, does not change denormal numbers in this process."""
    least, half = np.float64(2.0**-1073), np.float64(0.5)
    assert flown(*attacking(**{place: "__builtin_ia32_ldmxcsr(0x9fc0)"}), "vehicle.computer.guard=false").failures == ()
    assert least * half == 2.0**-1074


@needs_compiler
@needs_linux
def test_a_floating_point_trap_of_the_code_is_in_its_step() -> None:
    """The simulator's arithmetic between two samples is inexact too, but has no trap."""
    flight = flown(*attacking(STEP="feclearexcept(FE_ALL_EXCEPT); feenableexcept(FE_INEXACT)"))
    assert flight.failures == ("flight software at 0.520 s: crashed in its step: SIGFPE",)


def test_python_code_does_not_change_the_rounding_of_the_simulator() -> None:
    text = (
        "import ctypes\n"
        "class Autopilot:\n"
        "    def __init__(self, setup): self.mode = int(setup.settings)\n"
        "    def step(self, inputs):\n"
        "        ctypes.CDLL(None).fesetround(self.mode)\n"
        "        return {}\n"
    )
    Path("own.py").write_text(text)
    hashes = {
        flown(*flies(python="own.py:Autopilot", settings=f'"{mode}"')).state_hash for mode in (0, 0x400, 0x800, 0xC00)
    }
    assert len(hashes) == 1


def alive(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    return False


def wait_until_ended(pids: list[int], limit_s: float = 30.0) -> None:
    until = time.monotonic() + limit_s
    while any(map(alive, pids)):
        assert time.monotonic() < until, f"{pids} have not ended"
        time.sleep(0.02)


def children() -> list[int]:
    with contextlib.suppress(OSError):
        return [int(word) for word in Path("children").read_text().split()]
    return []


@needs_compiler
@needs_linux
@pytest.mark.parametrize("attack", [{}, {"STEP": "raise(SIGSEGV)"}, {"STEP": "for (;;) {}"}, {"CLOSE": "for (;;) {}"}])
def test_processes_that_code_has_started_end_with_its_flight(attack: dict[str, str]) -> None:
    flight = flown(*attacking(INIT="forked()", **attack))
    assert flight.outcome == ("flight_software" if "STEP" in attack else "duration")
    assert len(children()) == 2
    wait_until_ended(children())


@needs_compiler
@needs_linux
def test_code_that_does_not_return_ends_with_a_killed_simulator() -> None:
    """The command is killed by SIGKILL while its code and a process of its code run."""
    computer = attacking(INIT="forked()", STEP='fclose(fopen("inside", "w")); for (;;) {}')
    words = [str(Path(sys.executable).with_name("simrun")), "nominal", "--out", "out"]
    given = [*computer, "vehicle.computer.timeout_s=3600"]
    command = subprocess.Popen([*words, *(word for change in given for word in ("--set", change))], stderr=-1)
    try:
        until = time.monotonic() + 300.0
        while not Path("inside").exists():
            assert command.poll() is None, command.communicate()[1]
            assert time.monotonic() < until
            time.sleep(0.05)
        assert len(children()) == 2
        assert all(map(alive, children()))
    finally:
        command.kill()
        command.wait()
    wait_until_ended(children())


@needs_compiler
@pytest.mark.parametrize(
    ("close", "said"),
    [
        ("raise(SIGSEGV)", "crashed at its end: SIGSEGV"),
        ("exit(9)", "crashed at its end: its process ended with exit code 9"),
        ("for (;;) {}", "did not return within 1 s at its end"),
    ],
)
def test_an_error_at_the_end_of_c_code_is_reported(
    close: str, said: str, capsys: Printed, caplog: pytest.LogCaptureFixture
) -> None:
    assert run(*attacking(CLOSE=close)) == 0
    assert said in caplog.messages[-1]
    assert "flight code libattack" in caplog.messages[-1]


@pytest.mark.parametrize("guard", ["true", "false"])
def test_an_error_at_the_end_of_python_code_is_reported(caplog: pytest.LogCaptureFixture, guard: str) -> None:
    Path("own.py").write_text(
        "class Autopilot:\n"
        "    def __init__(self, setup): pass\n"
        "    def step(self, inputs): return {}\n"
        f"    def close(self): raise OSError('disk full, guard {guard}')\n"
    )
    assert flown(*flies(python="own.py:Autopilot", guard=guard)).outcome == "duration"
    assert caplog.messages[-1].endswith(f"after the flight: OSError: disk full, guard {guard} (own.py, line 4)")


def test_python_code_that_does_not_return_from_close_is_ended(caplog: pytest.LogCaptureFixture) -> None:
    Path("own.py").write_text(
        "import time\n"
        "class Waits:\n"
        "    def __init__(self, setup): pass\n"
        "    def step(self, inputs): return {}\n"
        "    def close(self): time.sleep(3600)\n"
    )
    assert flown(*flies(python="own.py:Waits", timeout_s=1)).outcome == "duration"
    assert (
        "own.py:Waits failed at its end, after the flight: did not return within 1 s at its end" in caplog.messages[-1]
    )


@pytest.mark.parametrize(
    ("output", "said"),
    [
        ("'roll_thruster': 10**30", "ValueError: roll_thruster is an integer beyond 64 bits"),
        ("'roll_thruster': 2**64 + 1", "ValueError: roll_thruster is an integer beyond 64 bits"),
        ("'abort': -2**63 - 1", "ValueError: abort is an integer beyond 64 bits"),
        ("'turn_thruster': (0, 2**64 - 1)", "ValueError: turn_thruster is an integer beyond 64 bits"),
        ("'ignition': 1.5", "TypeError: ignition is 1.5: allowed is an integer"),
        ("'turn_thruster': (0, -2)", "gave turn_thruster = -2: allowed is -1, 0 or 1"),
    ],
)
def test_integers_of_python_code_are_checked(output: str, said: str) -> None:
    Path("own.py").write_text(
        "class Autopilot:\n"
        "    interface = 2\n"
        "    def __init__(self, setup): pass\n"
        f"    def step(self, inputs): return {{{output}}}\n"
    )
    flight = flown(*flies(python="own.py:Autopilot"))
    assert flight.failures[0].endswith(said)


def test_texts_of_the_code_contain_no_control_characters(capsys: Printed) -> None:
    Path("own.py").write_text(
        "class Autopilot:\n"
        "    def __init__(self, setup): pass\n"
        "    def step(self, inputs): raise ValueError('\\x1b[31m\\x1b]0;title\\x07' + 100000 * 'x')\n"
    )
    assert run(*flies(python="own.py:Autopilot")) == 1
    assert simrun.main(["--from", "out/flight.mcap", "--out", "again"]) == 1
    for text in (*capsys.readouterr(), Path("out/summary.json").read_text()):
        assert not {"\x1b", "\x07", "\\u001b"} & set(text)
        assert "\\u001b" not in text
        assert 5000 * "x" not in text
    assert flown(*flies(python="own.py:Autopilot")).failures[0].count("\\x1b[31m\\x1b]0;title\\x07") == 1


@needs_compiler
@needs_linux
@pytest.mark.parametrize(
    ("signal_name", "said"),
    [
        ("SIGSTOP", "its process is stopped; it did not return within 1 s in its step"),
        ("SIGKILL", "its process was killed in its step: SIGKILL"),
    ],
)
def test_a_stopped_and_a_killed_process_are_named(signal_name: str, said: str) -> None:
    assert flown(*attacking(STEP=f"raise({signal_name})")).failures == (f"flight software at 0.510 s: {said}",)


@contextlib.contextmanager
def peer(*answers: bytes) -> Iterator[str]:
    """Give the address of a computer that answers message after message with these bytes, then closes."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection = server.accept()[0]
            with connection:
                for answer in answers:
                    head = connection.recv(4096)[: HEADER.size]
                    connection.sendall(head + answer)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        thread.join(5.0)


def test_a_peer_is_named_and_its_codes_are_not_cut_to_32_bits() -> None:
    size = 8 * 13
    with peer(bytes(8), bytes(8 + size)) as address:
        closed = flown(*flies(address=address))
    assert f"{address}: the connection was closed; its process has ended" in closed.failures[0]
    with peer(bytes(8), (1 << 32).to_bytes(8, sys.byteorder) + bytes(size)) as address:
        coded = flown(*flies(address=address))
    assert coded.failures[0].endswith("its step returned 4294967296")
    with peer((1 << 32).to_bytes(8, sys.byteorder)) as address, pytest.raises(Exception, match="code 4294967296"):
        flown(*flies(address=address))


needs_sandbox = pytest.mark.skipif(bool(sandbox_problem()), reason=sandbox_problem() or "there is a sandbox")
SANDBOX = "vehicle.computer.sandbox=true"


@needs_compiler
@needs_sandbox
def test_code_in_a_sandbox_can_only_compute_and_read() -> None:
    """Bits of monitor_2: file, own memory, process, socket, signal, folder, new group, and reading of a file."""
    code = attacking(STEP="out->monitor[1] = tried(); out->gimbal_rad[0] += 1e-3")
    free, confined = flown(*code, "log.fast_hz=100"), flown(*code, "log.fast_hz=100", SANDBOX)
    assert (max(free["monitor_2"]), max(confined["monitor_2"])) == (191, 128)
    assert confined.outcome == "duration"
    assert confined.state_hash == free.state_hash
    assert confined.state_hash != flown(*attacking()).state_hash


@needs_compiler
@needs_sandbox
@pytest.mark.parametrize(
    ("attack", "said"),
    [
        ("*(volatile int *)0 = 1", "its process in the sandbox ended: SIGSEGV"),
        ("for (;;) {}", "did not return within 1 s in its step"),
        ("return 7", "its step returned 7"),
        ("scale_shared(); return 8", "its step returned 8"),
    ],
)
def test_code_that_fails_in_a_sandbox_ends_its_flight(attack: str, said: str) -> None:
    flight = flown(*attacking(STEP=attack), SANDBOX)
    assert flight.failures == (f"flight software at 0.510 s: {said}",)
    assert flight.state_hash == flown(*attacking(STEP="return 7")).state_hash


@needs_sandbox
def test_python_code_in_a_sandbox_writes_no_file() -> None:
    Path("own.py").write_text(
        "import math\n"
        "class Autopilot:\n"
        "    def __init__(self, setup): pass\n"
        "    def step(self, inputs): return {'monitor': [open('written', 'w').write('x')] * 8}\n"
    )
    flight = flown(*flies(python="own.py:Autopilot"), SANDBOX)
    assert "PermissionError: [Errno 1] Operation not permitted: 'written' (own.py, line 4)" in flight.failures[0]
    assert not Path("written").exists()


@pytest.mark.parametrize("other", ["guard=false", "address=tcp://127.0.0.1:1"])
def test_a_sandbox_without_a_guarded_process_is_rejected(other: str) -> None:
    Path("own.py").write_text("class Autopilot: ...\n")
    code = {} if "address" in other else {"python": "own.py:Autopilot"}
    with pytest.raises(ScenarioError, match="sandbox = true: is for a guarded library or Python class only"):
        flown(*flies(**code), f"vehicle.computer.{other}", SANDBOX)
