"""Normal modes from NASTRAN: the op2 (PARAM,POST,-1) and f06 files of a SOL 103, as tables of spatial modes.

    columns = spatial_columns({0.0: read_nastran("full.op2"), 59.0: read_nastran("empty.op2")})

A vehicle file may name such a file in place of a table of spatial modes. The modes are then those of one mass state,
constant over time. The reader reads real eigenvectors (OUGV1, BOUGV1) and the summary of eigenvalues (LAMA) with their
generalised masses. Positions and lumped masses (CONM2) come from the bulk data: GEOM1 and GEOM2 in the op2, the echo in
the f06, or a .bdf, .dat or .nas file of the same name in the same folder. This reader is needed because pyNastran 1.4
requires a NumPy version below 2 and does not read f06 files. The reader is tested with files written by pyNastran.

The model's basic system must have x aft from the nose, y right and z up, in metres and kilograms. Grid points and their
displacements must be in this system. A grid point of the axis with its own displacement system (CD) is rejected, and
other such points are ignored. Only grid points on the x axis are used. Points off the axis contribute to the
generalised mass but not to the shapes, and their CONM2 masses are added at the nearest point of the axis. Modes below
0.1 Hz (the rigid body) are omitted.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maxq.control.kernel.limits import MAX_MODES
from maxq.sim.input.documents import Text
from maxq.sim.input.errors import refuse
from maxq.sim.input.files import Reading, find, shown
from maxq.sim.input.foreign import refuse_extreme
from maxq.sim.input.tables_csv import Columns, CsvTable, Foreign

Floats = NDArray[np.float64]
SUFFIXES = (".op2", ".f06")
_BULK_DATA = (".bdf", ".dat", ".nas")
_LOWEST_HZ = 0.1
_ON_AXIS_M = 1e-3


@dataclass(frozen=True)
class NastranModes:
    """M modes at G grid points, in the model's basic system: x aft, y right, z up.

    Lengths are in m and masses in kg. Shapes are in m and rad per unit of the mode.
    """

    frequency_hz: Floats  # (M,)
    generalized_mass_kg: Floats  # (M,)
    position_m: Floats  # (G, 3)
    shape: Floats  # (M, G, 6): T1 to T3, R1 to R3
    lumped: Floats  # (L, 4) of the CONM2 cards: x, y, z (including the offset), mass
    inertia_x_kgm2: Floats  # (L,) of each CONM2 mass about its own CG


def read_nastran(file: str | FilePath) -> NastranModes:
    """Return the modes of an op2 or f06 file.

    Raises the refusal of the schema, with the name of the file, if the file contains no modes.
    """
    path = FilePath(file)
    try:
        content = path.read_bytes()
    except OSError as error:
        raise refuse(f"cannot be read: {error.strerror}", "a file you may read", file=str(file)) from None
    return _modes(content, path, str(file))


def _modes(content: bytes, path: FilePath, label: str) -> NastranModes:
    try:
        binary = path.suffix.lower() == ".op2"
        values, vectors, bulk = _from_op2(content) if binary else _from_f06(content.decode("latin-1"))
        for suffix in _BULK_DATA:
            beside = path.with_suffix(suffix)
            if not (bulk.grids and bulk.masses) and beside.is_file():
                bulk = bulk.or_else(_bulk(beside.read_text(encoding="latin-1").splitlines()))
    except (struct.error, ValueError, IndexError, UnicodeDecodeError) as error:
        kind = "an op2 file of 32-bit words" if path.suffix.lower() == ".op2" else "an f06 file"
        said = str(error)[:100]
        raise refuse(f"is not {kind} ({said})", "the output of a normal-modes run (SOL 103)", file=label) from None
    grids = bulk.grids
    for what, found in (("eigenvalues", values), ("eigenvectors", vectors), ("positions of grid points", grids)):
        if not found:
            allowed = "eigenvectors, eigenvalue summary and GRID cards (in the file, or in a .bdf next to it)"
            raise refuse(f"holds no {what}", allowed, file=label)
    points = sorted(set(grids).intersection(*(vectors[n] for n in vectors)))
    turned = [p for p in points if bulk.displaced_in.get(p, 0) != 0]
    if astray := [p for p in turned if max(map(abs, grids[p][1:])) < _ON_AXIS_M]:
        problem = f"grid point {astray[0]} moves in coordinate system {bulk.displaced_in[astray[0]]} (CD)"
        raise refuse(problem, "displacements of the x axis in the basic system", file=label)
    points = [p for p in points if p not in turned]
    numbers = [n for n in sorted(vectors) if n in values and values[n][0] >= _LOWEST_HZ]
    if not points or not numbers:
        raise refuse("eigenvectors belong to no grid point or eigenvalue of the file", "one model's", file=label)
    modes = NastranModes(
        np.array([values[n][0] for n in numbers]),
        np.array([values[n][1] for n in numbers]),
        np.array([grids[p] for p in points]),
        np.array([[vectors[n][p] for p in points] for n in numbers]),
        *bulk.lumped(),
    )
    refuse_extreme(label, *vars(modes).values())
    return modes


Values = dict[int, tuple[float, float]]  # by mode: Hz, generalised mass
Vectors = dict[int, dict[int, tuple[float, ...]]]  # by mode and grid point
Position = tuple[float, float, float]


@dataclass(frozen=True)
class _Bulk:
    """The parts of the bulk data that are read: grid points, their displacement systems (CD), and CONM2 masses."""

    grids: dict[int, Position]
    displaced_in: dict[int, int]
    masses: list[tuple[int, float, Position, float]]  # grid point, kg, offset, inertia about x

    def add_grid(self, grid: int, system: int, position: tuple[float, ...], displaced_in: int) -> None:
        self.grids[grid], self.displaced_in[grid] = _in_basic("grid point", system, grid, position), displaced_in

    def add_mass(self, grid: int, system: int, mass: float, offset: tuple[float, ...], about_x: float) -> None:
        self.masses.append((grid, mass, _in_basic("the mass at grid point", system, grid, offset), about_x))

    def or_else(self, other: _Bulk) -> _Bulk:
        points = self if self.grids else other
        return _Bulk(points.grids, points.displaced_in, self.masses or other.masses)

    def lumped(self) -> tuple[Floats, Floats]:
        """Return the lumped masses and inertias as the arrays of `NastranModes`."""
        known = [mass for mass in self.masses if mass[0] in self.grids]
        places = [[*map(sum, zip(self.grids[grid], offset, strict=True)), kg] for grid, kg, offset, _ in known]
        return np.array(places, dtype=np.float64).reshape(-1, 4), np.array([about_x for *_, about_x in known])


def _from_op2(content: bytes) -> tuple[Values, Vectors, _Bulk]:
    values: Values = {}
    vectors: Vectors = {}
    bulk = _Bulk({}, {}, [])
    order = "<" if content[:4] == struct.pack("<i", 4) else ">"
    if content[:4] != struct.pack(order + "i", 4):
        raise ValueError("it begins with no Fortran record")
    for name, tables in _tables(content, order):
        if name in ("LAMA", "LAMAS", "BLAMA"):
            for data in tables[1:]:  # after the description of the results
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
                for row in _rows(data, order, (4501, 45), "ii3f3i"):
                    bulk.add_grid(row[0], row[1], row[2:5], row[5])
        elif name in ("GEOM2", "GEOM2S", "GEOM2N"):
            for data in tables:
                for row in _rows(data, order, (1501, 15), "3i10f"):
                    bulk.add_mass(row[1], row[2], row[3], row[4:7], row[7])
    return values, vectors, bulk


def _rows(data: bytes, order: str, card: tuple[int, int], words: str) -> Iterator[tuple[Any, ...]]:
    """Yield the cards of one kind in a record of the bulk data; none if the record contains other cards."""
    size = struct.calcsize(order + words)
    if len(data) > 12 and struct.unpack_from(order + "3i", data)[:2] == card:
        yield from struct.iter_unpack(order + words, data[12 : 12 + (len(data) - 12) // size * size])


def _tables(content: bytes, order: str) -> Iterator[tuple[str, list[bytes]]]:
    """Yield name and records of each data block, without the records of its description.

    A block is a word 2 and its name. For each record k = 1, 2, ... follow the words -k, 1, 0, the number of words in
    the next part (0 ends the block) and those words; a long record has several parts.
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
            if record == -1 and markers == [0]:  # after the label of the file, before the first block
                record, markers, name = 0, [], ""
            if record < -1 and len(markers) == 3 and number == 0:
                if name:
                    yield name, found
                record, markers, parts, found, name = 0, [], [], [], ""


