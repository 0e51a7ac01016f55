"""Normal modes from NASTRAN: the files op2 (PARAM,POST,-1) and f06 of a SOL 103, as tables of spatial modes.

    columns = spatial_columns({0.0: read_nastran("full.op2"), 59.0: read_nastran("empty.op2")})

Where a table of spatial modes is named in a vehicle file, a single such file may stand in its place: one state of mass,
the same at all times. Read are real eigenvectors (OUGV1, BOUGV1) and the summary of eigenvalues (LAMA) with their
generalised masses, and positions from the bulk data: GEOM1 in the op2, the echo in the f06, or a .bdf, .dat or .nas
of the same name beside either. The released pyNastran (1.4) needs NumPy before 2 and reads no f06: hence a reader of
our own, tested with files that pyNastran wrote.

The model's basic system is taken to have x aft from the nose, y right and z up, metres and kilograms; grid points in
it, and their displacements too. Only grid points on the x axis are taken: what is beside it has its share in the
generalised mass and none in the shapes. Modes below 0.1 Hz (the rigid body) are left out.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.limits import MAX_MODES
from maxq.sim.scenario.documents import Text
from maxq.sim.scenario.errors import refuse
from maxq.sim.scenario.files import Reading, find, shown
from maxq.sim.scenario.tables_csv import Columns, CsvTable

Floats = NDArray[np.float64]
SUFFIXES = (".op2", ".f06")
_BULK_DATA = (".bdf", ".dat", ".nas")
_LOWEST_HZ = 0.1
_ON_AXIS_M = 1e-3


@dataclass(frozen=True)
class NastranModes:
    """M modes at G grid points, in the model's basic system: x aft, y right, z up; m, rad per unit of the mode, kg."""

    frequency_hz: Floats  # (M,)
    generalized_mass_kg: Floats  # (M,)
    position_m: Floats  # (G, 3)
    shape: Floats  # (M, G, 6): T1 to T3, R1 to R3


def read_nastran(file: str | FilePath) -> NastranModes:
    """Modes of an op2 or f06 file. Raises the schema's refusal, naming the file, where it holds none."""
    path = FilePath(file)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise refuse(f"cannot be read: {error.strerror}", "a file you may read", file=str(file)) from None
    return _modes(content, path, str(file))


def _modes(content: bytes, path: FilePath, label: str) -> NastranModes:
    try:
        binary = path.suffix.lower() == ".op2"
        values, vectors, grids = _from_op2(content) if binary else _from_f06(content.decode("latin-1"))
    except (struct.error, ValueError, IndexError, UnicodeDecodeError) as error:
        kind = "an op2 file of 32-bit words" if path.suffix.lower() == ".op2" else "an f06 file"
        raise refuse(f"is not {kind} ({error})", "the output of a normal-modes run (SOL 103)", file=label) from None
    for suffix in _BULK_DATA:
        beside = path.with_suffix(suffix)
        if not grids and beside.is_file():
            grids = _grids(beside.read_text(encoding="latin-1").splitlines())
    for what, found in (("eigenvalues", values), ("eigenvectors", vectors), ("positions of grid points", grids)):
        if not found:
            allowed = "eigenvectors, eigenvalue summary and GRID cards (in the file, or in a .bdf beside it)"
            raise refuse(f"holds no {what}", allowed, file=label)
    points = sorted(set(grids).intersection(*(vectors[n] for n in vectors)))
    numbers = [n for n in sorted(vectors) if n in values and values[n][0] >= _LOWEST_HZ]
    if not points or not numbers:
        raise refuse("eigenvectors belong to no grid point or eigenvalue of the file", "one model's", file=label)
    return NastranModes(
        np.array([values[n][0] for n in numbers]),
        np.array([values[n][1] for n in numbers]),
        np.array([grids[p] for p in points]),
        np.array([[vectors[n][p] for p in points] for n in numbers]),
    )


Values = dict[int, tuple[float, float]]  # by mode: Hz, generalised mass
Vectors = dict[int, dict[int, tuple[float, ...]]]  # by mode and grid point
Grids = dict[int, tuple[float, float, float]]


