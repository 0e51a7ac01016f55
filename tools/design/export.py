"""`simdesign export DESIGN`: the law as C99 sources (`--c DIR`), or plant, law and loop at the nodes as matrices.

The sources in control/flight_law are copied as they are; what belongs to the design are its tables and the samples of
its unit test, which come from a flight. So what is compiled is what the tests compile, with the numbers that fly.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from maxq.control.attitude import QUATERNION
from maxq.control.external import HEADER
from maxq.control.kernel.limits import MAX_SENSORS
from maxq.control.kernel.tables import table_in
from maxq.control.structures import MAX_SECTIONS, Law
from maxq.design import api
from maxq.design.laws.design_file import design_path
from maxq.design.model.node import Node
from maxq.design.model.state_space import StateSpace
from maxq.design.model.vehicle_at import Plane
from maxq.design.verify.memory import content_hash
from maxq.sim.files import FileError, cannot_write, check_writable, whole_file, write_whole
from maxq.sim.log.head import maxq_version
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.errors import ScenarioError
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_scenario import Injection
from maxq.tools.cli.frame import Exit
from maxq.tools.design.analyse import load

Format = Literal["mat", "npz", "json"]
FORMATS = get_args(Format)
SOURCES = ("flight_law.h", "flight_law.c", "flight_law_fsw.c", "test_flight_law.c", "CMakeLists.txt")
TEST_SAMPLES = 600
EXPORTED_LAWS = get_args(Law)
_SHAKEN = {"at": "rate_command", "kind": "sine", "amplitude_degps": 2.0}
_UNITS = {
    "radps2": "rad/s^2", "radps": "rad/s", "rad": "rad", "mps2": "m/s^2", "mps": "m/s", "m": "m", "s": "s", "N": "N",
    "Nm": "N m",
}  # fmt: skip  # five more lines otherwise


@dataclass(frozen=True)
class Order:
    """What the command line asks for."""

    design: str
    c: str | None = None
    format: Format | None = None
    scenario: str = "nominal"
    vehicle: str | None = None
    times_s: tuple[float, ...] = ()
    axis: Plane | None = None
    out: str | None = None


def execute(order: Order) -> int:
    """Do it; returns the exit code."""
    if order.c is not None:
        changes = [f'design="{design_path(order.design)}"']
        changes += [f'vehicle="{order.vehicle}"'] if order.vehicle is not None else []
        files = export_c(load_scenario(order.scenario, changes), Path(order.c))
        build = f"cmake -S {order.c} -B {order.c}/build && cmake --build {order.c}/build"
        print(
            f"{len(files)} files in {order.c}/; build and test them with\n  {build} && ctest --test-dir {order.c}/build"
        )
        return Exit.OK
    form = order.format or "mat"
    path = Path(order.out or f"{Path(order.design).stem}.{form}")
    check_writable(path.parent)
    scenario, design = load(order.scenario, order.vehicle, order.design)
    planes: tuple[Plane, ...] = (order.axis,) if order.axis is not None else ("pitch", "yaw")
    nodes = [node for plane in planes for node in api.nodes(scenario, order.times_s or None, plane=plane)]
    write_matrices(path, form, [described(node, design) for node in nodes])
    print(f"{len(nodes)} nodes in {path}")
    return Exit.OK


# the law as C


def export_c(loaded: LoadedScenario, folder: Path) -> list[Path]:
    """Sources of the law that `loaded` flies, tables and unit test in a folder; files of these names are replaced.

    Raises ScenarioError where the scenario has no such law.
    """
    design, computer = loaded.design, loaded.vehicle.computer
    if design is None or computer is None:
        raise ScenarioError(
            loaded.label, "there is no design to export", "design", allowed="with [computer] and design"
        )
    if design.law not in EXPORTED_LAWS:
        raise ScenarioError(
            loaded.label, "cannot be exported as C", "design.law", value=design.law, allowed=", ".join(EXPORTED_LAWS)
        )
    first, stages = (design.of_stage(0), loaded.vehicle.computer_of(0)), range(len(loaded.vehicle.stage))
    if any((design.of_stage(n), loaded.vehicle.computer_of(n)) != first for n in stages):
        raise ScenarioError(
            loaded.label, "has a stage with gains, filter or computer of its own, which the C code would not follow",
            "design.stage", allowed="one law for all stages",
        )  # fmt: skip  # two more lines otherwise
    check_writable(folder)
    packed = pack_flight(loaded.scenario)
    said = (
        f"{design.name or 'a design'} for {loaded.vehicle.name or 'a vehicle'}; written by maxq {maxq_version()}, "
        f"design {content_hash(repr(design))[:16]}"
    ).replace("*/", "* /")
    texts = {name: (HEADER.parent / "flight_law" / name).read_text(encoding="utf-8") for name in SOURCES}
    texts[HEADER.name] = HEADER.read_text(encoding="utf-8")
    texts["flight_law_tables.h"] = "\n".join(_declared(packed, said)) + "\n"
    texts["flight_law_tables.c"] = "\n".join(_defined(packed, said)) + "\n"
    texts["test_vectors.h"] = "\n".join(_vectors(loaded, said)) + "\n"
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise FileError(cannot_write(folder, error)) from error
    return [write_whole(folder / name, text) for name, text in texts.items()]


def further_gyros(computer: Any) -> int:
    """Rate gyros beyond the first that have a part in the law's rate."""
    used = np.flatnonzero(np.any(computer.sensors.blend[:, 1:] != 0.0, axis=0))
    return int(used[-1]) + 1 if len(used) else 0


