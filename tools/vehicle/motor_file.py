"""Motor files of other programs with their headers: RASP (.eng) and RockSim (.rse); the first motor of each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from maxq.control.kernel.records import Array
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.files import Reading, shown
from maxq.sim.input.foreign import read_rasp, read_rse
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.input.xml_tree import xml_tree

SUFFIXES = (".eng", ".rse")


@dataclass(frozen=True)
class MotorFile:
    """A motor: its thrust over time, its masses, and its dimensions in m as its file states them."""

    name: str
    shown: str
    time_s: Array
    thrust_N: Array
    propellant_kg: float
    total_kg: float
    diameter_m: float
    length_m: float


def read_motor(path: Path) -> MotorFile:
    """Return the first motor of a file. Raises ScenarioError."""
    label = shown(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ScenarioError(label, "is not a motor file", allowed="a RASP (.eng) or RockSim file (.rse)")
    text = Reading().text(path, label, "a motor file")
    try:
        if path.suffix.lower() == ".rse":
            table, head = read_rse(text, label, label), _rse_head(text)
        else:
            table, head = read_rasp(text, label, label), _rasp_head(text)
    except ScenarioError:
        raise
    except ValueError as error:
        raise ScenarioError(label, _words(error)) from None
    return _motor(label, table, head)


def _words(error: ValueError) -> str:
    """Return the message of a refusal of the schema, or of another error."""
    context = getattr(error, "context", None)
    if not context:
        return str(error)
    return " ".join(part for part in (context["place"], context["problem"]) if part)


def _rasp_head(text: str) -> tuple[str, float, float, float, float]:
    """Return the name, diameter (m), length (m), propellant (kg) and total mass (kg) of a RASP header."""
    lines = [line for line in text.splitlines() if line.strip() and line.strip()[0] != ";"]
    cells = lines[0].split()
    try:
        diameter, length, propellant, total = (float(cells[k]) for k in (1, 2, 4, 5))
    except (IndexError, ValueError):
        raise ValueError("the header lacks diameter, length, propellant or total mass") from None
    return cells[0], 1e-3 * diameter, 1e-3 * length, propellant, total


def _rse_head(text: str) -> tuple[str, float, float, float, float]:
    engine = xml_tree(text).find(".//engine")
    assert engine is not None
    try:
        diameter, length, propellant, total = (
            1e-3 * float(engine.attrib[key]) for key in ("dia", "len", "propWt", "initWt")
        )
    except (KeyError, ValueError):
        raise ValueError("the engine lacks dia, len, propWt or initWt") from None
    return engine.get("code", ""), diameter, length, propellant, total


def _motor(label: str, table: CsvTable, head: tuple[str, float, float, float, float]) -> MotorFile:
    name, diameter, length, propellant, total = head
    if not 0.0 < propellant <= total or min(diameter, length) <= 0.0:
        raise ScenarioError(
            label,
            f"motor {name} has {propellant:g} kg of propellant in {total:g} kg, and is {diameter:g} m by {length:g} m",
            allowed="positive numbers, and no more propellant than the total mass",
        )
    return MotorFile(name, label, table["time_s"], table["thrust_vacuum_N"], propellant, total, diameter, length)
