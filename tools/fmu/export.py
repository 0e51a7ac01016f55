"""The subcommand `simrun export SCENARIO --fmu FILE`: the vehicle of a scenario as a unit for co-simulation (FMI).

The outputs of the unit are the inputs of the flight computer (`maxq_fsw_inputs`), and its inputs are the commands
(`maxq_fsw_outputs`). Names, units and descriptions are those of maxq_fsw.h.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, get_args
from xml.etree import ElementTree

from maxq.control.external import HEADER, FswInputs, FswOutputs
from maxq.control.kernel.records import dtype_of
from maxq.sim.files import FileError, check_writable, plain_name, whole_file
from maxq.sim.flight.channels import unit_suffix
from maxq.sim.input.errors import ScenarioError
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.tools.cli.frame import CommandError, Exit
from maxq.tools.cli.terminal import tell
from maxq.tools.fmu import lockstep

Version = Literal["3.0", "2.0"]
VERSIONS = get_args(Version)
_DIMENSIONS = {
    "rad": {"rad": 1},
    "rad/s": {"rad": 1, "s": -1},
    "m/s": {"m": 1, "s": -1},
    "m": {"m": 1},
    "kg": {"kg": 1},
    "Pa": {"kg": 1, "m": -1, "s": -2},
    "s": {"s": 1},
    "T": {"kg": 1, "s": -2, "A": -1},
}
"""The exponents of the SI base units in each unit."""
UNITS = tuple(_DIMENSIONS)
_SUFFIXES = {unit_suffix(unit): unit for unit in UNITS}
_HOST = ["vehicle.computer.law=external", "vehicle.computer.address=tcp://127.0.0.1:1", "vehicle.computer.interface=2"]
_OTHER_CODE = ("library", "python", "sources", "data")
_PATIENCE = "vehicle.computer.timeout_s=100000"  # the master may be a person

SLAVE = """\
from maxq_lockstep import Lockstep
from pythonfmu{digit} import (
    Boolean, DefaultExperiment, Fmi{number}Causality, Fmi{number}Initial, Fmi{number}Slave, Fmi{number}Variability,
    {real}, {more}String
)

DISCRETE, FIXED = Fmi{number}Variability.discrete, Fmi{number}Variability.fixed
KINDS = {{"d": {real}, "q": {integer}}}


class {name}(Fmi{number}Slave):
    def __init__(self, **given):
        super().__init__(**given)
        self.author, self.description = "maxq", {description!r}
        self.flight = Lockstep(self.resources)
        self.time = 0.0
        face = self.flight.interface
        self.default_experiment = DefaultExperiment(0.0, face["duration_s"], face["sample_s"])
        if hasattr(Fmi{number}Causality, "independent"):
            self.add({real}, "time", "independent", Fmi{number}Variability.continuous, "time of the master",
                     lambda: self.time, None)
        for names, values, causality in (("inputs", self.flight.inputs, "output"),
                                         ("outputs", self.flight.commands, "input")):
            for name, kind, _, text in face[names]:
                self.add(KINDS[kind], name, causality, DISCRETE, text, lambda v=values, n=name: v[n],
                         lambda x, v=values, n=name: v.__setitem__(n, x))
        self.add(Boolean, "finished", "output", DISCRETE, "true after the end of the flight",
                 lambda: self.flight.finished, None)
        self.add(String, "log_folder", "parameter", FIXED, "folder for the log and the summary; empty: none",
                 lambda: self.flight.log_folder, lambda x: setattr(self.flight, "log_folder", x))

    def add(self, kind, name, causality, variability, text, getter, setter):
        initial = Fmi{number}Initial.calculated if causality == "output" else None
        causality = getattr(Fmi{number}Causality, causality)
        self.register_variable(kind(name, causality=causality, variability=variability, initial=initial,
                                    description=text, getter=getter, setter=setter), nested=False)

    def exit_initialization_mode(self):
        self.flight.start()

    def do_step(self, current_time, step_size):
        self.time = current_time + step_size
        self.flight.advance(self.time)
        return True

    def terminate(self):
        self.flight.stop()
