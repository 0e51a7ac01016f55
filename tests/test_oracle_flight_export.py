"""The exported law equals the flown one bit for bit, and exported matrices agree with python-control.

| item | against |
|---|---|
| C sources, double: unit test, commands of whole ascents | the built-in law, equal bits |
| C sources, float | the built-in law, within the effect of a gyro pulse |
| matrices: frequency response of the loop, its parts in series | the loop of `simdesign`, python-control |
"""

from __future__ import annotations

import ctypes
import json
import re
import shutil
import subprocess
import tomllib
from pathlib import Path

import control
import numpy as np
import petrelkit
import pytest
from flight_code import COMPILER, STRICT, flies, needs_compiler
from scipy.io import loadmat

import maxq
from maxq import Flight, margins
from maxq.control.kernel.records import blank
from maxq.control.roll import RollState, silence_roll, update_roll
from maxq.control.structures import LAWS
from maxq.sim.campaign.runs import fly_rows
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simdesign
from maxq.tools.design.export import _STAGE_FIELDS, export_c

POWERED = ["run.duration_s=59", "requirement="]
COMMANDS = ("gimbal_pitch_command_deg", "gimbal_yaw_command_deg")
ODD = """
schema = 2
name = "odd"
[gains]
table = [{time_s=2.0, k_p=1.1, k_d_s=0.47}, {time_s=20.0, k_p=0.9, k_d_s=0.45}, {time_s=50.0, k_p=0.7, k_d_s=0.37}]
yaw_table = [{time_s=5.0, k_p=1.0, k_d_s=0.48}, {time_s=55.0, k_p=0.75, k_d_s=0.36}]
[filter]
structure = "sections"
quadratic = [
    {zero_hz=28.48, zero_zeta=0.315, pole_hz=13.7, pole_zeta=1.2},
    {zero_hz=3.77, zero_zeta=1.2, pole_hz=5.73, pole_zeta=0.3},
]
first_order = [{zero_hz=9.0, pole_hz=9.5}, {zero_hz=8.0, pole_hz=8.2}, {zero_hz=30.0, pole_hz=33.0}]
discretization = "bilinear"
"""
BARE = """
schema = 2
name = "bare"
[gains]
table = [{time_s=5.0, k_p=1.1, k_d_s=0.47}]
yaw = "pitch"
"""

PID = """
schema = 2
name = "pid"
law = "pid"
[gains]
table = [{time_s=5.0, k_p=1.1, k_d_s=0.47, k_i_ps=0.3}, {time_s=50.0, k_p=0.7, k_d_s=0.37, k_i_ps=0.1}]
integral_limit_deg = 0.3
[adaptive]
reference_hz = 0.4
error_gain_pdeg2s = 0.2
damper_gain_pdeg2s = 300.0
high_pass_hz = 2.0
"""
OVER = """
schema = 2
[gains]
table = [
    {dynamic_pressure_Pa=100.0, k_p=1.1, k_d_s=0.47}, {dynamic_pressure_Pa=20000.0, k_p=0.9, k_d_s=0.4},
    {dynamic_pressure_Pa=60000.0, k_p=0.7, k_d_s=0.37},
]
"""
RELIEF = """
schema = 2
name = "relief"
law = "load-relief"
[gains]
table = [{time_s=5.0, k_p=1.1, k_d_s=0.47, k_a_s2pm=0.004}, {time_s=50.0, k_p=0.7, k_d_s=0.37, k_a_s2pm=0.01}]
[load_relief]
corner_hz = 1.3
[blend]
pitch = [0.7, 0.3]
yaw = [0.6, 0.4]
"""


