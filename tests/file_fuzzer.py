"""Draw broken input files with Hypothesis, from the files that maxq ships and from their JSON Schemas.

`broken(kind)` is a strategy of texts: the base file of a kind with one to three mutations, or with damaged bytes. A
mutation drops, doubles or nests a value, changes its type, moves it to an end of its range, or adds a key, known to the
schema or not. `answer(kind, folder, name, data)` returns the error message of maxq: "" when the file loads and packs.
"""

from __future__ import annotations

import copy
import json
import tomllib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import tomli_w
from hypothesis import strategies as st
from scenario_files import ASCENT, DESIGN, ROCKET, TABLES, modes_csv, write_ascent

import maxq
from maxq import CampaignError, ScenarioError
from maxq.design.case.schema import read_case
from maxq.design.verify.flown import load_flight, load_wanted
from maxq.design.verify.suite import read_suite
from maxq.sim.campaign.targets import Refused
from maxq.sim.packing.flight import pack_flight
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.schemas import json_schema

CAMPAIGN = """\
schema = 1
extends = "ascent.toml"
[campaign]
runs = 20
sampling = "latin-hypercube"
keep = ["worst:2", "0,3"]
[campaign.envelope]
channels = ["alpha_deg"]
[[disperse]]
key = "vehicle.stage.0.engine.thrust_factor"
distribution = "normal"
three_sigma = 0.03
[[disperse]]
key = "vehicle.stage.0.bending.pitch.frequency_hz"
where = {mode = 1}
apply = "scale"
distribution = "truncated-normal"
sigma = 0.1
low = 0.8
high = 1.2
[[disperse]]
keys = ["vehicle.stage.0.bending.frequency_factor.0", "vehicle.stage.0.bending.frequency_factor.1"]
distribution = "normal"
covariance = [[4e-4, 1e-4], [1e-4, 9e-4]]
[[disperse]]
key = "vehicle.stage.0.tank.0.damping_ratio"
apply = "scale"
distribution = "log-normal"
sigma = 0.3
[[disperse]]
key = "wind.outside"
distribution = "choice"
values = ["hold", "error"]
weights = [0.5, 0.5]
[[disperse]]
key = "vehicle.computer.delay_s"
distribution = "samples"
file = "samples.csv"
[wind_model]
model = "vector"
table = "wind_model.csv"
correlation_length_m = 3000.0
"""
CASE = """\
schema = 2
scenario = "ascent"
nodes_s = [5.0, 30.0, 55.0]
loop = "sampled"
[gains]
schedule = "linear"
[filter]
structure = "sections"
quadratic = 1
first_order = 1
[filter.bounds]
zero_hz = [3.0, 40.0]
[objective]
kind = "least-margin"
[limits]
gain_margin_db = 6.0
without = ["rigid_hz"]
[robust]
bending_frequency = [0.05, 0.1]
[search]
starts = 2
"""
SUITE = """\
schema = 2
scenario = "ascent.toml"
wind_limit_mps = 20.0
[margins]
times_s = [5.0, 30.0]
cases = 10
[margins.nominal]
gain_up_db = 6.0
[margins.three_sigma]
bending_frequency = [0.05, 0.1]
[certificate]
times_s = [30.0]
[[dispersed_limit]]
requirement = "max_q_alpha_Padeg"
limit = 4e5
why = "room"
[[flight]]
name = "nominal"
set = ["run.step_s=0.002"]
limits = "dispersed"
[[campaign]]
file = "campaign.toml"
runs = 10
"""
LAYOUT = """\
schema = 1
nose_length_m = 1.6
site = {latitude_deg = 67.9, longitude_deg = 21.1, azimuth_deg = 0.0}
trajectory = {pitch_over_start_s = 5.0, final_path_angle_deg = 40.0}
control = {gyro_station_m = 1.2}
fairing = {front_station_m = 0.0, rear_station_m = 1.0, mass_kg = 10.0, jettison_altitude_m = 60e3}
[[stage]]
name = "lower"
front_station_m = 3.0
rear_station_m = 11.0
diameter_m = 0.8
modes = 2
part = [{name = "structure", mass_kg = 400.0, front_station_m = 3.0, rear_station_m = 11.0}]
shell = [{front_station_m = 3.0, rear_station_m = 11.0, wall_m = 0.0025, modulus_Pa = 7e10}]
[[stage.tank]]
name = "lox"
liquid_mass_kg = 1500.0
density_kgpm3 = 1140.0
radius_m = 0.38
height_m = 3.3
bottom_station_m = 9.4
damping_ratio = 0.02
[stage.engine]
thrust_vacuum_N = 52000.0
isp_vacuum_s = 290.0
exit_area_m2 = 0.08
gimbal_station_m = 11.0
exit_station_m = 11.8
mass_kg = 60.0
[[stage]]
name = "upper"
front_station_m = 0.0
rear_station_m = 3.0
diameter_m = 0.8
modes = 1
part = [{name = "payload", mass_kg = 90.0, front_station_m = 0.5, rear_station_m = 3.0, gyration_m = [0.3, 0.6]}]
shell = [{front_station_m = 0.0, rear_station_m = 3.0, EI_Nm2 = 3e6, rear_EI_Nm2 = 4e6}]
[[stage.tank]]
name = "solid"
liquid_mass_kg = 100.0
residual_kg = 5.0
density_kgpm3 = 900.0
radius_m = 0.3
height_m = 0.6
dome_m = [0.1, 0.1]
bottom_station_m = 2.6
damping_ratio = 0.02
[stage.engine]
thrust_vacuum_N = 4000.0
isp_vacuum_s = 300.0
gimbal_station_m = 3.0
exit_station_m = 3.5
mass_kg = 10.0
"""
FILES = {
    "scenario": "ascent.toml",
    "vehicle": "vehicles/rocket/vehicle.toml",
    "design": "designs/trial.toml",
    "campaign": "campaign.toml",
    "case": "case.toml",
    "suite": "suite.toml",
    "layout": "layout.toml",
}
BASES = {
    "scenario": ASCENT.replace("max_q_alpha_Pa_deg", "max_q_alpha_Padeg"),
    "vehicle": ROCKET,
    "design": DESIGN,
    "campaign": CAMPAIGN,
    "case": CASE,
    "suite": SUITE,
    "layout": LAYOUT,
}
CSV_FILES = {
    **{f"vehicles/rocket/{name}": text for name, text in TABLES.items()},
    "vehicles/rocket/modes.csv": modes_csv(),
    "winds/west.csv": "altitude_m,speed_mps,from_deg\n0,8,270\n12000,40,280\n",
    "samples.csv": "delay_s\n0.001\n0.003\n",
    "wind_model.csv": "altitude_m,sigma_north_mps,sigma_east_mps,correlation\n0,1,2,0.1\n9000,3,4,0.2\n",
}
KINDS = (*FILES, "table")