def _declared(packed: Packed, said: str) -> Iterator[str]:
    """flight_law_tables.h."""
    computer, stages = packed.parameters[0].computer, packed.parameters
    roll = computer.roll
    by_gimbals = next((s.computer.allocation for s in stages if int(s.computer.allocation.groups) > 1), None)
    k_p, k_d_s, limit_rad = (0.0, 0.0, 0.0)
    if by_gimbals is not None:
        k_p, k_d_s, limit_rad = (float(getattr(by_gimbals, name)) for name in ("k_p", "k_d_s", "roll_limit_rad"))
    n, blends = int(computer.law.gains.n_breaks), int(further_gyros(computer) > 0)
    numbers = (
        ("SAMPLE_NS", int(computer.sample_ns), "period of the samples"),
        ("SAMPLE_S", int(computer.sample_ns) / 1.0e9, ""),
        ("COUNT_RAD", float(computer.converter.count_rad), "angle per gyro pulse; 0: angles are given"),
        (
            "RATE_INTEGRAL",
            int(int(computer.attitude) != QUATERNION),
            "1: the error is the angle less the commanded angle",
        ),
        ("ANGLE_ERROR_LIMIT_RAD", float(computer.angle_error_limit_rad), "of the attitude error"),
        ("COMMAND_LIMIT_RAD", float(computer.command_limit_rad), "of the gimbal command"),
        ("DAC_STEP_RAD", float(computer.dac_step_rad), "of the output converter; 0: none"),
        ("ROLL_THRUSTERS", int(computer.roll_on), "1: the law fires thrusters"),
        ("ROLL_K_RATE_S", float(roll.k_rate_s), "switching line: error + this times rate"),
        ("ROLL_DEAD_BAND_RAD", float(roll.dead_band_rad), ""),
        ("ROLL_HYSTERESIS_RAD", float(roll.hysteresis_rad), ""),
        ("ROLL_SHORTEST_TICKS", int(roll.minimum_on_ticks), "samples of a firing"),
        ("ROLL_GIMBAL_K_P", k_p, "roll by groups of engines"),
        ("ROLL_GIMBAL_K_D_S", k_d_s, ""),
        ("ROLL_GIMBAL_LIMIT_RAD", limit_rad, ""),
        ("GAINS", 3 if int(computer.pid.on) or int(computer.relief.on) else 2, "of an axis"),
        ("LOAD_RELIEF", int(computer.relief.on), "1: the third gain is that of the acceleration; 0: of an integral"),
        ("ACCEL_SHARE", float(computer.relief.share), "by which a sample takes the acceleration's lag along"),
        ("FURTHER_GYROS", further_gyros(computer), "rate gyros beyond the first in the rate"),
        ("INTEGRAL_LIMIT_RAD", min(float(computer.pid.limit_rad), 1.0e9), "of the integral's share"),
        ("GAIN_BREAKS", n, "times of the gain schedule"),
    )
    yield from (f"/* {said} */", "#ifndef FLIGHT_LAW_TABLES_H", "#define FLIGHT_LAW_TABLES_H", "")
    yield from ('#include "flight_law.h"', "")
    for name, value, meaning in numbers:
        yield f"#define LAW_{name} {value!r}" + (f" /* {meaning} */" if meaning else "")
    yield from (
        "",
        "extern const law_real law_gain_time_s[LAW_GAIN_BREAKS];",
        "/* per interval: coefficients of powers 0 to 3 of the time in it; k_p, k_d_s (, k_i_ps) in pitch, then yaw */",
        "extern const law_real law_gain[LAW_GAIN_BREAKS - 1][4][2 * LAW_GAINS];",
        *(("extern const law_real law_blend[2][LAW_FURTHER_GYROS + 1]; /* weights in pitch and yaw */",) * blends),
        "extern const int32_t law_sections[2]; /* of the bending filter, in pitch and yaw */",
        "extern const law_real law_section[2][LAW_MOST_SECTIONS][5]; /* b0, b1, b2, a1, a2 with a0 = 1 */",
        "",
        "#endif",
    )


