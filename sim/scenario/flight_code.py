"""The external flight code named in a vehicle file: a shared library, a Python class, or a computer behind a socket.

Reading a scenario finds and hashes the files of the code, but does not run it. The log contains the SHA-256 of the
code flown. When the log is flown again, different content under the same names is rejected
(sim/run/flight_software.py).

The hash covers every file of the code (`code_files`). For a Python file, these are all modules that it can import from
its folder, or all files of the folder if the folder is a package. For a library, it is the file itself. `sources` names
the library's sources, and `data` a file or folder that the code reads; each has a separate hash. Guarded Python code
cannot open other files for reading (sim/run/hashed_reads.py). The hashes do not cover libraries that a library loads,
modules installed in the environment, or files that a library or another process opens.
"""

from __future__ import annotations

import hashlib
import ipaddress
import logging
import os
import re
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, ValidationInfo, WithJsonSchema, model_validator

from maxq.sim.input.documents import Text
from maxq.sim.input.errors import refuse
from maxq.sim.input.files import TABLE_VARIANTS, Reading, find, not_found, shown
from maxq.sim.input.values import Section, optional

SETTINGS_BYTES = 255
MOST_FILES = 1000
_MODULES = frozenset({".py", ".pyc", ".so", ".pyd", ".dll", ".dylib"})
_ADDRESS = re.compile(r"(tcp|udp)://(\[[0-9a-f:]+\]|[0-9a-z.]+):([0-9]{1,5})")


def flight_code_key(name: str) -> str:
    """Return the key of [computer] that `name` denotes, or an empty string if it denotes no flight code."""
    if ".py:" in name:
        return "python"
    if name.startswith(("tcp://", "udp://")):
        return "address"
    return "library" if name.endswith((".so", ".dylib", ".dll")) else ""


def code_files(path: Path) -> list[Path]:
    """Return all files of the flight code at `path`.

    For a folder, these are all its files. For a Python file, they are the modules that it can import from its folder,
    or all files of the folder if the folder is a package. For any other file, the result is the file itself. Hidden
    files are omitted. Raises PydanticCustomError if there are more than `MOST_FILES`.
    """
    if path.suffix != ".py" and not path.is_dir():
        return [path]
    folder = path if path.is_dir() else path.parent
    whole = path.is_dir() or (folder / "__init__.py").is_file()
    found = []
    for place, below, names in os.walk(folder, followlinks=True):
        below[:] = sorted(name for name in below if name != "__pycache__" and not name.startswith("."))
        mine = (Path(place) / name for name in sorted(names) if not name.startswith("."))
        found += [file for file in mine if file.is_file() and (whole or file.suffix in _MODULES)]
        if len(found) > MOST_FILES:
            raise refuse(f"is in a folder with more than {MOST_FILES} files", "a folder of its own")
    return found


def code_hash(path: Path, read: Callable[[Path], bytes] = Path.read_bytes) -> tuple[str, tuple[str, ...]]:
    """Return the SHA-256 of flight code, and the names of its files if there are several.

    The hash of a single file is the hash of its content. The hash of several files covers the name and hash of each.
    """
    files, folder = code_files(path), path if path.is_dir() else path.parent
    hashes = {file.relative_to(folder).as_posix(): hashlib.sha256(read(file)).hexdigest() for file in files}
    if files == [path]:
        return next(iter(hashes.values())), ()
    lines = "".join(f"{one}  {name}\n" for name, one in hashes.items())
    return hashlib.sha256(lines.encode()).hexdigest(), tuple(hashes)


class CodeFile(Section):
    """A file of flight code. A vehicle file gives only its name, followed by `:Class` for Python."""

    file: str = Field(description="absolute path")
    sha256: str = Field(description="SHA-256 of the content, or of all files (code_hash)")
    member: str = optional("class in the Python file", "")
    files: tuple[str, ...] = optional("names of all files, if there are several", ())

    @model_validator(mode="before")
    @classmethod
    def _found(cls, value: Any, info: ValidationInfo) -> Any:
        if not isinstance(value, str):
            return value
        if not isinstance(value, Text) or not isinstance(info.context, Reading):
            raise refuse("names a file, but no files can be read here", "a table with file and sha256")
        is_source = info.field_name in ("sources", "data")
        is_python = not is_source and (".py" in value or info.field_name == "plug_in")
        name, _, member = value.rpartition(":") if is_python else (str(value), "", "")
        if is_python and not (name.endswith(".py") and member.isidentifier()):
            raise refuse("names no class", 'a file and a class in it, e.g. "my_fsw.py:Autopilot"')
        text = value.like(name)
        folders = (folder / name for folder in value.source.folders) if is_source else ()
        path = next(filter(Path.is_dir, folders), None) or find(text)
        if path is None:
            what = "a Python file" if is_python else "a shared library"
            what = f"a folder or file of {info.field_name}" if is_source else what
            raise refuse(*not_found(text, what, TABLE_VARIANTS))
        reading = info.context
        sha256, files = code_hash(path.resolve(), lambda file: reading.content(file, shown(file)))
        return {"file": str(path.resolve()), "sha256": sha256, "member": member, "files": files}

    @property
    def paths(self) -> list[Path]:
        """Return all files that the hash covers."""
        path = Path(self.file)
        return [(path if path.is_dir() else path.parent) / name for name in self.files] or [path]

    @property
    def title(self) -> str:
        """Return the displayed name of the file, with its class, for messages."""
        return shown(Path(self.file)) + (f":{self.member}" if self.member else "")

    @property
    def hashed(self) -> str:
        """Return the title, followed by the number and names of the hashed files if there are several."""
        count = f"{len(self.files)} file{'s' * (len(self.files) != 1)}"
        return f"{self.title} ({count}: {', '.join(self.files)})" if self.files else self.title


@lru_cache(maxsize=64)
def announce(what: str, code: str, sha256: str) -> None:
    """Log a warning, once per process, that code from outside is run, because a foreign file may name code."""
    mark = f" (sha256 {sha256[:16]})" if sha256 else ""
    logging.getLogger("maxq").warning("maxq: %s from outside: %s%s", what, code, mark)


def _loopback(text: str) -> str:
    found = _ADDRESS.fullmatch(text)
    allowed = "tcp://127.0.0.1:PORT or udp://127.0.0.1:PORT, of this machine"
    if not found or not 0 < int(found[3]) < 65536:
        raise refuse("is not an address", allowed)
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
    given: dict[str, Any] = {name: {"type": "string"} for name in ("file", "sha256", "member")}
    given["files"] = {"type": "array", "items": {"type": "string"}}
    table = {"type": "object", "properties": given, "required": ["file", "sha256"], "additionalProperties": False}
    return WithJsonSchema({"anyOf": [{"type": "string", "description": what}, table]})


LibraryFile = Annotated[CodeFile, _file_schema("name of a shared library")]
PlugIn = Annotated[CodeFile, _file_schema("name of a Python file and a law in it, with a colon between")]
PythonClass = Annotated[CodeFile, _file_schema("name of a Python file and a class in it, with a colon between")]
SourceFiles = Annotated[CodeFile, _file_schema("name of a folder or file")]
Address = Annotated[str, AfterValidator(_loopback)]
Settings = Annotated[str, AfterValidator(_fits)]
