"""Tables in text formats of other programs, which a vehicle file or a layout may name in place of a CSV file.

RASP engine files (.eng) have comments after a semicolon and a header: name, diameter mm, length mm, delays, propellant
kg, total kg, manufacturer. Times in s and thrusts in N follow. The first point (0, 0) is implied, and the last thrust
is 0. The thrust is a measurement, usually at ground level. Only the first motor of a file is read.

RockSim engine files (.rse) are XML: engine-database, engine-list, engine with propWt (propellant, g), data, and
eng-data with t (s) and f (N). They are read like RASP files; masses and centre of gravity over time are ignored.

Drag curves of RocketPy and OpenRocket are lines of a Mach number and a drag coefficient, without a line of names.

Missile DATCOM output (for006.dat; W. B. Blake, AFRL-VA-WP-TR-1998-3009) has pages "STATIC AERODYNAMICS FOR ..." with
MACH NO and columns ALPHA, CN, CM, CA, CY, CLN, CLL. For each Mach number, the last page is read, which describes the
whole configuration. Area, lengths and moment centre of the run must equal those of the vehicle file.

DAVE-ML models (.dml) are in dave_ml.py, with the same rule.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import ArrayLike

from maxq.sim.input.documents import Text
from maxq.sim.input.errors import refuse
from maxq.sim.input.files import Reading
from maxq.sim.input.ranges import range_of
from maxq.sim.input.tables_csv import Columns, CsvTable, Foreign
from maxq.sim.input.xml_tree import XmlError, xml_tree

_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[EeDd][-+]?\d+)?"
_HEAD = ["ALPHA", "CN", "CM", "CA", "CY", "CLN", "CLL"]
_NAMES = ("CN", "Cm", "CA", "CY", "Cn", "Cl")  # names of the columns in sim/vehicle/air/tables.py


def read_rasp(text: str, name: str, shown: str) -> CsvTable:
    """Return the thrust, and the mass flow of the header's propellant in proportion to it.

    Raises the refusal of the schema for a file without a header, points or an end at zero thrust.
    """
    lines = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if line.strip() and line.strip()[0] != ";"]
    if not lines:
        raise refuse("the file is empty", "a RASP engine file", file=shown)
    number, head = lines[0]
    cells = head.split()
    try:
        propellant_kg = float(cells[4])
    except (IndexError, ValueError):
        allowed = "name, diameter, length, delays, propellant kg, total kg, manufacturer"
        raise refuse("is not the header of a RASP file", allowed, file=shown, place=f"line {number}") from None
    points, places = [(0.0, 0.0)], [number]
    for place, line in lines[1:]:
        try:
            t, thrust = (float(cell) for cell in line.split())
        except ValueError:
            raise refuse("is not a time and a thrust", "two numbers", file=shown, place=f"line {place}") from None
        if t > 0.0:  # some files contain the implied point
            points.append((t, thrust))
            places.append(place)
        if thrust == 0.0 and t > 0.0:
            break
    else:
        raise refuse("the thrust does not end at 0", "a last line with thrust 0", file=shown)
    return _thrust(points, propellant_kg, name, shown, tuple(places))


def read_rse(text: str, name: str, shown: str) -> CsvTable:
    """Return the thrust and the mass flow of the first motor, as `read_rasp` does.

    Raises the refusal of the schema for a file that is no RockSim engine file, or without an end at zero thrust.
    """
    allowed = "a RockSim engine file: engine with propWt (g), and eng-data with t (s) and f (N)"
    try:
        engine = xml_tree(text).find(".//engine")
    except XmlError as error:
        place = f"line {error.line}" if error.line else ""
        raise refuse(str(error), allowed, file=shown, place=place) from None
    if engine is None:
        raise refuse("holds no engine", allowed, file=shown)
    try:
        propellant_kg = 1e-3 * float(engine.attrib["propWt"])
        found = [(float(data.attrib["t"]), float(data.attrib["f"])) for data in engine.iter("eng-data")]
    except (KeyError, ValueError) as error:
        raise refuse(f"the engine cannot be read ({error})", allowed, file=shown) from None
    points = [(0.0, 0.0), *(point for point in found if point[0] > 0.0)]
    if len(points) < 3 or points[-1][1] != 0.0:
        raise refuse("the thrust does not end at 0", "a last eng-data with f = 0", file=shown)
    return _thrust(points, propellant_kg, name, shown, tuple(range(1, len(points) + 1)))


def _thrust(
    points: list[tuple[float, float]], propellant_kg: float, name: str, shown: str, lines: tuple[int, ...]
) -> CsvTable:
    """Return the table of a thrust curve, with a mass flow in proportion to the thrust."""
    refuse_extreme(shown, points, propellant_kg)
    times, thrust_N = np.array(points).T
    impulse = float(np.trapezoid(thrust_N, times))
    if not impulse > 0.0:
        raise refuse("has no impulse", "thrust above 0", file=shown)
    flow = thrust_N * propellant_kg / impulse
    return _table(name, shown, lines, time_s=times, thrust_vacuum_N=thrust_N, mass_flow_kgps=flow)


def refuse_extreme(shown: str, *values: ArrayLike) -> None:
    """Raise the refusal of the schema if a number of a file is not finite, or too large to be computed with."""
    if not all((np.abs(np.asarray(each, float)) <= range_of("").most).all() for each in values):
        allowed = f"finite numbers of magnitudes up to {range_of('').most:g}"
        raise refuse("holds a number that is not finite, or too large", allowed, file=shown)


def read_drag_curve(text: str, name: str, shown: str) -> CsvTable | None:
    """Return the columns mach and CD of lines of two numbers, or None if the first line contains names.

    Comments begin with #. Raises the refusal of the schema for a line that is not two numbers.
    """
    lines = [(n, line) for n, line in enumerate(text.splitlines(), start=1) if line.strip() and line.strip()[0] != "#"]
    if not lines or _pair(lines[0][1]) is None:
        return None
    rows = []
    for number, line in lines:
        if (pair := _pair(line)) is None:
            allowed = "a Mach number and a drag coefficient on each line"
            raise refuse("is not two numbers", allowed, file=shown, place=f"line {number}")
        rows.append(pair)
    mach, drag = np.array(rows).T
    return _table(name, shown, tuple(n for n, _ in lines), mach=mach, CD=drag)


def _pair(line: str) -> tuple[float, float] | None:
    """Return the two numbers of a line, separated by a comma, a semicolon or spaces, or None."""
    cells = re.split(r"\s*[,;]\s*|\s+", line.strip())
    if len(cells) != 2 or not all(re.fullmatch(_NUMBER, cell) for cell in cells):
        return None
    return _real(cells[0]), _real(cells[1])


def read_datcom(text: str, name: str, shown: str) -> CsvTable:
    """Return the coefficients over Mach number and total angle of attack, or alpha if the vehicle is not symmetric.

    Raises the refusal of the schema for a file without such a page, and for a file with sideslip.
    """
    pages: dict[float, dict[float, tuple[list[float], int]]] = {}
    mach, page, reads = None, dict[float, tuple[list[float], int]](), False
    for number, line in enumerate(text.splitlines(), start=1):
        if "STATIC AERODYNAMICS FOR" in line:
            mach, page, reads = None, {}, False
        elif found := re.search(rf"MACH NO\s*=\s*({_NUMBER})", line):
            mach = _real(found[1])
            pages[mach] = page
        elif (found := re.search(rf"SIDESLIP\s*=\s*({_NUMBER})", line)) and _real(found[1]) != 0.0:
            raise refuse("has sideslip", "a run without", value=_real(found[1]), file=shown, place=f"line {number}")
        cells = line.split()
        if cells == _HEAD:
            reads = mach is not None and not page
        elif reads and len(cells) == len(_HEAD) and all(re.fullmatch(_NUMBER, cell) for cell in cells):
            alpha, *values = (_real(cell) for cell in cells)
            page[alpha] = values, number
        elif cells and page:
            reads = False
    rows = [(m, alpha, *values, n) for m, page in sorted(pages.items()) for alpha, (values, n) in sorted(page.items())]
    if not rows:
        allowed = f"pages STATIC AERODYNAMICS with MACH NO and columns {' '.join(_HEAD)}"
        raise refuse("holds no coefficients", allowed, file=shown)
    data = np.array(rows)
    at_rest = data[data[:, 1] == 0.0]
    symmetric = len(at_rest) == len(pages) and not at_rest[:, [2, 3]].any() and not data[:, [5, 6, 7]].any()
    if symmetric:
        data = data[data[:, 1] >= 0.0]
    columns = dict(zip(_NAMES[: 3 if symmetric else 6], data.T[2:-1], strict=False))
    axes = {"mach": data[:, 0], "total_deg" if symmetric else "alpha_deg": data[:, 1]}
    return _table(name, shown, tuple(int(n) for n in data[:, -1]), **axes, **columns)


def _real(cell: str) -> float:
    return float(cell.upper().replace("D", "E"))


def _table(name: str, shown: str, lines: tuple[int, ...], **columns: np.ndarray) -> CsvTable:
    return CsvTable(name, {key: column.copy() for key, column in columns.items()}, shown, lines)


def _rasp(name: Text, reading: Reading, columns: Columns) -> CsvTable | None:
    shown, text = reading.read_table(name)
    if name.lower().endswith(".rse"):
        return read_rse(text, str(name), shown)
    return read_rasp(text, str(name), shown) if name.lower().endswith(".eng") else None


def _drag(name: Text, reading: Reading, columns: Columns) -> CsvTable | None:
    shown, text = reading.read_table(name)
    return read_drag_curve(text, str(name), shown)


def _datcom(name: Text, reading: Reading, columns: Columns) -> CsvTable | None:
    shown, text = reading.read_table(name)
    return read_datcom(text, str(name), shown) if "STATIC AERODYNAMICS FOR" in text else None


def _coefficients(name: Text, reading: Reading, columns: Columns) -> CsvTable | None:
    if not name.lower().endswith(".dml"):
        return _datcom(name, reading, columns)
    from maxq.sim.input.dave_ml import DaveError, coefficient_columns, read_model  # noqa: PLC0415  # imports SciPy

    shown, text = reading.read_table(name)
    try:
        found = coefficient_columns(read_model(text))
    except DaveError as error:
        raise refuse(str(error), "an aerodynamic model in DAVE-ML (AIAA S-119)", file=shown) from None
    return _table(str(name), shown, (0,) * len(next(iter(found.values()))), **found)


RASP = Foreign("a RASP (.eng) or RockSim file (.rse)", _rasp)
DATCOM = Foreign("Missile DATCOM's for006.dat, or DAVE-ML (.dml)", _coefficients)
DRAG_CURVE = Foreign("lines of mach and CD without names", _drag)