def _defined(packed: Packed, said: str) -> Iterator[str]:
    """flight_law_tables.c."""
    law = packed.parameters[0].computer.law
    gains = table_in(packed.pool, law.gains)
    yield from (f"/* {said} */", '#include "flight_law_tables.h"', "")
    yield from _array("const law_real law_gain_time_s[LAW_GAIN_BREAKS]", np.asarray(gains.breaks))
    yield from _array("const law_real law_gain[LAW_GAIN_BREAKS - 1][4][2 * LAW_GAINS]", np.asarray(gains.coefficients))
    if gyros := further_gyros(packed.parameters[0].computer):
        blend = packed.parameters[0].computer.sensors.blend
        yield from _array("const law_real law_blend[2][LAW_FURTHER_GYROS + 1]", blend[:, : gyros + 1])
    yield f"const int32_t law_sections[2] = {{{int(law.n_sections[0])}, {int(law.n_sections[1])}}};"
    assert law.sections.shape == (2, MAX_SECTIONS, 5)
    yield from _array("const law_real law_section[2][LAW_MOST_SECTIONS][5]", law.sections)


def _vectors(loaded: LoadedScenario, said: str) -> Iterator[str]:
    """test_vectors.h: what the law gets and gives in the first seconds, with all axes shaken."""
    rows = _samples(loaded)
    yield from (f"/* {said} */", "#ifndef TEST_VECTORS_H", "#define TEST_VECTORS_H", "")
    yield f"#define TEST_SAMPLES {len(rows['time_s'])}"
    for name, values in rows.items():
        kind = "int" if values.dtype.kind == "i" else "double"
        size = f"[{values.shape[1]}]" if values.ndim == 2 else ""
        yield from _array(f"static const {kind} test_{name}[TEST_SAMPLES]{size}", values)
    yield "#endif"


def _array(declared: str, values: np.ndarray) -> Iterator[str]:
    """A C array; a double is written with the digits that give it back, and read as a float where that is the type."""
    yield f"{declared} = {{"
    for row in values:
        yield f"    {_braced(row.tolist())},"
    yield "};"
    yield ""


def _braced(value: Any) -> str:
    return "{" + ", ".join(map(_braced, value)) + "}" if isinstance(value, list) else repr(value)


