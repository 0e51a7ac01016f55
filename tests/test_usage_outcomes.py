"""The outcome of a flight has decisive numbers in its last line, engineering units, folders and hints."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from maxq.sim.run.fly import fly
from maxq.sim.run.quantities import against_limit, number_text, quantity_text, share_text, utilisation
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simrun
from maxq.tools.flight_report import report, verdict_line

ASCENT = ["nominal", "--set", "run.duration_s=14.0", "--no-log"]
TUMBLES = [
    'injection=[{at="body_torque",axis="y",kind="step",amplitude_Nm=3e5,start_s=60.0}]',
    'run.stop_at=["tumble","impact"]',
    "requirement=",
]


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def last_line(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    simrun.main(list(arguments))
    return capsys.readouterr().out.splitlines()[-1]


# numbers


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (109100.0, "Pa", "109.1 kPa"),
        (49820.6, "Pa deg", "49.82 kPa deg"),
        (0.00013634, "m", "0.1363 mm"),
        (42390.1, "m", "42.39 km"),
        (4638.2, "m", "4638 m"),
        (-3809.0, "m", "-3809 m"),
        (1.2e5, "N", "120.0 kN"),
        (0.12, "m", "0.1200 m"),
        (3.21, "deg", "3.210 deg"),
        (-1e-9, "deg", "0 deg"),
        (1234567.0, "1", "1235000"),
        (float("nan"), "Pa", "- Pa"),
        (float("inf"), "m", "inf m"),
    ],
)
def test_values_have_engineering_units_and_four_digits(value: float, unit: str, text: str) -> None:
    assert quantity_text(value, unit) == text


def test_value_and_limit_have_one_unit_and_the_digits_that_part_them() -> None:
    assert against_limit(49820.0, "limit", 1e5, "Pa deg") == ("49.82", "100", "kPa deg")
    assert against_limit(0.0001, "limit", 0.01, "m") == ("0.1000", "10", "mm")
    assert against_limit(5.00004, "limit", 5.0, "deg") == ("5.00004", "5", "deg")
    assert against_limit(4.99996, "minimum", 5.0, "1") == ("4.99996", "5", "")
    assert against_limit(0.0, "limit", 0.0, "s") == ("0", "0", "s")
    assert number_text(2.5e-5) == "2.5e-05"


def test_the_used_share_of_a_limit() -> None:
    assert utilisation(14.66, "limit", 15.0) == pytest.approx(0.97733, abs=1e-5)
    assert utilisation(260.0, "minimum", 250.0) == pytest.approx(0.96154, abs=1e-5)
    assert utilisation(-1.0, "minimum", 250.0) == float("inf")
    assert str(utilisation(0.0, "limit", 0.0)) == "nan"
    assert [share_text(share) for share in (0.9773, 0.9996, 1.0, 1.0004, 7.5)] == [
        "98 %",
        "99.96 %",
        "100 %",
        "100.04 %",
        "750 %",
    ]


# the last line


def test_a_passed_flight_names_its_tightest_requirement(capsys: pytest.CaptureFixture[str]) -> None:
    limits = '{metric="max_gimbal_deg",limit=4,name="gimbal angle"},{metric="max_altitude_m",minimum=100}'
    assert simrun.main([*ASCENT, "--set", f"requirement=[{limits}]"]) == 0
    lines = capsys.readouterr().out.splitlines()
    said = "PASSED: all 2 requirements met; tightest: gimbal angle, 2.725 of 4 deg, 68 % used"
    assert lines[-1] == said
    at = lines.index("requirements")
    assert [line.split()[0] for line in lines[at + 2 : at + 4]] == ["gimbal", "max_altitude_m"]
    assert "largest bending at the gimbal" in "\n".join(lines)
    assert any(line.split()[-5:-3] == ["0.1363", "mm"] for line in lines)


def test_a_requirement_that_is_nearly_missed_comes_with_a_hint(capsys: pytest.CaptureFixture[str]) -> None:
    simrun.main([*ASCENT, "--set", 'requirement=[{metric="max_gimbal_deg",limit=2.8,name="gimbal angle"}]'])
    said = capsys.readouterr().out
    assert "gimbal angle is close to its limit: examine the margins with simdesign analyse\n" in said


def test_a_failed_flight_gives_value_limit_and_time(capsys: pytest.CaptureFixture[str]) -> None:
    limits = '{metric="max_gimbal_deg",limit=2.7,name="gimbal angle"},{metric="max_slosh_deg",limit=1,name="slosh"}'
    said = last_line(capsys, *ASCENT, "--set", f'requirement=[{limits},{{metric="max_mach",limit=9}}]')
    assert said == "FAILED: slosh 4.667 deg > 1 deg at 12.639 s; also missed: gimbal angle; 1 of 3 requirements met"


def test_a_vehicle_that_tumbles_after_burnout_is_named_in_the_verdict() -> None:
    flight = fly(load_scenario("nominal", TUMBLES), log=False)
    assert flight.outcome == "tumble"
    burnout_s, tumble_s = flight.event_s("burnout"), flight.event_s("tumble")
    since = f"the vehicle tumbles from {tumble_s:.3f} s on, {tumble_s - burnout_s:.3f} s after burnout"
    assert verdict_line(flight) == f"PASSED: no requirements; {since}"


def test_apogee_and_perigee_are_given_only_where_they_mean_something() -> None:
    """Osculating heights above the equatorial radius are below the ground for a flight that does not reach space."""
    low = fly(load_scenario("nominal", ["run.duration_s=14.0"]), log=False)
    assert low.metrics["apogee_altitude_m"] < 0.0
    assert "apogee" not in report(low, [], 1.0)
    assert "perigee" not in report(low, [], 1.0)


def test_a_flight_without_thrust_fails_on_the_pad(capsys: pytest.CaptureFixture[str]) -> None:
    """A flight without thrust ends with an outcome, although its warnings would divide by zero thrust."""
    words = ["nominal", "--set", "vehicle.stage.0.engine.thrust_factor=0", "--set", "run.duration_s=0.5"]
    assert simrun.main([*words, "--out", "out", "--no-log"]) == 1
    said = capsys.readouterr().out
    assert said.splitlines()[-1].startswith("FAILED: not lifted off at 0.500 s: the thrust is 0 N, the weight 5.9")
    assert "or it is never released" in said
    assert json.loads(Path("out/summary.json").read_text())["outcome"] == "duration"


@pytest.mark.parametrize(
    ("end_s", "changes", "said"),
    [
        (0.05, (), "PASSED: no requirements; the flight ends before liftoff"),
        (2.0, ("holddown={release='time',release_s=5}",), "FAILED: not lifted off at 2.000 s: the release is at 5 s"),
    ],
)
def test_a_vehicle_that_stays_on_the_pad_fails_once_its_thrust_has_built_up(
    end_s: float, changes: tuple[str, ...], said: str
) -> None:
    flight = fly(load_scenario("nominal", [f"run.duration_s={end_s}", "requirement=", *changes]), log=False)
    assert verdict_line(flight) == said


# files


def test_changes_do_not_replace_the_result_of_the_plain_scenario() -> None:
    short = ["nominal", "--no-log", "--set", "run.duration_s=0.2"]
    assert simrun.main([*short, "--out", "runs/nominal"]) in (0, 1)
    before = Path("runs/nominal/summary.json").read_bytes()
    for seed in (2, 3, 3):
        simrun.main([*short, "--set", f"run.seed={seed}"])
    folders = sorted(path.name for path in Path("runs").iterdir())
    assert len(folders) == 3  # one for each seed
    assert folders[0] == "nominal"
    assert all(name.startswith("nominal-") for name in folders[1:])
    assert Path("runs/nominal/summary.json").read_bytes() == before


def test_a_large_log_is_announced_with_the_option_that_makes_it_smaller(capsys: pytest.CaptureFixture[str]) -> None:
    stopped = ["--set", 'run.stop_at=["tumble"]', "--set", "run.start_s=0", "--set", "requirement="]
    for duration_s, announced in ((1.0, False), (300.0, True)):
        words = ["nominal", "--set", f"run.duration_s={duration_s}", *stopped]
        lost = 'injection=[{at="body_torque",axis="y",kind="step",amplitude_Nm=1e9,start_s=0.5}]'
        simrun.main([*words, "--set", lost, "--out", "out"])
        lines = capsys.readouterr().out.splitlines()
        size = "log: up to 132 MB; --set log.fast_hz=100 makes it smaller, --no-log omits it"
        assert (lines[0] == size) == announced


@pytest.mark.parametrize("words", [["out/flight.mcap"], ["./out"], ["fly", "out/flight.mcap"]])
def test_a_log_in_place_of_a_scenario_gives_a_hint(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    Path("out").mkdir()
    Path("out/flight.mcap").write_bytes(b"\x89MCAP0\r\n")
    assert simrun.main(words) == 2
    said, log = capsys.readouterr().err, "./out/flight.mcap" if words == ["./out"] else "out/flight.mcap"
    assert said == (
        f"simrun: {words[-1]} is a flown flight, not a scenario: simrun refly {log} flies it again, "
        f"simreplay {log} shows it\n"
    )


def test_a_built_in_scenario_is_flown_next_to_a_folder_of_its_name() -> None:
    Path("nominal").mkdir()
    Path("nominal/flight.mcap").write_bytes(b"\x89MCAP0\r\n")
    assert simrun.main(["nominal", "--set", "run.duration_s=0.1", "--set", "requirement=", "--no-log"]) == 0