def _from_f06(text: str) -> tuple[Values, Vectors, _Bulk]:
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
    # The echo: line number in the deck, a hyphen, the card; continuations begin with + or *.
    echoed = (re.sub(r"^\s*\d+-\s{1,8}", "", line) for line in lines if re.match(r"\s*\d+-\s", line))
    return values, vectors, _bulk(echoed)


def _bulk(lines: Iterable[str]) -> _Bulk:
    """Return the GRID and CONM2 cards: free field (commas), small field, or large field (NAME*), with continuations."""
    bulk, defaults = _Bulk({}, {}, []), ["", ""]
    cards = list(_cards(lines))
    for name, cells in cards:
        if name == "GRDSET":
            defaults = [cells[1], cells[5]]
    for name, cells in cards:
        if name == "GRID":
            cp, cd = (own.strip() or default for own, default in zip((cells[1], cells[5]), defaults, strict=True))
            bulk.add_grid(int(cells[0]), _whole(cp), tuple(_real(cell) for cell in cells[2:5]), _whole(cd))
        elif name == "CONM2":
            offset = tuple(_real(cell) for cell in cells[4:7])
            bulk.add_mass(int(cells[1]), _whole(cells[2]), _real(cells[3]), offset, _real(cells[8]))
    return bulk


def _cards(lines: Iterable[str]) -> Iterator[tuple[str, list[str]]]:
    """Yield name and fields of each GRDSET, GRID and CONM2 card.

    There are 8 fields, then 8 of each continuation; absent fields are blank.
    """
    name, cells = "", [""]
    for whole in lines:
        line = whole.split("$")[0].rstrip()
        begins = re.match(r"(GRDSET|GRID|CONM2)\b", line, re.IGNORECASE)
        if begins or not re.match(r"[+*, ]", line):
            if name:
                yield name, [*cells, *[""] * 16]
            name, cells = (begins[1].upper() if begins else ""), []
        if not name or not line:
            continue
        width, count = (16, 4) if "*" in line[:8] else (8, 8)
        fields = [line[8 + width * k : 8 + width * (k + 1)] for k in range(count)]
        cells += (line.split(",")[1:9] + [""] * 8)[:8] if "," in line else fields
    if name:
        yield name, [*cells, *[""] * 16]


