"""A flight in lock-step with the master of an FMU. The FMU contains this file, which needs the standard library only.

The flight is that of `simrun` in a process of its own, with its computer behind a socket (docs/flight-software.md,
Over a socket). The FMU is the server of this socket: it passes the inputs of the flight computer to the master, and the
master's commands to the flight.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
import struct
import subprocess
import tempfile
import time
from pathlib import Path

HEAD = struct.Struct("=4sIq")
STEP, END = 2, 3  # kinds of messages
_START_S, _END_S = 600.0, 20.0  # a first start compiles
_SIMRUN = "from maxq.tools.simrun import command; command()"
Number = int | float


class Lockstep:
    """A flight that waits at each sample for the master.

    `resources` is the folder of the FMU's resources. `inputs` are the values that the flight computer has received at
    the last sample, and `commands` its next outputs; the names are those of maxq_fsw.h. `finished` is True after the
    end of the flight.
    """

    def __init__(self, resources: str) -> None:
        self._resources = Path(resources)
        self.interface = json.loads((self._resources / "interface.json").read_text(encoding="utf-8"))
        kinds = {side: [kind for _, kind, _, _ in self.interface[side]] for side in ("inputs", "outputs")}
        self._given, self._taken = (struct.Struct("=q" + "".join(kinds[side])) for side in ("inputs", "outputs"))
        self.inputs: dict[str, Number] = {name: 0 for name, *_ in self.interface["inputs"]}
        self.commands: dict[str, Number] = {name: 0 for name, *_ in self.interface["outputs"]}
        self.log_folder = ""
        self.finished = False
        self._kinds = kinds["outputs"]
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: socket.socket | None = None
        self._asked: bytes | None = None  # the header of a sample that waits for its commands

    def start(self) -> None:
        """Start the flight, up to its first sample. Raises RuntimeError with the message of simrun."""
        scratch = tempfile.mkdtemp(prefix="maxq-fmu-")
        self._scratch, self._errors = scratch, Path(scratch, "stderr.txt")
        with socket.create_server(("127.0.0.1", 0)) as server, self._errors.open("wb") as errors:
            server.settimeout(0.1)
            here = f"tcp://127.0.0.1:{server.getsockname()[1]}"
            words = [*self._simrun(), str((self._resources / "scenario.toml").resolve())]
            words += ["--out", self.log_folder or scratch, *([] if self.log_folder else ["--no-log"])]
            words += ["--set", f"vehicle.computer.address={here}"]
            self._process = subprocess.Popen(words, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=errors)
            until = time.monotonic() + _START_S
            while self._socket is None:
                try:
                    self._socket = server.accept()[0]
                except TimeoutError:
                    if self._process.poll() is not None or time.monotonic() > until:
                        raise RuntimeError(self._last_words()) from None
        self._socket.settimeout(None)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._receive()
        self._send(b"")

    def _simrun(self) -> list[str]:
        """Return the words of the command simrun: of MAXQ_SIMRUN, the search path, or the Python of the export."""
        found = os.environ.get("MAXQ_SIMRUN") or shutil.which("simrun")
        return [found] if found else [self.interface["python"], "-c", _SIMRUN]

    def _last_words(self) -> str:
        lines = self._errors.read_text(encoding="utf-8", errors="replace").split("\n")
        return next((line for line in reversed(lines) if line), "simrun did not connect to the FMU")

    def advance(self, until_s: float) -> None:
        """Fly until the last sample at or before `until_s`, with constant commands, or the end of the flight."""
        while not self.finished and self.inputs["time_s"] + self.interface["sample_s"] < until_s + 1e-6:
            if self._asked is not None:
                self._answer()
            self._receive()

    def _answer(self) -> None:
        casts = {"q": int, "d": float}
        values = [casts[kind](value) for kind, value in zip(self._kinds, self.commands.values(), strict=True)]
        self._send(self._taken.pack(self._taken.size, *values))

    def _send(self, content: bytes) -> None:
        assert self._socket is not None
        assert self._asked is not None
        self._socket.sendall(self._asked + bytes(8) + content)
        self._asked = None

    def _receive(self) -> None:
        head = self._read(HEAD.size)
        if not head:
            raise RuntimeError(self._last_words())
        kind = HEAD.unpack(head)[1]
        self.finished = kind == END
        if self.finished:
            return
        self._asked = head
        size = self._read(8)
        content = size + self._read(struct.unpack("=q", size)[0] - 8)
        if kind == STEP:
            self.inputs.update(zip(self.inputs, self._given.unpack(content[: self._given.size])[1:], strict=True))

    def _read(self, size: int) -> bytes:
        assert self._socket is not None
        out = b""
        while len(out) < size:
            part = self._socket.recv(size - len(out))
            if not part:
                return b""
            out += part
        return out

    def stop(self) -> None:
        """End the flight. A flight whose last sample has been reached writes its log and summary."""
        if self._socket is not None:
            if self._asked is not None:
                self._answer()
                self._receive()
            self._socket.close()
            self._socket = None
        if self._process is not None:
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()
            self._process = None
            shutil.rmtree(self._scratch, ignore_errors=True)