INCIDENCE = """
schema = 2
name = "relief by angle of attack"
law = "incidence-relief"
[gains]
table = [
    {time_s=5.0, k_p=1.1, k_d_s=0.47, k_alpha=0.2, percussion_m=4.0, accel_per_incidence_mps2=-20.0},
    {time_s=50.0, k_p=0.7, k_d_s=0.37, k_alpha=0.4, percussion_m=5.0, accel_per_incidence_mps2=-60.0},
]
[load_relief]
corner_hz = 1.3
[blend]
pitch = [0.7, 0.3]
[loop_filters.attitude]
structure = "F2"
quadratic = [{zero_hz=12.0, zero_zeta=0.3, pole_hz=9.0, pole_zeta=0.7}]
prewarp_hz = 9.0
[loop_filters.acceleration]
structure = "sections"
first_order = [{zero_hz=20.0, pole_hz=5.0}]
discretization = "matched"
"""
DRIFT = """
schema = 2
name = "drift with an integral"
law = "pid-drift"
[gains]
table = [
    {time_s=5.0, k_p=1.1, k_d_s=0.47, k_i_ps=0.1, k_zd_radspm=0.001, k_z_radpm=1e-4},
    {time_s=50.0, k_p=0.7, k_d_s=0.37, k_i_ps=0.2, k_zd_radspm=0.002, k_z_radpm=2e-4},
]
"""
DRIFT_ALONE = DRIFT.replace("with an integral", "alone").replace("pid-drift", "drift").replace(" k_i_ps=0.1,", "")
DRIFT_ALONE = DRIFT_ALONE.replace(" k_i_ps=0.2,", "")
LOOPS = """
[loop_filters.rate]
structure = "F2"
quadratic = [{zero_hz=12.0, zero_zeta=0.3, pole_hz=9.0, pole_zeta=0.7}]
prewarp_hz = 9.0
"""


def built(folder: Path, design: str, *more: str, single: bool = False) -> Path:
    """Return the exported law as a library after its unit test passes. Warnings are errors."""
    assert simdesign.main(["export", design, "--c", str(folder / "law"), *more]) == 0
    flags = [*STRICT, *(["-DLAW_FLOAT"] if single else [])]
    sources = [folder / "law" / name for name in ("flight_law.c", "flight_law_tables.c")]
    for what, also in (("test", ["test_flight_law.c"]), ("lib", ["flight_law_fsw.c", "-shared", "-fPIC"])):
        own = [str(folder / "law" / also[0]), *also[1:]]
        made = subprocess.run(
            [str(COMPILER), *flags, "-o", str(folder / what), *map(str, sources), *own],
            capture_output=True,
            text=True,
            check=False,
        )
        assert made.returncode == 0, made.stderr
    said = subprocess.run([folder / "test"], capture_output=True, text=True, check=False)
    assert (said.returncode, said.stdout) == (0, "600 samples, 0 differences\n")
    return folder / "lib"


def moving(constant: re.Match[str]) -> str:
    """Return a schedule of the filter sections in which each zero frequency rises by the factor 1.3 until burnout."""
    later = re.sub(r"zero_hz = ([\d.]+)", lambda zero: f"zero_hz = {1.3 * float(zero[1])}", constant[1])
    return f"schedule = [{{ time_s = 5.0, quadratic = {constant[1]} }}, {{ time_s = 121.0, quadratic = {later} }}]"


def assert_same_commands(own: Flight, built_in: Flight) -> None:
    """Check that each command and the state are bit-identical; the C code's output converter equals the simulator's."""
    for command, monitor in zip(COMMANDS, ("monitor_1", "monitor_2"), strict=True):
        assert (own[command] == built_in[command]).all()
        late = np.radians(own[command][13::10])  # the command takes effect 3 ms after its sample
        assert np.abs(late - own[monitor][13::10]).max() < 1e-15
    assert own.state_hash == built_in.state_hash


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", ["robust", "odd", "bare", "pid", "over"])
def test_the_c_sources_give_the_commands_of_the_flown_law(tmp_path: Path, name: str) -> None:
    design = "ksr3-robust"
    if name != "robust":
        (tmp_path / "d.toml").write_text({"odd": ODD, "bare": BARE, "pid": PID, "over": OVER}[name])
        design = str(tmp_path / "d.toml")
    changes = [] if name == "robust" else [f"design={design}"]
    changes += ["vehicle.computer.count_rad=0.0"] if name == "odd" else []
    library = built(tmp_path, design) if name != "odd" else built(tmp_path, design, "--vehicle", _unquantised(tmp_path))
    built_in = fly(load_scenario("nominal", [*POWERED, *changes]))
    own = fly(load_scenario("nominal", [*POWERED, *changes, *flies(library=library)]))
    assert_same_commands(own, built_in)