"""


def execute(scenario: str, *, fmu: str, fmi: Version = "3.0", overrides: tuple[str, ...] = ()) -> int:
    """Write a unit for co-simulation. Raises CommandError without the packages of `maxq[fmu]`."""
    path = Path(fmu)
    if path.suffix != ".fmu":
        raise CommandError(f"--fmu {fmu}: the name of a unit for co-simulation ends with .fmu")
    builder = _builder(fmi)
    loaded = load_scenario(scenario, overrides)
    computer = loaded.vehicle.computer
    if computer is None:
        raise ScenarioError(loaded.label, "has no flight computer that a master could replace", "vehicle.computer")
    removed = [f"vehicle.computer.{key}=" for key in _OTHER_CODE if getattr(computer, key) is not None]
    loaded = load_scenario(scenario, [*overrides, *removed, *_HOST, _PATIENCE])
    check_writable(path.parent)
    count = write_fmu(loaded, path, fmi, builder)
    tell(f"{path}: FMI {fmi}, co-simulation, {count} variables")
    return Exit.OK


def _builder(fmi: Version) -> ModuleType:
    try:
        if fmi == "3.0":
            from pythonfmu3 import builder  # noqa: PLC0415  # an extra
        else:
            from pythonfmu import builder  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise CommandError(f"--fmu needs the packages of the extra fmu ({error}): pip install 'maxq[fmu]'") from None
    module: ModuleType = builder
    return module


def described_fields(schema: type) -> Iterator[tuple[str, str, str, str]]:
    """Yield name, kind (d or q, as in the module struct), unit and description of each number of a struct.

    Elements of arrays are separate numbers. The size of the struct is omitted. `schema` is FswInputs or FswOutputs; a
    command with the name of an input has the prefix `out_`.
    """
    taken = set(dtype_of(FswInputs).names or ()) if schema is FswOutputs else set()
    struct = {FswInputs: "inputs", FswOutputs: "outputs"}[schema]
    text = HEADER.read_text(encoding="utf-8").partition(f"typedef struct maxq_fsw_{struct} ")[2].partition("}")[0]
    comments = dict(re.findall(r"(\w+)(?:\[\d+\])*;\s*/\*\s*(.*?)\s*\*/", text, re.DOTALL))
    for name, (kind, *_) in (dtype_of(schema).fields or {}).items():
        if name == "bytes":
            continue
        unit = _SUFFIXES.get(name.rpartition("_")[2], "") if "_" in name else ""
        said = " ".join(comments.get(name, "").split())
        unique = f"out_{name}" if name in taken else name
        for index in _indices(kind.shape):
            yield unique + index, "d" if kind.base.kind == "f" else "q", unit, said


def _indices(shape: tuple[int, ...]) -> list[str]:
    if not shape:
        return [""]
    return [f"[{k}]{rest}" if not rest else f"[{k},{rest[1:]}" for k in range(shape[0]) for rest in _indices(shape[1:])]


def write_fmu(loaded: LoadedScenario, path: Path, fmi: Version, builder: Any) -> int:
    """Write the unit for a scenario whose computer is behind a socket, and return the number of its variables."""
    interface: dict[str, Any] = {
        "sample_s": float(loaded.vehicle.computer.sample_s) if loaded.vehicle.computer is not None else 0.0,
        "duration_s": float(loaded.scenario.run.duration_s),
        "python": sys.executable,
        "inputs": list(described_fields(FswInputs)),
        "outputs": list(described_fields(FswOutputs)),
    }
    name = re.sub(r"\W", "_", plain_name(path.stem, "maxq"))
    name = name if not name[0].isdigit() else f"maxq_{name}"
    script = f"{name}_fmi{fmi[0]}.py"  # units of different names or versions may be loaded in one process
    # FMI 2.0 has integers of 32 bits only: these numbers are reals, which are exact up to 2^53
    of_version = {
        "3.0": {"number": 3, "digit": "3", "real": "Float64", "integer": "Int64", "more": "Int64, "},
        "2.0": {"number": 2, "digit": "", "real": "Real", "integer": "Real", "more": ""},
    }[fmi]
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        resources = {
            "scenario.toml": loaded.as_flown,
            "interface.json": json.dumps(interface, indent=1),
            "maxq_lockstep.py": Path(lockstep.__file__).read_text(encoding="utf-8"),
            script: SLAVE.format(name=name, description=loaded.name, **of_version),
        }
        for file, content in resources.items():
            (folder / file).write_text(content, encoding="utf-8")
        others = [folder / file for file in resources if file != script]
        made = builder.FmuBuilder.build_FMU(folder / script, dest=folder / "made", project_files=others)
        units = {number: unit for side in ("inputs", "outputs") for number, _, unit, _ in interface[side] if unit}
        with whole_file(path, FileError) as part:
            return _completed(made, part, units)


def _completed(made: Path, path: Path, units: dict[str, str]) -> int:
    """Copy a unit for co-simulation with a complete description, and return the number of its variables."""
    with zipfile.ZipFile(made) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for item in old.infolist():
            content = old.read(item)
            if item.filename == "modelDescription.xml":
                root = ElementTree.fromstring(content)
                count = _complete(root, units | {"time": "s"})
                content = ElementTree.tostring(root, "utf-8", xml_declaration=True)
            new.writestr(item.filename.replace("\\", "/"), content)
    return count


def _complete(root: ElementTree.Element, units: dict[str, str]) -> int:
    """Add the units of variables, and for FMI 2.0 the list of variables with calculated initial values."""
    variables = list(root.iterfind("ModelVariables/*"))
    used = set()
    for variable in variables:
        number = variable if variable.tag == "Float64" else variable.find("Real")  # FMI 3.0, FMI 2.0
        if number is not None and (unit := units.get(variable.attrib["name"])):
            number.set("unit", unit)
            used.add(unit)
    for given in root.findall("UnitDefinitions"):
        root.remove(given)
    definitions = ElementTree.Element("UnitDefinitions")
    for unit in (unit for unit in UNITS if unit in used):
        base = {key: str(power) for key, power in _DIMENSIONS[unit].items()}
        ElementTree.SubElement(ElementTree.SubElement(definitions, "Unit", name=unit), "BaseUnit", base)
    place = [child.tag for child in root].index("CoSimulation") + 1
    root.insert(place, definitions)
    structure = root.find("ModelStructure")
    if structure is not None and root.attrib["fmiVersion"] == "2.0" and structure.find("InitialUnknowns") is None:
        unknowns = ElementTree.SubElement(structure, "InitialUnknowns")
        for index, variable in enumerate(variables, 1):
            if variable.attrib.get("causality") == "output":
                ElementTree.SubElement(unknowns, "Unknown", index=str(index))
    return len(variables)