def _samples(loaded: LoadedScenario) -> dict[str, np.ndarray]:
    """Inputs and outputs of the law in a flight of `TEST_SAMPLES`, read from the computer's memory at each."""
    scenario = loaded.scenario
    assert scenario.vehicle.computer is not None
    own = scenario.vehicle.computer.model_copy(
        update={"law": "design", "library": None, "python": None, "address": None}
    )
    shaken = tuple(
        Injection.model_validate(_SHAKEN | {"axis": axis, "frequency_hz": hz})
        for axis, hz in (("pitch", 0.7), ("yaw", 1.1), ("roll", 0.4))
    )
    sample_s = own.sample_s
    run = scenario.run.model_copy(
        update={
            "duration_s": round((TEST_SAMPLES + 2) * sample_s, 9),
            "step_s": min(scenario.run.step_s, sample_s),
            "stop_at": (),
        }
    )
    vehicle = scenario.vehicle.model_copy(update={"computer": own})
    changed = scenario.model_copy(update={"vehicle": vehicle, "run": run, "injection": shaken, "requirement": ()})
    flight = FlightRun(LoadedScenario(changed, loaded.label, ()), log=False, segment_ns=round(1e9 * sample_s))
    rows: dict[str, list[Any]] = {}
    at = int(flight.packed.parameters[0].computer.sensors.accelerometer)
    flight.fly_segment()  # the sample at an instant is taken when the flight goes on from it
    while not flight.finished and len(rows.get("time_s", ())) < TEST_SAMPLES:
        at_ns = int(flight.memory.clock.now_ns)
        flight.fly_segment()
        state = flight.memory.computer
        for name, value in (
            ("time_s", 1e-9 * at_ns),
            ("counts", state.converter.counts.tolist()),
            ("delta_angle_rad", state.converter.increment_rad.tolist()),
            ("commanded_angle_rad", state.guidance.angle_rad.tolist()),
            ("attitude_error_rad", state.attitude.error_rad.tolist()),
            ("further_rate_radps", state.sensors.value[: MAX_SENSORS - 1].ravel().tolist()),
            ("delta_velocity_mps", state.sensors.delta[at].tolist()),
            ("requested_rad", state.requested_rad.tolist()),
            ("command_rad", state.command_rad.tolist()),
            ("roll_thruster", int(state.roll.demand)),
        ):
            rows.setdefault(name, []).append(value)
    return {name: np.array(values) for name, values in rows.items()}


# matrices at the nodes


def described(node: Node, design: Any) -> dict[str, Any]:
    """Plant (continuous), path from gimbal command to measurements, law and open loop (all sampled) at a node."""
    loop = api.close(api.fixed_path(node, "sampled"), design)
    systems = {
        "plant": (node.plant, 0.0),
        "path": (loop.fixed.measured(loop.law.inputs), loop.sample_s),
        "law": (loop.law.state_space(), loop.sample_s),
        "loop": (loop.state_space(), loop.sample_s),
    }
    return {"time_s": node.time_s, "axis": node.plane} | {
        name: _system(found, sample_s or 0.0) for name, (found, sample_s) in systems.items()
    }


def _system(system: StateSpace, sample_s: float) -> dict[str, Any]:
    out: dict[str, Any] = {"A": system.a, "B": system.b, "C": system.c, "D": system.d, "sample_time_s": sample_s}
    for kind, names in (("state", system.states), ("input", system.inputs), ("output", system.outputs)):
        out[f"{kind}_names"], out[f"{kind}_units"] = list(names), [unit_of(name) for name in names]
    return out


def unit_of(name: str) -> str:
    """Unit in a name such as `theta_rad`; empty for a number without one, and for the state of a filter."""
    return _UNITS.get(name.rpartition("_")[2], "") if "_" in name else ""


def write_matrices(path: Path, form: Format, nodes: Sequence[dict[str, Any]]) -> None:
    """In a file for MATLAB (struct array `nodes`), NumPy (`plant_0_A`, ... beside a JSON text `about`), or as JSON."""
    if form == "json":
        write_whole(path, json.dumps({"nodes": list(nodes)}, default=np.ndarray.tolist, indent=1) + "\n")
        return
    with whole_file(path) as part:
        if form == "npz":
            with part.open("wb") as file:  # given a path, NumPy adds its own suffix
                np.savez(file, allow_pickle=False, **_flat(nodes))
        else:
            from scipy.io import savemat  # noqa: PLC0415  # lazy: 0.1 s

            said = {"nodes": [_for_matlab(node) for node in nodes]}
            savemat(part, said, appendmat=False, long_field_names=True, oned_as="column")


def _for_matlab(value: Any) -> Any:
    """Names as cell arrays, dictionaries as structs."""
    if isinstance(value, dict):
        return {key: _for_matlab(item) for key, item in value.items()}
    return np.array(value, object) if isinstance(value, list) else value


def _flat(nodes: Sequence[dict[str, Any]]) -> dict[str, np.ndarray]:
    out: dict[str, np.ndarray] = {}
    about = []
    for n, node in enumerate(nodes):
        about.append({"time_s": node["time_s"], "axis": node["axis"]})
        for name, system in node.items():
            if isinstance(system, dict):
                out |= {f"{name}_{n}_{part}": system[part] for part in "ABCD"}
                about[-1][name] = {key: item for key, item in system.items() if key not in "ABCD"}
    return out | {"about": np.array(json.dumps(about))}