def _from_op2(content: bytes) -> tuple[Values, Vectors, Grids]:
    values: Values = {}
    vectors: Vectors = {}
    grids: Grids = {}
    order = "<" if content[:4] == struct.pack("<i", 4) else ">"
    if content[:4] != struct.pack(order + "i", 4):
        raise ValueError("it begins with no Fortran record")
    for name, tables in _tables(content, order):
        if name in ("LAMA", "LAMAS", "BLAMA"):
            for data in tables[1:]:  # behind the description of the results
                for row in struct.iter_unpack(order + "ii5f", data[: len(data) // 28 * 28]):
                    values[row[0]] = row[4], row[5]
        elif name in ("OUGV1", "BOUGV1", "OUGV1PAT", "OPHIG", "BOPHIG"):
            for header, data in zip(tables[::2], tables[1::2], strict=False):
                mode, wide = (
                    struct.unpack_from(order + "i", header, 16)[0],
                    struct.unpack_from(order + "i", header, 36)[0],
                )
                if wide != 8:
                    raise ValueError(f"eigenvectors of {wide} words, not 8: real ones, by mode (SORT1)")
                rows = struct.iter_unpack(order + "ii6f", data[: len(data) // 32 * 32])
                vectors[mode] = {row[0] // 10: row[2:] for row in rows if row[1] == 1}  # 1: a grid point
        elif name in ("GEOM1", "GEOM1S", "GEOM1N"):
            for data in tables:
                if len(data) > 12 and struct.unpack_from(order + "3i", data)[:2] == (4501, 45):
                    for row in struct.iter_unpack(order + "ii3f3i", data[12 : 12 + (len(data) - 12) // 32 * 32]):
                        grids[row[0]] = _in_basic(row[1], row[0], row[2:5])
    return values, vectors, grids


def _tables(content: bytes, order: str) -> Iterator[tuple[str, list[bytes]]]:
    """Name and records of each data block, those of its description left out.

    A block is a word 2 and its name, then for each record k = 1, 2, ... the words -k, 1, 0, the number of words to come
    (0: the block ends) and those words, in several parts if they are many.
    """
    at, record, name = 0, 0, ""
    markers: list[int] = []
    parts: list[bytes] = []
    found: list[bytes] = []
    while at + 8 <= len(content):
        (size,) = struct.unpack_from(order + "i", content, at)
        if size < 0 or at + 8 + size > len(content):
            raise ValueError(f"record of {size} bytes at byte {at}")
        data, at = content[at + 4 : at + 4 + size], at + 8 + size
        expected = markers[-1] if len(markers) >= (3 if record < -1 else 1) else 0
        if expected > 0 and size == 4 * expected:
            if name:
                parts.append(data)
            elif expected == 2:
                name = data.decode("latin-1").strip()
            markers = markers[:2] if record < -1 else []
            continue
        if size != 4:
            raise ValueError(f"{size} bytes at byte {at} where {4 * expected} were announced")
        (number,) = struct.unpack(order + "i", data)
        if number < 0:
            if record < -2 and parts:
                found.append(b"".join(parts))
            record, markers, parts = number, [], []
        else:
            markers.append(number)
            if record < -1 and len(markers) == 3 and number == 0:
                if name:
                    yield name, found
                record, markers, parts, found, name = 0, [], [], [], ""


def _from_f06(text: str) -> tuple[Values, Vectors, Grids]:
    values: Values = {}
    vectors: Vectors = {}
    lines, into = text.splitlines(), ""
    mode = 0
    for line in lines:
        squeezed = line.replace(" ", "").upper()
        if "REALEIGENVALUES" in squeezed:
            into = "values"
        elif found := re.search(r"REALEIGENVECTORNO\.(\d+)", squeezed):
            into, mode = "vectors", int(found[1])
        elif line[:1] == "1":  # a new page
            into = into if into == "vectors" else ""
        elif into == "values":
            cells = line.split()
            if len(cells) == 7 and cells[0].isdigit() and cells[1].isdigit():
                values[int(cells[0])] = float(cells[4]), float(cells[5])
        elif into == "vectors":
            cells = line.split()
            if len(cells) == 8 and cells[0].isdigit() and cells[1] == "G":
                vectors.setdefault(mode, {})[int(cells[0])] = tuple(float(x) for x in cells[2:])
    echoed = (re.sub(r"^\s*\d+-\s+", "", line) for line in lines if re.match(r"\s*\d+-\s+GRID", line))
    return values, vectors, _grids(echoed)


def _grids(lines: Any) -> Grids:
    """Positions of GRID cards: free field (commas), small field, or large field (GRID*) with its continuation."""
    out: Grids = {}
    large: list[str] = []
    for card in lines:
        line = card.split("$")[0].rstrip()
        if large:
            z = line[8:24]
            out[int(large[0])] = _in_basic(
                _whole(large[1]), int(large[0]), (_real(large[2]), _real(large[3]), _real(z))
            )
            large = []
        elif line.upper().startswith("GRID*"):
            large = [line[8 + 16 * k : 24 + 16 * k] for k in range(4)]
        elif line.upper().startswith("GRID"):
            width = [line[8 * k : 8 * k + 8] for k in range(1, 6)]
            cells = ([*line.split(",")[1:], *[""] * 5][:5]) if "," in line else width
            x, y, z = (_real(cell) for cell in cells[2:5])
            out[int(cells[0])] = _in_basic(_whole(cells[1]), int(cells[0]), (x, y, z))
    return out


def _in_basic(system: int, grid: int, position: tuple[float, ...]) -> tuple[float, float, float]:
    if system != 0:
        raise ValueError(f"grid point {grid} is given in coordinate system {system}, not in the basic one")
    x, y, z = position
    return x, y, z


def _whole(cell: str) -> int:
    return int(cell) if cell.strip() else 0


def _real(cell: str) -> float:
    """A number as NASTRAN writes it: 1.5, 1.5+3, 1.5D3, blank for 0."""
    text = re.sub(r"(?<=[\d.])([+-])", r"e\1", cell.strip().upper().replace("D", "E").replace("E", "e"))
    return float(text.replace("ee", "e")) if text else 0.0


def spatial_columns(modes: Mapping[float, NastranModes], count: int = MAX_MODES) -> dict[str, list[float]]:
    """Columns of a table of spatial modes: the `count` lowest modes of each time (s).

    `mass_forward_kg` is zero, for a NASTRAN run does not tell it: the axial load then does not soften the modes. Raises
    the schema's refusal where fewer than two grid points lie on the axis.
    """
    out: dict[str, list[float]] = {}
    for time_s, given in sorted(modes.items()):
        on_axis = np.flatnonzero((np.abs(given.position_m[:, 1:]) < _ON_AXIS_M).all(axis=1))
        on_axis = on_axis[np.argsort(given.position_m[on_axis, 0], kind="stable")]
        if len(on_axis) < 2:
            raise refuse("has fewer than two grid points on the x axis", "a model along the x axis, aft of the nose")
        for n in np.argsort(given.frequency_hz, kind="stable")[:count]:
            rank = int((given.frequency_hz < given.frequency_hz[n]).sum()) + 1
            for g in on_axis:
                x, y, z, about_x, about_y, about_z = (float(v) for v in given.shape[n, g])
                row = {
                    "time_s": time_s, "mode": float(rank), "frequency_hz": float(given.frequency_hz[n]),
                    "generalized_mass_kg": float(given.generalized_mass_kg[n]),
                    "station_m": float(given.position_m[g, 0]),
                    "phi_x": -x, "phi_y": y, "phi_z": -z,
                    "theta_x_pm": -about_x, "theta_y_pm": about_y, "theta_z_pm": -about_z, "mass_forward_kg": 0.0,
                }  # fmt: skip  # twelve lines otherwise
                for name, value in row.items():
                    out.setdefault(name, []).append(value)
    return out


@dataclass(frozen=True)
class ModeColumns(Columns):
    """A table of spatial modes, or a NASTRAN file in its place."""

    def allowed(self) -> str:
        return f"{super().allowed()}; or a NASTRAN file ({', '.join(SUFFIXES)})"

    def _from_file(self, name: str, context: Any) -> CsvTable:
        if FilePath(name).suffix.lower() not in SUFFIXES or not isinstance(name, Text) or context is None:
            return super()._from_file(name, context)
        reading: Reading = context
        path = find(name)
        if path is None:
            raise refuse("no such file", "a CSV or NASTRAN file")
        label = shown(path)
        columns = spatial_columns({0.0: _modes(reading.content(path, label), path, label)})
        lists = {key: np.array(values) for key, values in columns.items()}
        for column in lists.values():
            column.flags.writeable = False
        return CsvTable(str(name), lists)
