"""The subcommand `simdesign export DESIGN`: the law as C99 sources (`--c DIR`), or the plant, law and loop at the
operating points as matrices.

The sources in control/flight_law are copied unchanged. Only the tables, and the samples of the unit test from a flight,
depend on the design. Hence the compiled code is the code that the tests compile, with the flown numbers.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from maxq.control.attitude import QUATERNION
from maxq.control.external import HEADER
from maxq.control.kernel.limits import MAX_SENSORS
from maxq.control.kernel.tables import table_in
from maxq.control.structures import DRIFT, INTEGRAL, LAWS, MAX_SECTIONS, RELIEF, Law
from maxq.design import operating_points
from maxq.design.laws.design_file import design_path
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop, close_loop
from maxq.design.model.instruments import Plane
from maxq.design.model.state_space import StateSpace
from maxq.design.verify.memory import content_hash
from maxq.sim.files import FileError, cannot_write, check_writable, whole_file, write_whole
from maxq.sim.flight.channels import unit_suffix
from maxq.sim.input.errors import ScenarioError
from maxq.sim.log.head import maxq_version
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_scenario import Injection
from maxq.tools.cli.frame import Exit
from maxq.tools.cli.terminal import tell
from maxq.tools.design.analyse import load

Format = Literal["mat", "npz", "json"]
FORMATS = get_args(Format)
SOURCES = ("flight_law.h", "flight_law.c", "flight_law_fsw.c", "test_flight_law.c", "CMakeLists.txt")
TEST_SAMPLES = 600
EXPORTED_LAWS = tuple(law for law in get_args(Law) if law != "own")
_SHAKEN = {"at": "rate_command", "kind": "sine", "amplitude_degps": 2.0}
_UNITS = {unit_suffix(unit): unit for unit in ("rad/s^2", "rad/s", "rad", "m/s^2", "m/s", "m", "s", "N", "N m")}


def execute(
    design: str,
    *,
    c: str | None = None,
    form: Format = "mat",
    scenario: str = "nominal",
    vehicle: str | None = None,
    times_s: tuple[float, ...] = (),
    axis: Plane | None = None,
    out: str | None = None,
) -> int:
    """Write the law as C sources, or the loop as matrices. Return the exit code.

    The arguments are the options of `simdesign export`.
    """
    if c is not None:
        changes = [f'design="{design_path(design)}"']
        changes += [f'vehicle="{vehicle}"'] if vehicle is not None else []
        files = export_c(load_scenario(scenario, changes), Path(c))
        steps = ("cmake -S {0} -B {0}/build", "cmake --build {0}/build", "ctest --test-dir {0}/build")
        tell(f"{len(files)} files in {c}/; build and test them with", *(f"  {s.format(c)}" for s in steps))
        return Exit.OK
    path = Path(out or f"{Path(design).stem}.{form}")
    check_writable(path.parent)
    loaded, gains = load(scenario, vehicle, design)
    planes: tuple[Plane, ...] = (axis,) if axis is not None else ("pitch", "yaw")
    nodes = [node for plane in planes for node in operating_points.nodes(loaded, times_s or None, plane=plane)]
    write_matrices(path, form, [described(close_loop(fixed_path(node, "sampled"), gains)) for node in nodes])
    tell(f"{len(nodes)} operating points in {path}")
    return Exit.OK


# The law in C


def export_c(loaded: LoadedScenario, folder: Path) -> list[Path]:
    """Write the C sources of the law that `loaded` flies, its tables and its unit test to a folder. Return the paths.

    Existing files of these names are replaced. Raises ScenarioError if the scenario has no design or its law cannot be
    exported, and FileError.
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
    """Return the number of rate gyros, beyond the first, that contribute to the law's rate."""
    used = np.flatnonzero(np.any(computer.sensors.blend[:, 1:] != 0.0, axis=0))
    return int(used[-1]) + 1 if len(used) else 0