def write_files(folder: Path) -> None:
    """Write the intact files."""
    write_ascent(folder)
    for name in ("scenario", "campaign", "case", "suite", "layout"):
        (folder / FILES[name]).write_text(BASES[name])
    for name in ("samples.csv", "wind_model.csv"):
        (folder / name).write_text(CSV_FILES[name])


# values

NUMBERS = [
    0,
    -1,
    1,
    -0.0,
    0.5,
    2,
    60,
    1e-320,
    5e-324,
    1e-300,
    1e-30,
    1e-12,
    1e-6,
    1e3,
    1e6,
    1e9,
    9e9,
    1e10,
    1e15,
    1e29,
    1e30,
    -1e30,
    1e31,
    1e300,
    1.7976931348623157e308,
    -1e300,
    float("inf"),
    float("-inf"),
    float("nan"),
    2**31,
    2**53 + 1,
    2**62,
    2**63 - 1,
    2**63,
    2**64,
    -(2**63) - 1,
    10**400,
    1.0000000000000002,
    0.1 + 0.2,
    360.0,
    90.00000001,
    1e-9,
]
TEXTS = [
    "",
    " ",
    ".",
    "..",
    "../..",
    "/etc/passwd",
    "/",
    "a/b",
    "\x00",
    "\x1b[31m",
    "\n",
    "\u202e",
    "<script>",
    "{{7*7}}",
    "$\\frac$",
    "[red]x[/red]",
    "'; --",
    "x" * 5000,
    "0",
    "1e3",
    "nan",
    "true",
    "time_s",
    "é",
    "\ud7ff",
    "nominal",
    "ascent.toml",
    "vehicles/rocket",
    "winds/west.csv",
    "tank.csv",
    "samples.csv",
    "case.toml",
    "suite.toml",
    "vehicle.stage.0.mass.table.x_cg_m",
    "vehicle.stage.0.tank.0.name",
    "run.seed",
    "wind.profile",
    "run.stop_at",
    "vehicle.stage.0.bending.pitch",
    "max_q_alpha_Padeg",
    "run.step_s=1",
    "a=b",
    "=",
    "design.name=x",
]
NESTED = [
    [],
    {},
    [[]],
    [{}],
    {"a": 1},
    [1, "a"],
    [1.0] * 3,
    [[1.0] * 3] * 3,
    True,
    False,
    {"time_s": [0, 1]},
    [0] * 300,
]

numbers = st.one_of(st.sampled_from(NUMBERS), st.floats(), st.integers(-(10**20), 10**20), st.floats(-100.0, 100.0))
values = st.one_of(numbers, numbers, st.sampled_from(TEXTS), st.sampled_from(NESTED), st.text(max_size=8))


