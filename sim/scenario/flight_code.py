"""Flight code that a vehicle file names: a shared library, a Python class, or a computer behind a socket.

Reading a scenario runs none of it: a file is only found and hashed. What was flown is in the log with its SHA-256, and
other content under the same name is refused when the log is flown again (sim/run/flight_software.py).
"""

from __future__ import annotations

import hashlib
import ipaddress
import re
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, ValidationInfo, WithJsonSchema, model_validator

from maxq.sim.input.documents import Text
from maxq.sim.input.errors import refuse
from maxq.sim.input.files import TABLE_VARIANTS, Reading, find, not_found, shown
from maxq.sim.input.values import Section, optional

SETTINGS_BYTES = 255
_ADDRESS = re.compile(r"(tcp|udp)://(\[[0-9a-f:]+\]|[0-9a-z.]+):([0-9]{1,5})")


def flight_code_key(name: str) -> str:
    """The key of [computer] for what a person means by `name`; empty where that is no flight code."""
    if ".py:" in name:
        return "python"
    if name.startswith(("tcp://", "udp://")):
        return "address"
    return "library" if name.endswith((".so", ".dylib", ".dll")) else ""


class CodeFile(Section):
    """A file of flight code; in a vehicle file only its name, for Python followed by `:Class`."""

    file: str = Field(description="absolute path")
    sha256: str = Field(description="SHA-256 of its content")
    member: str = optional("class in a Python file", "")

    @model_validator(mode="before")
    @classmethod
    def _found(cls, value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            return value
        if not isinstance(value, Text) or not isinstance(info.context, Reading):
            raise refuse("a file is named where none can be read", "a table with file and sha256")
        is_python = ".py" in value
        name, _, member = value.rpartition(":") if is_python else (str(value), "", "")
        if is_python and not (name.endswith(".py") and member.isidentifier()):
            raise refuse("names no class", 'a file and a class in it, e.g. "my_fsw.py:Autopilot"')
        text = value.like(name)
        path = find(text)
        if path is None:
            raise refuse(*not_found(text, "a Python file" if is_python else "a shared library", TABLE_VARIANTS))
        content = info.context.content(path.resolve(), shown(path))
        return {"file": str(path.resolve()), "sha256": hashlib.sha256(content).hexdigest(), "member": member}

    @property
    def title(self) -> str:
        """For people."""
        return shown(Path(self.file)) + (f":{self.member}" if self.member else "")


def _loopback(text: str) -> str:
    found = _ADDRESS.fullmatch(text)
    allowed = "tcp://127.0.0.1:PORT or udp://127.0.0.1:PORT, of this machine"
    if not found or not 0 < int(found[3]) < 65536:
        raise refuse("is no address", allowed)
    host = found[2].strip("[]")
    try:
        local = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = False
    if not local:
        raise refuse("is not on this machine", allowed)
    return text


def _fits(text: str) -> str:
    if len(text.encode()) > SETTINGS_BYTES or "\0" in text:
        raise refuse("is too long", f"at most {SETTINGS_BYTES} bytes of text")
    return text


def _file_schema(what: str) -> WithJsonSchema:
    given = {"file": {"type": "string"}, "sha256": {"type": "string"}, "member": {"type": "string"}}
    table = {"type": "object", "properties": given, "required": ["file", "sha256"], "additionalProperties": False}
    return WithJsonSchema({"anyOf": [{"type": "string", "description": what}, table]})


LibraryFile = Annotated[CodeFile, _file_schema("name of a shared library")]
PythonClass = Annotated[CodeFile, _file_schema("name of a Python file and a class in it, with a colon between")]
Address = Annotated[str, AfterValidator(_loopback)]
Settings = Annotated[str, AfterValidator(_fits)]