def _declared(packed: Packed, said: str) -> Iterator[str]:
    """Yield the lines of flight_law_tables.h.

    A compiler's option may set COUNT_RAD to 0, for code whose angles are not whole pulses.
    """
    each = [row.computer for row in packed.parameters]
    law = LAWS[int(each[0].law.kind)]
    relief = RELIEF.index(law) + 1 if law in RELIEF else 0
    first, filters = each[0], int(any(int(one.loops.on) or int(one.loops.fade_ticks) for one in each))
    moving = max(int(one.law.pd.moving.table.n_columns) for one in each)
    turns = int(any(int(one.burns.turns) for one in each))
    numbers = (
        ("STAGES", len(packed.parameters), ""),
        ("COUNT_RAD", float(first.converter.count_rad), "angle per gyro pulse; 0: angles are given"),
        ("RATE_INTEGRAL", int(int(first.attitude) != QUATERNION), "1: the error is the angle less the commanded angle"),
        ("GAINS", table_in(packed.pool, first.law.pd.gains).n_columns // 2, "of an axis"),
        ("LOAD_RELIEF", relief, "1: the third gain is of the acceleration; 2: of the angle of attack"),
        ("INTEGRAL", int(law in INTEGRAL), "1: the third gain is of the integral"),
        ("DRIFT", int(law in DRIFT), "1: the last two gains are of drift velocity and displacement"),
        ("LOOP_FILTERS", filters, "1: loops have filters of their own, or filters fade out behind a separation"),
        ("MOVING_FILTER", int(moving > 0), "1: a bending filter changes over the flight"),
        ("FILTER_PARAMETERS", max(moving, 1), "of such a filter: frequencies, Hz, and damping ratios"),
        ("ADAPTIVE", int(any(int(one.adaptive.on) for one in each)), "1: a total gain adapts"),
        ("TURN_THRUSTERS", turns, "1: thrusters fire in pitch and yaw in a coast"),
        ("FURTHER_GYROS", max(map(further_gyros, each)), "rate gyros beyond the first in the rate"),
    )
    yield from (f"/* {said} */", "#ifndef FLIGHT_LAW_TABLES_H", "#define FLIGHT_LAW_TABLES_H", "")
    yield from ('#include "flight_law.h"', "")
    for name, value, meaning in numbers:
        line = f"#define LAW_{name} {value!r}" + (f" /* {meaning} */" if meaning else "")
        yield from (f"#ifndef LAW_{name}", line, "#endif") if name == "COUNT_RAD" else (line,)
    yield from ("", "typedef struct {", *(f"    {field}" for field in _STAGE_FIELDS), "} law_stage;", "")
    yield from ("extern const law_stage law_stages[LAW_STAGES];", "", "#endif")


_STAGE_FIELDS = (
    "int64_t sample_ns;            /* period of the samples */",
    "law_real sample_s;",
    "int32_t takes_over;           /* 1: has a law or timing of its own, which starts at the separation */",
    "law_real angle_error_limit_rad;",
    "law_real command_limit_rad;",
    "law_real dac_step_rad;        /* of the output converter; 0: none */",
    "law_real integral_limit_rad;  /* of the integral's share */",
    "law_real accel_share;         /* by which a sample takes the acceleration's lag along */",
    "int32_t roll_thrusters;       /* 1: the law fires thrusters */",
    "int32_t roll_shortest_ticks;  /* samples of a firing */",
    "int32_t turn_thrusters;       /* 1: the stage has thrusters in pitch and yaw, for coasts */",
    "law_real roll_k_rate_s;       /* switching line: error + this times rate */",
    "law_real roll_dead_band_rad;",
    "law_real roll_hysteresis_rad;",
    "law_real roll_gimbal_k_p;     /* roll by groups of engines */",
    "law_real roll_gimbal_k_d_s;",
    "law_real roll_gimbal_limit_rad;",
    "int32_t over;                 /* gains over 0: time_s, 1: speed_mps, 2: mass_kg, 3: dynamic_pressure_Pa */",
    "int32_t gain_breaks;",
    "const law_real *gain_at;      /* [gain_breaks] */",
    "const law_real (*gain)[4][2 * LAW_GAINS]; /* per interval: coefficients of powers 0 to 3, pitch, then yaw */",
    "law_real blend[2][LAW_FURTHER_GYROS + 1]; /* weights of the gyros in pitch and yaw */",
    "int32_t adaptive;             /* 1: the total gain adapts: least + k_a, k_a from 0 to span */",
    "law_real adaptive_least;",
    "law_real adaptive_span;",
    "law_real adaptive_error_gain;  /* 1/(rad2 s) */",
    "law_real adaptive_damper_gain; /* 1/(rad2 s) */",
    "law_real adaptive_leakage_ps;",
    "law_real adaptive_low_pass_share;",
    "law_real adaptive_reference[2][3]; /* error and rate of the model by those before and the commanded rate */",
    "law_real adaptive_high_pass[5];    /* as a section of the bending filter */",
    "int32_t sections[2];          /* of the bending filter, in pitch and yaw */",
    "law_real section[2][LAW_MOST_SECTIONS][5]; /* b0, b1, b2, a1, a2 with a0 = 1 */",
    "int32_t filter_breaks;        /* points of a bending filter that changes, over what the gains are; 0: none */",
    "int32_t filter_quadratic;     /* its sections */",
    "int32_t filter_first_order;",
    "law_real filter_g_per_hz;     /* 2 pi / c of s = c (z - 1)/(z + 1) */",
    "const law_real *filter_at;    /* [filter_breaks] */",
    "const law_real (*filter_table)[2][LAW_FILTER_PARAMETERS]; /* per interval: values and slopes */",
    "int32_t loop_filters;         /* 1: filters of attitude error, rate or acceleration */",
    "int32_t fade_ticks;           /* samples over which the filters of the stage before fade out */",
    "int32_t loop_sections[3];",
    "law_real loop_section[3][LAW_MOST_SECTIONS][5];",
)
_ENDLESS = 1.0e9  # replaces an infinite limit


def _defined(packed: Packed, said: str) -> Iterator[str]:
    """Yield the lines of flight_law_tables.c."""
    yield from (f"/* {said} */", '#include "flight_law_tables.h"', "")
    gyros = max(further_gyros(row.computer) for row in packed.parameters)
    parameters = max(1, *(int(row.computer.law.pd.moving.table.n_columns) for row in packed.parameters))
    stages = []
    for n, row in enumerate(packed.parameters):
        computer, roll, allocation = row.computer, row.computer.roll, row.computer.allocation
        gains = table_in(packed.pool, computer.law.pd.gains)
        breaks = len(gains.breaks)
        yield from _array(f"static const law_real gain_at_{n}[{breaks}]", np.asarray(gains.breaks))
        yield from _array(
            f"static const law_real gain_{n}[{breaks - 1}][4][2 * LAW_GAINS]", np.asarray(gains.coefficients)
        )
        moving = computer.law.pd.moving
        points, names = int(moving.table.n_breaks), ("0", "0")
        if points > 0:
            schedule, names = table_in(packed.pool, moving.table), (f"filter_at_{n}", f"filter_{n}")
            lines = np.zeros((points - 1, 2, parameters))
            lines[:, :, : schedule.n_columns] = schedule.coefficients[:, :2]
            yield from _array(f"static const law_real {names[0]}[{points}]", np.asarray(schedule.breaks))
            yield from _array(f"static const law_real {names[1]}[{points - 1}][2][LAW_FILTER_PARAMETERS]", lines)
        by_gimbals, adaptive = int(allocation.groups) > 1, computer.adaptive
        adapts = ("least", "span", "error_gain", "damper_gain", "leakage_ps", "low_pass_share")
        assert computer.law.pd.sections.shape == (2, MAX_SECTIONS, 5)
        values = (
            int(computer.sample_ns),
            int(computer.sample_ns) / 1.0e9,
            int(computer.takes_over),
            *(
                min(float(limit), _ENDLESS)
                for limit in (computer.angle_error_limit_rad, computer.command_limit_rad, computer.dac_step_rad)
            ),
            min(float(computer.law.pid.limit_rad), _ENDLESS),
            float(computer.law.relief.share),
            int(computer.roll_on),
            int(roll.minimum_on_ticks),
            int(computer.burns.turns),
            *(float(getattr(roll, name)) for name in ("k_rate_s", "dead_band_rad", "hysteresis_rad")),
            *(float(getattr(allocation, k)) if by_gimbals else 0.0 for k in ("k_p", "k_d_s", "roll_limit_rad")),
            int(computer.over),
            breaks,
            f"gain_at_{n}",
            f"gain_{n}",
            computer.sensors.blend[:, : gyros + 1].tolist(),
            int(adaptive.on),
            *(float(adaptive[name]) for name in adapts),
            adaptive.reference.tolist(),
            adaptive.high_pass[0].tolist(),
            computer.law.pd.n_sections.tolist(),
            computer.law.pd.sections.tolist(),
            points,
            int(moving.n_quadratic),
            int(moving.n_first_order),
            float(moving.g_per_hz),
            *names,
            int(computer.loops.on),
            int(computer.loops.fade_ticks),
            computer.loops.n_sections.tolist(),
            computer.loops.sections.tolist(),
        )
        stages.append(values)
    yield "const law_stage law_stages[LAW_STAGES] = {"
    for values in stages:
        yield from ("    {", *(f"        {_braced(value)}," for value in values), "    },")
    yield "};"


def _vectors(loaded: LoadedScenario, said: str) -> Iterator[str]:
    """Yield the lines of test_vectors.h: inputs and outputs of the law in the first seconds, with all axes excited."""
    rows = _samples(loaded)
    yield from (f"/* {said} */", "#ifndef TEST_VECTORS_H", "#define TEST_VECTORS_H", "")
    yield f"#define TEST_SAMPLES {len(rows['time_s'])}"
    for name, values in rows.items():
        kind = "int" if values.dtype.kind == "i" else "double"
        size = f"[{values.shape[1]}]" if values.ndim == 2 else ""
        yield from _array(f"static const {kind} test_{name}[TEST_SAMPLES]{size}", values)
    yield "#endif"


def _array(declared: str, values: np.ndarray) -> Iterator[str]:
    """Yield the lines of a C array. Its doubles have enough digits to be read back exactly."""
    yield f"{declared} = {{"
    for row in values:
        yield f"    {_braced(row.tolist())},"
    yield "};"
    yield ""


def _braced(value: Any) -> str:
    if isinstance(value, list):
        return "{" + ", ".join(map(_braced, value)) + "}"
    return value if isinstance(value, str) else repr(value)


def _samples(loaded: LoadedScenario) -> dict[str, np.ndarray]:
    """Return the inputs and outputs of the law at each sample of a flight of `TEST_SAMPLES` samples, from its
    memory.
    """
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
    flight.fly_segment()  # the sample at an instant is taken when the flight continues from it
    while not flight.finished and len(rows.get("time_s", ())) < TEST_SAMPLES:
        at_ns = int(flight.memory.clock.now_ns)
        flight.fly_segment()
        state = flight.memory.computer
        for name, value in (
            ("time_s", 1e-9 * at_ns),
            ("navigation", state.navigation.tolist()),
            ("counts", state.converter.counts.tolist()),
            ("delta_angle_rad", state.converter.increment_rad.tolist()),
            ("commanded_angle_rad", state.guidance.angle_rad.tolist()),
            ("commanded_rate_radps", state.guidance.rate_radps.tolist()),
            ("attitude_error_rad", state.attitude.error_rad.tolist()),
            ("further_rate_radps", state.sensors.value[: MAX_SENSORS - 1].ravel().tolist()),
            ("delta_velocity_mps", state.sensors.delta[at].tolist()),
            ("requested_rad", state.requested_rad.tolist()),
            ("command_rad", state.command_rad.tolist()),
            ("roll_thruster", int(state.roll.demand)),
        ):
            rows.setdefault(name, []).append(value)
    return {name: np.array(values) for name, values in rows.items()}


# Matrices at the operating points


def described(loop: Loop) -> dict[str, Any]:
    """Return the systems of a loop: the continuous plant, and the path, law and open loop, sampled or continuous.

    The path is from the gimbal command to the law's measurements. A loop of the kind `exact` has no path and no open
    loop as matrices.
    """
    node, sample_s = loop.fixed.node, loop.sample_s or 0.0
    systems = {"plant": (node.plant, 0.0), "law": (loop.law.state_space(), sample_s)}
    if loop.fixed.kind != "exact":
        systems |= {"path": (loop.fixed.measured(loop.law.inputs), sample_s), "loop": (loop.state_space(), sample_s)}
    return {"time_s": node.time_s, "axis": node.plane, "kind": loop.fixed.kind} | {
        name: _system(*systems[name]) for name in ("plant", "path", "law", "loop") if name in systems
    }


def _system(system: StateSpace, sample_s: float) -> dict[str, Any]:
    out: dict[str, Any] = {"A": system.a, "B": system.b, "C": system.c, "D": system.d, "sample_time_s": sample_s}
    for kind, names in (("state", system.states), ("input", system.inputs), ("output", system.outputs)):
        out[f"{kind}_names"], out[f"{kind}_units"] = list(names), [unit_of(name) for name in names]
    return out


def unit_of(name: str) -> str:
    """Return the unit at the end of a name such as `theta_rad`, or "" without a unit, as for the state of a filter."""
    return _UNITS.get(name.rpartition("_")[2], "") if "_" in name else ""


def write_matrices(path: Path, form: Format, nodes: Sequence[dict[str, Any]]) -> None:
    """Write the matrices to a file for MATLAB, for NumPy, or as JSON.

    A MATLAB file contains a struct array `nodes`; a NumPy file contains `plant_0_A`, ..., and a JSON text `about`.
    """
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
    """Return a value for savemat, with lists of names as cell arrays and dictionaries as structs."""
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