def from_schema(schema: dict[str, Any], root: dict[str, Any], depth: int = 0) -> st.SearchStrategy[Any]:
    """Return a strategy of values that mostly satisfy the schema; some numbers exceed its bounds."""
    if "$ref" in schema:
        return from_schema(root["$defs"][schema["$ref"].rpartition("/")[2]], root, depth)
    if "enum" in schema or "const" in schema:
        return st.sampled_from(schema.get("enum") or [schema["const"]])
    if "anyOf" in schema:
        return st.one_of(*(from_schema(choice, root, depth) for choice in schema["anyOf"]))
    kind = schema.get("type", "")
    if kind == "object":
        properties = schema.get("properties", {})
        needed = [key for key in schema.get("required", ()) if key in properties]
        further = [key for key in properties if key not in needed]
        if depth > 3 or not properties:
            return st.fixed_dictionaries({key: from_schema(properties[key], root, depth + 1) for key in needed})
        return (
            st.lists(st.sampled_from(further), max_size=3, unique=True).flatmap(
                lambda more: st.fixed_dictionaries(
                    {key: from_schema(properties[key], root, depth + 1) for key in (*needed, *more)}
                )
            )
            if further
            else st.fixed_dictionaries({key: from_schema(properties[key], root, depth + 1) for key in needed})
        )
    if kind == "array":
        items = schema.get("prefixItems")
        if items:
            return st.tuples(*(from_schema(item, root, depth + 1) for item in items)).map(list)
        least = schema.get("minItems", 0)
        inner = from_schema(schema.get("items", {"type": "number"}), root, depth + 1)
        return st.lists(inner, min_size=least, max_size=max(least, 3))
    if kind in ("number", "integer"):
        low = schema.get("minimum", schema.get("exclusiveMinimum", -1000.0))
        high = schema.get("maximum", schema.get("exclusiveMaximum", max(1000.0, 2 * abs(low))))
        ends = [low, high, (low + high) / 2, 1.0]
        if kind == "integer":
            return st.one_of(st.sampled_from([int(end) for end in ends]), st.integers(int(low), int(high)))
        return st.one_of(st.sampled_from([float(end) for end in ends]), st.floats(low, high), numbers)
    if kind == "boolean":
        return st.booleans()
    return st.sampled_from(TEXTS)


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all values in a tree."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, item in items:
        yield (*path, key)
        yield from places(item, (*path, key))


def at(tree: Any, path: tuple[Any, ...]) -> Any:
    """Return the value at a path."""
    for part in path:
        tree = tree[part]
    return tree


def schema_at(schema: dict[str, Any], path: tuple[Any, ...], root: dict[str, Any]) -> dict[str, Any]:
    """Return the schema of the object at `path`; empty if there is none."""
    if "$ref" in schema:
        return schema_at(root["$defs"][schema["$ref"].rpartition("/")[2]], path, root)
    if not path:
        return schema
    for choice in schema.get("anyOf", ()):
        if found := schema_at(choice, path, root):
            return found
    inner = schema.get("items", {}) if isinstance(path[0], int) else schema.get("properties", {}).get(path[0], {})
    return schema_at(inner, path[1:], root) if inner else {}


@cache
def _schema(kind: str) -> dict[str, Any]:
    return json_schema(kind)


@st.composite
def mutated(draw: st.DrawFn, kind: str) -> str:
    """Return the base document as TOML, with one to three mutations."""
    schema, tree = _schema(kind), copy.deepcopy(tomllib.loads(BASES[kind]))
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        every = list(places(tree))
        if not every:
            break
        what = draw(
            st.sampled_from(["number"] * 6 + ["value", "value", "schema", "schema", "drop", "double", "new", "unknown"])
        )
        if what == "number":
            every = [path for path in every if isinstance(at(tree, path), int | float)] or every
        path = draw(st.sampled_from(every))
        parent: Any = at(tree, path[:-1])
        if what == "drop":
            del parent[path[-1]]
        elif what == "double" and isinstance(parent, list):
            parent.append(copy.deepcopy(parent[path[-1]]))
        elif what == "schema" and (known := schema_at(schema, path, schema)):
            parent[path[-1]] = draw(from_schema(known, schema))
        elif what == "new" and isinstance(parent, dict):
            known = schema_at(schema, path[:-1], schema).get("properties", {})
            if known:
                key = draw(st.sampled_from(sorted(known)))
                parent[key] = draw(st.one_of(from_schema(known[key], schema), values))
        elif what == "unknown" and isinstance(parent, dict):
            parent[draw(st.sampled_from(TEXTS))] = draw(values)
        else:
            parent[path[-1]] = draw(numbers if what == "number" else values)
        tree = copy.deepcopy(tree)  # the next mutation must not change what the strategies share
    return toml(tree)