@needs_compiler
@pytest.mark.slow  # four flights
@pytest.mark.parametrize(
    ("law", "share"),
    [
        (RELIEF, "relief_pitch_deg"),
        (INCIDENCE, "relief_pitch_deg"),
        (DRIFT, "drift_share_pitch_deg"),
        (DRIFT_ALONE, "drift_share_pitch_deg"),
    ],
    ids=["acceleration", "incidence", "drift with an integral", "drift"],
)
def test_laws_with_an_accelerometer_and_blended_gyros_give_the_same_bits(tmp_path: Path, law: str, share: str) -> None:
    design = tmp_path / "d.toml"
    design.write_text(law)
    library = built(tmp_path, str(design), "--scenario", "load-relief")
    changes = [f"design={design}", "run.duration_s=20", "requirement=", "wind.speed_mps=8.0", "wind.from_deg=200"]
    built_in = fly(load_scenario("load-relief", changes))
    own = fly(load_scenario("load-relief", [*changes, *flies(library=library)]))
    assert_same_commands(own, built_in)
    assert np.abs(built_in[share]).max() > 0.05


def test_every_law_that_flies_is_exported_in_a_test() -> None:
    texts = (ODD, BARE, PID, OVER, RELIEF, INCIDENCE, DRIFT, DRIFT_ALONE)
    assert {tomllib.loads(text).get("law", "pd") for text in texts} == set(LAWS) - {"own"}  # whose file is its code


class LawInputs(ctypes.Structure):
    """The struct law_inputs of flight_law.h."""

    _fields_ = [
        *((name, ctypes.c_double) for name in ("time_s", "speed_mps", "mass_kg", "dynamic_pressure_Pa")),
        *((name, ctypes.c_int32) for name in ("stage", "coasting")),
        ("counts", ctypes.c_int64 * 3),
        *(
            (name, ctypes.c_double * 3)
            for name in ("delta_angle_rad", "commanded_angle_rad", "commanded_rate_radps", "attitude_error_rad")
        ),
        ("further_rate_radps", ctypes.c_double * 12),
        ("delta_velocity_mps", ctypes.c_double * 3),
    ]


class LawOutputs(ctypes.Structure):
    """The struct law_outputs of flight_law.h."""

    _fields_ = [
        *((name, ctypes.c_double * 2) for name in ("requested_rad", "command_rad")),
        ("converter", ctypes.c_int64 * 2),
        ("roll_gimbal_rad", ctypes.c_double),
        ("roll_thruster", ctypes.c_int32),
        ("turn_thruster", ctypes.c_int32 * 2),
    ]


@needs_compiler
def test_thrusters_in_pitch_and_yaw_fire_in_a_coast_as_the_built_in_ones(tmp_path: Path) -> None:
    """Compare with the kernel of the flight computer over random rates in coasts and burns (`fire_in_coast`)."""
    loaded = load_scenario("nominal", ["vehicle.computer.count_rad=0.0"])
    export_c(loaded, tmp_path)
    tables = tmp_path / "flight_law_tables.c"
    head, rows = tables.read_text().split("const law_stage law_stages[LAW_STAGES] = {\n    {\n")
    lines = rows.splitlines()
    at = next(k for k, field in enumerate(_STAGE_FIELDS) if "turn_thrusters" in field)
    assert lines[at].strip() == "0,"
    lines[at] = "1,"
    tables.write_text(head + "const law_stage law_stages[LAW_STAGES] = {\n    {\n" + "\n".join(lines) + "\n")
    header = tmp_path / "flight_law_tables.h"
    header.write_text(header.read_text().replace("LAW_TURN_THRUSTERS 0", "LAW_TURN_THRUSTERS 1"))
    words = [str(COMPILER), *STRICT, "-shared", "-fPIC", "-o", str(tmp_path / "law.so")]
    subprocess.run([*words, str(tables), str(tmp_path / "flight_law.c")], check=True)
    law = ctypes.CDLL(str(tmp_path / "law.so"))
    state, out, given = ctypes.create_string_buffer(1 << 14), LawOutputs(), LawInputs(stage=0)
    law.law_start(state)
    computer = pack_flight(loaded.scenario).parameters[0].computer
    limit_rad = computer.angle_error_limit_rad
    fired = [blank(RollState)[0] for _ in range(2)]
    angle, seen = np.zeros(3), set()
    steps = np.random.default_rng(7).normal(scale=0.01, size=(4000, 3))
    for n, step in enumerate(steps):
        given.coasting = int(n % 1000 < 700)
        rates = 0.1 * np.cos(2.0 * np.pi * n / np.array([300.0, 400.0, 500.0])) + step
        given.delta_angle_rad[:] = (0.01 * rates).tolist()
        given.commanded_rate_radps[:] = [0.0, 1e-3, -2e-3]
        angle = angle + 0.01 * rates
        law.law_step(state, ctypes.byref(given), ctypes.byref(out))
        for k in range(2):
            if given.coasting:
                slip_radps = given.delta_angle_rad[1 + k] / 0.01 - given.commanded_rate_radps[1 + k]
                error_rad = min(max(angle[1 + k], -limit_rad), limit_rad)
                update_roll(computer.roll, fired[k], error_rad, slip_radps)
            else:
                silence_roll(fired[k])
            assert out.turn_thruster[k] == fired[k].demand
            seen.add((k, fired[k].demand))
    assert len(seen) == 6
    assert min(one.firings for one in fired) > 5


