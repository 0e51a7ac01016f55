"""Broken input files of every kind load and pack, or give a one-line error that a user can act on.

The first part contains inputs that once ended in a traceback; the second searches for more (file_fuzzer.py).
"""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import petrelkit as petrel
import pytest
from file_fuzzer import BASES, FILES, KINDS, answer, broken, write_files
from hypothesis import HealthCheck, given, settings

import maxq
from maxq import ScenarioError
from maxq.design.case.schema import read_case
from maxq.design.laws.schedule import UnsolvableError, lowest_above
from maxq.design.verify.suite import read_suite
from maxq.sim.input.files import builtin_files
from maxq.sim.input.ranges import RANGES, range_of
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simdesign, simrun, simverify


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("maxq.tools.vehicle.build.MODE_ROWS", 2)  # of a layout's modes over time: quicker
    write_files(tmp_path)
    return tmp_path


def said_of(here: Path, kind: str, old: str, new: str) -> str:
    """Return the error message for a base file in which `new` replaces `old`."""
    assert old in BASES[kind]
    return answer(kind, here, FILES[kind], BASES[kind].replace(old, new, 1).encode())


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_the_files_are_right_before_they_are_broken(here: Path, kind: str) -> None:
    name = FILES.get(kind, "winds/west.csv")
    assert answer(kind, here, name, (here / name).read_bytes()) == ""


_LONG = "9" * 5000
_TANK = '[[stage.tank]]\n{}table = "tank.csv"\ndamping_ratio = 0.1\n'
_NO_PART = "cannot be part of a channel's name; allowed: at most 40 letters"
_BREAKS = [
    ("design", "zero_hz = 9.0", "zero_hz = 1e-300", "zero_hz = 1e-300: is out of range; allowed: magnitudes 1e-06 .."),
    ("design", "pole_hz = 7.0", "pole_hz = 1e300", "pole_hz = 1e+300: is too large"),
    ("design", "pole_zeta = 0.7", "pole_zeta = 5e-324", "pole_zeta = 5e-324: is out of range"),
    ("design", "pole_hz = 5.0", "pole_hz = 1e6", ""),
    ("design", "zero_hz = 30.0", "zero_hz = -1e-6", ""),
    ("design", "prewarp_hz = 9.2", 'discretization = "matched"', ""),
    ("design", "pole_zeta = 0.7}]", 'pole_zeta = 0.7}]\ndiscretization = "matched"', ""),
    (
        "design",
        "pole_hz = 7.0, pole_zeta = 0.7}]",
        'pole_hz = 90.0, pole_zeta = 0.7}]\ndiscretization = "matched"',
        'filter.structure = "F3": cannot be run every 0.01 s: a pole at 64.2729 Hz: '
        "allowed with discretization matched",
    ),
    ("design", "dead_band_deg = 1.0", "dead_band_deg = 1e-322", "is out of range"),
    ("vehicle", 'name = "lox"', 'name = ".."', f'stage.0.tank.0.name = "..": {_NO_PART}'),
    ("vehicle", 'name = "lox"', 'name = "../../etc/passwd"', _NO_PART),
    ("vehicle", 'name = "lox"', 'name = "a\\u0007b"', _NO_PART),
    ("vehicle", 'name = "lox"', 'name = "<script>alert(1)</script>"', _NO_PART),
    ("vehicle", 'name = "lox"', 'name = "é"', _NO_PART),
    ("vehicle", 'name = "lox"', f'name = "{"x" * 41}"', _NO_PART),
    (
        "vehicle",
        "[stage.bending]",
        _TANK.format('name = "lox"\n') + "[stage.bending]",
        'stage.0.tank.1.name = "lox": is already the name of another tank; allowed: each name once',
    ),
    (
        "vehicle",
        "[stage.bending]",
        _TANK.format('name = "3"\n') + _TANK.format("") + "[stage.bending]",
        'stage.0.tank.2.name = "3": is already the name of another tank',
    ),
    ("vehicle", "count_rad = 1.0e-5", "count_rad = 1e-300", "count_rad = 1e-300: is out of range; allowed: magn"),
    ("vehicle", "delay_s = 0.003", "delay_s = 1e10", "is longer than any flight"),
    ("vehicle", "angle_error_limit_deg = 20.0", "angle_error_limit_deg = 1e-320", "is out of range"),
    (
        "campaign",
        "where = {mode = 1}",
        "where = {mod = 1}",
        "disperse.1.where.mod = 1.0: the table has no such column; allowed: time_s, mode,",
    ),
    ("campaign", "runs = 20", f"seed = {2**63}\nruns = 20", f"seed = {2**63}: is out of range; allowed: a whole"),
    ("campaign", "runs = 20", f"runs = {2**52}", f"runs = {2**52}: is out of range; allowed: magnitudes up to 1e+09"),
    ("campaign", "runs = 20", f"stratum = {2**62}\nruns = 20", f"stratum = {2**62}: is out of range"),
    ("campaign", "low = 0.8", "low = 1.5", "disperse.1.low = 1.5: low is above high; allowed: at most 1.2"),
    ("campaign", "low = 0.8\nhigh = 1.2\n", "", "disperse.1.low: needs low, high or both"),
    ("campaign", "[1e-4, 9e-4]]", "[1e-4]]", "covariance = [[0.0004, 0.0001], [0.0001]]: is not a matrix of 2 by 2"),
    ("campaign", "runs = 20", "runs = 10000000", "stratum: required key is missing: one hypercube of 10000000"),
    ("campaign", 'values = ["hold", "error"]', f'values = ["hold", {10**400}]', "values.1 = 10000000"),
    ("scenario", "duration_s = 300.0", f"seed = {2**64}", f"run.seed = {2**64}: is out of range"),
    ("scenario", "duration_s = 300.0", f"duration_s = {2**64}", "is longer than any flight"),
    ("scenario", "duration_s = 300.0", f"duration_s = {_LONG}", "is not valid TOML: "),
    ("case", "starts = 2", f"seed = {2**64}", f"search.seed = {2**64}: is out of range; allowed: magn"),
    ("case", "starts = 2", f"seed = {_LONG}", "is not valid TOML: "),
    ("case", "nodes_s = [5.0, 30.0, 55.0]", "nodes_s = [5.0, 1e29]", "nodes_s.1 = 1e+29: is out of range"),
    ("suite", "times_s = [5.0, 30.0]", "times_s = [5.0, 1e29]", "margins.times_s.1 = 1e+29: is out of range"),
    ("suite", "times_s = [30.0]", "times_s = [1e300]", "certificate.times_s.0 = 1e+300: is too large"),
    ("suite", "cases = 10", f"seed = {2**64}", f"margins.seed = {2**64}: is out of range"),
    ("suite", "bending_frequency = [0.05, 0.1]", "bending_frequency = [0.05, 1.0]", "frequency.1 = 1.0: is out"),
    (
        "layout",
        "dome_m = [0.1, 0.1]",
        "dome_m = [0.1, 360.0]",
        "stage.1.tank.0.height_m = 0.6: the domes are higher than the tank; allowed: height_m from 360.1",
    ),
    ("suite", "run.step_s=0.002", f"vehicle.stage.{_LONG}.name=x", "is not an element of this list"),
]