def toml(tree: dict[str, Any]) -> str:
    """Return a tree as TOML, including values that tomli_w cannot write."""
    try:
        return tomli_w.dumps(tree)
    except (TypeError, ValueError):  # an integer of thousands of digits, a lone surrogate
        return "\n".join(f"{json.dumps(key)} = {json.dumps(item, default=str)}" for key, item in tree.items())


BYTES = [
    b"\x00",
    b"\xff",
    b"\r",
    b"[",
    b"]",
    b'"',
    b"'''",
    b"=",
    b"#",
    b",",
    b"\n",
    b"9" * 5000,
    b"e999",
    b"\xef\xbb\xbf",
    b"-",
]


@st.composite
def damaged(draw: st.DrawFn, text: str) -> bytes:
    """Return the bytes of a text with some removed, doubled or inserted."""
    data = text.encode(errors="replace")
    for _ in range(draw(st.integers(1, 3))):
        at = draw(st.integers(0, len(data)))
        length = draw(st.integers(0, 20))
        put_in = draw(st.one_of(st.sampled_from(BYTES), st.binary(max_size=3), st.just(data[at : at + length] * 2)))
        data = data[:at] + put_in + data[at + length :]
    return data


@st.composite
def broken_table(draw: st.DrawFn) -> tuple[str, bytes]:
    """Return a CSV file with some cells, rows or bytes changed."""
    name = draw(st.sampled_from(sorted(CSV_FILES)))
    rows = [line.split(",") for line in CSV_FILES[name].splitlines()]
    for _ in range(draw(st.sampled_from([1, 1, 1, 2, 3]))):
        r = draw(st.integers(0, len(rows) - 1))
        c = draw(st.integers(0, len(rows[r]) - 1))
        what = draw(st.sampled_from(["cell", "cell", "cell", "cell", "row", "double", "short", "column"]))
        if what == "cell":
            rows[r][c] = draw(st.one_of(numbers.map(_cell), numbers.map(_cell), st.sampled_from(TEXTS)))
        elif what == "row" and len(rows) > 1:
            del rows[r]
        elif what == "double":
            rows.insert(r, list(rows[r]))
        elif what == "short" and len(rows[r]) > 1:
            del rows[r][c]
        elif what == "column":
            rows = [row[: max(c, 1)] for row in rows]
    text = "\n".join(",".join(row) for row in rows)
    return name, draw(damaged(text)) if draw(st.integers(0, 5)) == 0 else text.encode(errors="replace")


def _cell(number: float) -> str:
    return repr(number) if isinstance(number, float) or abs(number) < 10**30 else "9" * 400


def broken(kind: str) -> st.SearchStrategy[tuple[str, bytes]]:
    """Return the name and bytes of a broken file of a kind of KINDS."""
    if kind == "table":
        return broken_table()
    whole = st.one_of(*[mutated(kind).map(lambda text: text.encode(errors="replace"))] * 5, damaged(BASES[kind]))
    return whole.map(lambda data: (FILES[kind], data))


# what maxq says


def _flown(path: str) -> None:
    pack_flight(load_scenario(path).scenario)


def _campaign(path: str) -> None:
    campaign = maxq.load(path)
    for run in (0, 1):
        pack_flight(campaign.inputs(run).loaded.scenario)


def _suite(path: str) -> None:
    loaded = read_suite(path)
    for flown in loaded.suite.flight:
        pack_flight(load_flight(loaded, flown, "designs/trial.toml", None)[0].scenario)
    for wanted in loaded.suite.campaign:
        load_wanted(loaded, wanted, "designs/trial.toml", None)


def _layout(path: str) -> None:
    try:
        maxq.vehicle(path, "built")
    except ValueError as error:  # as simvehicle does
        raise ScenarioError(path, str(error)) from None
    _flown("built/scenario.toml")


USES: dict[str, Callable[[str], Any]] = {"campaign": _campaign, "case": read_case, "suite": _suite, "layout": _layout}


def answer(kind: str, folder: Path, name: str, data: bytes) -> str:
    """Return the error message for a file: "" if it loads and packs.

    Exceptions other than those for wrong input pass through.
    """
    place = folder / name
    before = place.read_bytes()
    place.write_bytes(data)
    try:
        if kind == "table":
            of_campaign = name in ("samples.csv", "wind_model.csv")
            (_campaign if of_campaign else _flown)("campaign.toml" if of_campaign else "ascent.toml")
        else:
            USES.get(kind, _flown)(FILES[kind] if kind in USES else "ascent.toml")
    except (ScenarioError, CampaignError, Refused) as error:
        return str(error)
    finally:
        place.write_bytes(before)
    return ""