def _unquantised(folder: Path) -> str:
    (folder / "vehicle.toml").write_text('extends = "vehicles/ksr3"\n[computer]\ncount_rad = 0.0\n')
    return str(folder / "vehicle.toml")


@pytest.mark.slow
@needs_compiler
def test_single_precision_stays_within_what_a_gyro_pulse_does(tmp_path: Path) -> None:
    """A command that rounds differently shifts later pulses; one more pulse in a sample is 0.057 deg/s."""
    library = built(tmp_path, "ksr3-robust", single=True)
    built_in = fly(load_scenario("nominal", POWERED))
    own = fly(load_scenario("nominal", [*POWERED, *flies(library=library)]))
    pulse_deg = np.degrees(1.0e-5) / 0.01 * 0.467
    farthest = max(float(np.abs(own[c] - built_in[c]).max()) for c in COMMANDS)
    assert 0.0 < farthest <= 2.0 * pulse_deg


@needs_compiler
@pytest.mark.skipif(shutil.which("cmake") is None, reason="there is no cmake on this machine")
def test_the_cmake_file_builds_and_tests(tmp_path: Path) -> None:
    assert simdesign.main(["export", "ksr3-robust", "--c", str(tmp_path)]) == 0
    for command in (["cmake", "-S", ".", "-B", "build"], ["cmake", "--build", "build"], ["build/test_flight_law"]):
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr


@needs_compiler
@pytest.mark.slow
def test_dispersed_flights_have_the_same_bits(tmp_path: Path) -> None:
    runs = 10
    library = built(tmp_path, "ksr3-robust")
    hashes = []
    for changes in ([], flies(library=library)):
        campaign = maxq.load(
            "campaigns/ksr3", "run.duration_s=70", "campaign.keep=[]", f"campaign.runs={runs}", *changes
        )
        drawn = campaign.plan.draw(0, runs)
        hashes.append([row.state_hash for row in fly_rows(campaign, [(drawn, run) for run in range(runs)])])
    assert hashes[0] == hashes[1]
    assert len(set(hashes[0])) == runs


@needs_compiler
@pytest.mark.slow
def test_a_vehicle_of_several_stages_and_groups(tmp_path: Path) -> None:
    """An exported law of three stages flies across both separations.

    Each stage has its own gains and filters, and the previous filters fade out. The first and third stage have a filter
    of the rate; the total gain adapts. The bending filter of the first stage changes during the flight.
    """
    folder = tmp_path / "petrel"
    shutil.copytree(petrelkit.folder(), folder)
    scenario, design = folder / "scenario.toml", folder / "design.toml"
    adaptive = "reference_hz = 0.4\nerror_gain_pdeg2s = 1.0\ndamper_gain_pdeg2s = 300.0\nhigh_pass_hz = 3.0\n"
    text = design.read_text()
    assert text.count("[[stage]]\n") == 3
    first, second, third, fourth = text.split("[[stage]]\n")
    first, changed = re.subn(r"quadratic = (\[.*?\n\])", moving, first, flags=re.DOTALL)
    assert changed == 1
    fading = (
        f"[[stage]]\n{second}[[stage]]\nfade_s = 0.3\nloop_filters = {{}}\n{third}[[stage]]\nfade_s = 2.0\n{fourth}"
    )
    design.write_text(f"{first}{fading}\n[adaptive]\n{adaptive}{LOOPS}")
    library = built(tmp_path, str(design), "--scenario", str(scenario))
    assert "#define LAW_MOVING_FILTER 1" in (tmp_path / "law" / "flight_law_tables.h").read_text()
    built_in, own = (
        fly(load_scenario(scenario, ["run.duration_s=190", "requirement=", *changes]), log=False)
        for changes in ([], flies(library=library))
    )
    assert own.state_hash == built_in.state_hash