def _in_basic(what: str, system: int, grid: int, position: tuple[float, ...]) -> Position:
    if system != 0:
        raise ValueError(f"{what} {grid} is given in coordinate system {system}, not in the basic one")
    x, y, z = position
    return x, y, z


def _whole(cell: str) -> int:
    return int(cell) if cell.strip() else 0


def _real(cell: str) -> float:
    """Return a number in NASTRAN notation, such as 1.5, 1.5+3 or 1.5D3; 0 for a blank field."""
    text = re.sub(r"(?<=[\d.])([+-])", r"e\1", cell.strip().upper().replace("D", "E").replace("E", "e"))
    return float(text.replace("ee", "e")) if text else 0.0


def spatial_columns(modes: Mapping[float, NastranModes], count: int = MAX_MODES) -> dict[str, list[float]]:
    """Return the columns of a table of spatial modes: the `count` lowest modes at each time (s).

    `mass_forward_kg` is that of the CONM2 cards. It is zero if these cards do not represent the whole mass at every
    time. This is the case without cards, or if the shapes weighted with them give less than half or more than twice a
    generalised mass. The axial load then does not soften the modes, and reading the table gives a warning. Otherwise
    `mass_kg` (and `roll_inertia_kgm2`) are lumped at the stations. Raises the refusal of the schema if fewer than two
    grid points are on the axis.
    """
    out: dict[str, list[float]] = {}
    states = {time_s: (given, _on_axis(given)) for time_s, given in sorted(modes.items())}
    whole = all(_explains(given, axis, *_at_axis(given, axis)) for given, axis in states.values())
    for time_s, (given, on_axis) in states.items():
        mass, rolling = _at_axis(given, on_axis)
        lumped = np.stack([mass, rolling, _forward(mass)]) if whole else np.zeros((3, len(on_axis)))
        for n in np.argsort(given.frequency_hz, kind="stable")[:count]:
            rank = int((given.frequency_hz < given.frequency_hz[n]).sum()) + 1
            for k, g in enumerate(on_axis):
                x, y, z, about_x, about_y, about_z = (float(v) for v in given.shape[n, g])
                row = {
                    "time_s": time_s,
                    "mode": float(rank),
                    "frequency_hz": float(given.frequency_hz[n]),
                    "generalized_mass_kg": float(given.generalized_mass_kg[n]),
                    "station_m": float(given.position_m[g, 0]),
                    "phi_x": -x,
                    "phi_y": y,
                    "phi_z": -z,
                    "theta_x_pm": -about_x,
                    "theta_y_pm": about_y,
                    "theta_z_pm": -about_z,
                    "mass_forward_kg": float(lumped[2, k]),
                }
                if whole:
                    row |= {"mass_kg": float(lumped[0, k]), "roll_inertia_kgm2": float(lumped[1, k])}
                for name, value in row.items():
                    out.setdefault(name, []).append(value)
    if whole and not any(out["roll_inertia_kgm2"]):
        del out["roll_inertia_kgm2"]
    return out