@pytest.mark.parametrize(("kind", "old", "new", "says"), _BREAKS)
def test_what_once_was_a_traceback(here: Path, kind: str, old: str, new: str, says: str) -> None:
    line = said_of(here, kind, old, new)
    assert says in line if says else line == "", line
    assert "\n" not in line
    assert len(line) < 1000


@pytest.mark.parametrize(
    ("name", "old", "new", "says"),
    [
        ("vehicles/rocket/mass.csv", "6100", "9" * 400, "line 2, mass_kg = inf: is not finite"),
        ("vehicles/rocket/mass.csv", "6100", "1e20", "line 2, mass_kg = 1e+20: is out of range; allowed"),
        ("vehicles/rocket/thrust.csv", "0.5,", "1e-320,", "line 4, time_s = 1e-320: time_s must increase stric"),
        ("vehicles/rocket/tank.csv", "0.27", "1e-300", "pendulum_length_m = 1e-300: is out of range"),
        ("winds/west.csv", "8,", "1e29,", "speed_mps = 1e+29: is out of range"),
        ("winds/west.csv", "speed_mps", "9" * 5000, "unknown column"),
    ],
)
def test_tables_that_once_were_a_traceback(here: Path, name: str, old: str, new: str, says: str) -> None:
    text = (here / name).read_text()
    assert old in text
    line = answer("table", here, name, text.replace(old, new, 1).encode())
    assert says in line
    assert len(line) < 600