@pytest.fixture(scope="module")
def matrices(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("matrices")
    for form in ("mat", "npz", "json"):
        words = ["export", "ksr3-robust", "--at", "30", "--at", "50", "--axis", "yaw", "--format", form]
        assert simdesign.main([*words, "--out", str(folder / f"loop.{form}")]) == 0
    return folder


@pytest.mark.slow
def test_exported_matrices_are_the_loop_for_python_control(matrices: Path) -> None:
    """The loop has the response that simdesign judges, and path and law in series equal the loop."""
    nodes = json.loads((matrices / "loop.json").read_text())["nodes"]
    hz = np.array([0.1, 0.5, 3.0, 9.5, 27.0])
    for node, time_s in zip(nodes, (30.0, 50.0), strict=True):
        assert (node["time_s"], node["axis"]) == (time_s, "yaw")
        system = {
            name: control.ss(*(np.array(node[name][m]) for m in "ABCD"), node[name]["sample_time_s"])
            for name in ("path", "law", "loop")
        }
        assert system["loop"].dt == 0.01
        expected = maxq.loop("nominal", None, time_s, plane="yaw").response(hz)
        found = np.array([system["loop"](np.exp(2j * np.pi * f * 0.01)) for f in hz])
        assert np.abs(found / expected - 1.0).max() < 1e-6
        row = system["law"] * system["path"]
        again = np.array([np.squeeze(row(np.exp(2j * np.pi * f * 0.01))) for f in hz])
        assert np.abs(again / found - 1.0).max() < 1e-6
        assert node["plant"]["sample_time_s"] == 0.0
        assert node["plant"]["state_units"][node["plant"]["state_names"].index("theta_rad")] == "rad"


def test_slicot_finds_the_least_distance_in_the_exported_matrices(matrices: Path) -> None:
    """SLICOT's AB13DD finds the H-infinity norm of 1 / (1 + L) over all frequencies from A, B, C, D alone."""
    pytest.importorskip("slycot")
    for node in json.loads((matrices / "loop.json").read_text())["nodes"]:
        loop = control.ss(*(np.array(node["loop"][m]) for m in "ABCD"), node["loop"]["sample_time_s"])
        peak, at_radps = control.linfnorm(control.feedback(1, loop))
        of_loop = margins(maxq.loop("nominal", None, node["time_s"], plane="yaw"))
        assert 1.0 / peak == pytest.approx(of_loop.modulus, rel=1e-6)
        assert abs(1.0 + loop(np.exp(0.01j * at_radps))) == pytest.approx(of_loop.modulus, rel=1e-5)


def test_all_formats_hold_the_same(matrices: Path) -> None:
    nodes = json.loads((matrices / "loop.json").read_text())["nodes"]
    of_numpy = np.load(matrices / "loop.npz", allow_pickle=False)
    of_matlab = loadmat(matrices / "loop.mat", simplify_cells=True)["nodes"]
    about = json.loads(str(of_numpy["about"]))
    for n, node in enumerate(nodes):
        for name in ("plant", "path", "law", "loop"):
            for part in "ABCD":
                expected = np.array(node[name][part])
                assert (of_numpy[f"{name}_{n}_{part}"] == expected).all()
                assert (np.reshape(of_matlab[n][name][part], expected.shape) == expected).all()
            assert list(np.atleast_1d(of_matlab[n][name]["input_names"])) == node[name]["input_names"]
            assert about[n][name]["output_units"] == node[name]["output_units"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "give --c or --format"),
        (["--c", "x", "--format", "mat"], "--c and --format exclude each other"),
        (["--c", "x", "--at", "3"], "--c and --at exclude each other"),
    ],
)
def test_wrong_words_are_told(capsys: pytest.CaptureFixture[str], words: list[str], said: str) -> None:
    with pytest.raises(SystemExit) as end:
        simdesign.main(["export", "ksr3-robust", *words])
    assert end.value.code == 2
    assert said in capsys.readouterr().err