def _on_axis(given: NastranModes) -> NDArray[np.int64]:
    """Return the indices of the grid points on the axis, from the nose aft."""
    on_axis = np.flatnonzero((np.abs(given.position_m[:, 1:]) < _ON_AXIS_M).all(axis=1))
    if len(on_axis) < 2:
        raise refuse("has fewer than two grid points on the x axis", "a model along the x axis, aft of the nose")
    return on_axis[np.argsort(given.position_m[on_axis, 0], kind="stable")]


def _at_axis(given: NastranModes, on_axis: NDArray[np.int64]) -> tuple[Floats, Floats]:
    """Return mass and inertia about x of the CONM2 cards, each at the nearest station of the axis."""
    stations = given.position_m[on_axis, 0]
    mass, rolling = np.zeros((2, len(stations)))
    x, y, z, kg = given.lumped.T
    at = np.abs(x[:, None] - stations).argmin(axis=1) if len(x) else np.zeros(0, int)
    np.add.at(mass, at, kg)
    np.add.at(rolling, at, given.inertia_x_kgm2 + kg * (y * y + z * z))
    return mass, rolling


def _explains(given: NastranModes, on_axis: NDArray[np.int64], mass: Floats, rolling: Floats) -> bool:
    """Return True if the lumped masses represent the whole mass.

    In that case the modes have the generalised masses of the file within a factor of two. Without inertias about the
    axis, only the modes that do not twist are compared.
    """
    shape = given.shape[:, on_axis]
    twist = (rolling * shape[..., 3] ** 2).sum(axis=1)
    ratio = ((mass[:, None] * shape[..., :3] ** 2).sum(axis=(1, 2)) + twist) / given.generalized_mass_kg
    if not rolling.any():
        span = np.ptp(given.position_m[on_axis, 0])
        ratio = ratio[(shape[..., :3] ** 2).sum(axis=(1, 2)) > span**2 * (shape[..., 3] ** 2).sum(axis=1)]
    return bool(mass.any() and len(ratio) and (np.abs(np.log(np.maximum(ratio, 1e-300))) < np.log(2.0)).all())


def _forward(mass: Floats) -> Floats:
    """Return the mass forward of each station, including half of the station's own mass.

    At the last station it is the whole mass. At the first station it is the station's mass minus half of the second
    station's, and at least zero.
    """
    forward = np.cumsum(mass) - 0.5 * mass
    forward[0], forward[-1] = max(mass[0] - 0.5 * mass[1], 0.0), mass.sum()
    return forward


def _table(name: Text, reading: Reading, columns: Columns) -> CsvTable | None:
    if FilePath(name).suffix.lower() not in SUFFIXES:
        return None
    path = find(name)
    if path is None:
        raise refuse("no such file", "a CSV or NASTRAN file")
    label = shown(path)
    lists = spatial_columns({0.0: _modes(reading.content(path, label), path, label)})
    return CsvTable(str(name), {key: np.array(values) for key, values in lists.items()})


NASTRAN = Foreign(f"a NASTRAN file ({', '.join(SUFFIXES)})", _table)