_COMMANDS = [
    (simrun, ["campaign.toml", "--seed", str(2**63)], "--seed: 9223372036854775808 is too large: at most 92233720368"),
    (simrun, ["campaign.toml", "--seed", _LONG], "--seed: 99999999999999999999... is too large: at most 922"),
    (simrun, ["campaign.toml", "--runs", str(2**60)], "--runs: 1152921504606846976 is too large: at most 1000000000"),
    (simrun, ["ascent.toml", "--set", f"run.seed={2**64}"], f"run.seed = {2**64}: is out of range"),
    (simrun, ["ascent.toml", "--set", f"run.seed={_LONG}"], 'run.seed = "999'),
    (simrun, ["ascent.toml", "--set", f"vehicle.stage.{_LONG}.name=x"], "is not an element of this list"),
    (
        simrun,
        ["ascent.toml", "--set", f"{'a.' * 5000}a=1"],
        "a.a.a.: is not the path of a key; allowed: --set KEY=VALUE",
    ),
    (simrun, ["ascent.toml", "--set", f"run.seed={'[' * 400}{']' * 400}"], 'run.seed = "[[[[['),
    (simdesign, ["case.toml", "--seed", str(2**64)], f"search.seed = {2**64}: is out of range"),
    (simdesign, ["case.toml", "--seed", _LONG], "--seed: "),
    (
        simdesign,
        ["analyse", "designs/trial.toml", "--scenario", "ascent.toml", "--at", "1e300"],
        "operating point at 1e+300 s: all",
    ),
    (
        simverify,
        ["designs/trial.toml", "--suite", "suite.toml", "--set", "certificate.times_s=[1e29]"],
        "is out of range",
    ),
]


@pytest.mark.parametrize(("module", "arguments", "says"), _COMMANDS)
def test_numbers_on_the_command_line(
    here: Path, capsys: pytest.CaptureFixture[str], module: ModuleType, arguments: list[str], says: str
) -> None:
    try:
        code = module.main(arguments)
    except SystemExit as end:
        code = end.code
    said = capsys.readouterr().err
    assert code == 2, said
    assert says in said
    assert said.count("\n") == 1


def test_limits_that_no_schedule_meets() -> None:
    with pytest.raises(
        UnsolvableError, match=r"no schedule of gains up to 1000 is above 1e\+04 at the operating point"
    ):
        lowest_above(np.eye(3), np.array([1.0, 1e4, 2.0]))
    with pytest.raises(UnsolvableError):
        lowest_above(np.eye(2), np.array([1.0, np.inf]))


@pytest.mark.slow
def test_a_case_that_no_schedule_meets(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    changes = ["gains.schedule=two-phase", "reference.rigid_hz=500.0", "loop=pade", "robust="]
    assert simdesign.main(["case.toml", *(word for change in changes for word in ("--set", change))]) == 2
    said = capsys.readouterr().err
    assert said.startswith("simdesign: case.toml: rigid_hz, rigid_zeta: no schedule of gains up to 1000 is above ")
    assert said.count("\n") == 1


def test_all_that_is_shipped_is_within_the_ranges(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "petrel").symlink_to(petrel.folder())
    monkeypatch.chdir(tmp_path)
    for kind, read in (
        ("scenario", load_scenario),
        ("campaign", maxq.load),
        ("case", read_case),
        ("suite", read_suite),
    ):
        for name in builtin_files(kind):
            read(name)


def test_ranges_of_names() -> None:
    assert range_of("mass_kg").least == 1e-6
    assert range_of("slosh_mass_kg").least == 0.0
    assert (range_of("position_error_m").most, range_of("position_m").most) == (1e6, 1e3)
    assert range_of("k_d_s").most == 1e4
    assert range_of("first_order_zero_hz").most == 1e6
    assert range_of("equatorial_radius_m").most == 1e9
    assert range_of("no_unit_at_all").most == 1e30
    assert range_of("noise_deg_rt_h").why == "noise of gyros, deg per root hour"
    names = [name for r in RANGES for name in r.names]
    assert len(names) == len(set(names))


def test_an_impossible_number_names_key_value_and_range(here: Path) -> None:
    for override, says in (
        ("vehicle.stage.0.engine.gimballed_mass_kg=1e9", "magnitudes up to 1e+08 (the heaviest rockets have 5e6 kg)"),
        ("wind.profile={altitude_m=[0.0],speed_mps=[1e4],from_deg=[0.0]}", "speed_mps.0 = 10000.0: is out of range"),
        ("vehicle.stage.0.mass={mass_kg=1e9,x_cg_m=7.0}", "mass_kg = 1000000000.0: is out of range"),
        ("vehicle.stage.0.actuator.omega_hz=[1.0,1.0,1.0,1e9]", "omega_hz.3 = 1000000000.0: is out of range"),
    ):
        with pytest.raises(ScenarioError) as caught:
            load_scenario("ascent.toml", [override])
        assert says in str(caught.value)
        assert str(caught.value).startswith("--set: ")


def _try(here: Path, kind: str, examples: int) -> None:
    @settings(max_examples=examples, suppress_health_check=list(HealthCheck))
    @given(broken(kind))
    def one(file: tuple[str, bytes]) -> None:
        line = answer(kind, here, *file)
        assert "\n" not in line
        assert len(line) < 2500

    one()


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_broken_files_are_answered(here: Path, kind: str) -> None:
    _try(here, kind, 25)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_a_thousand_broken_files_are_answered(here: Path, kind: str) -> None:
    _try(here, kind, 250 if kind == "layout" else 1000)  # each of them is built into a vehicle
