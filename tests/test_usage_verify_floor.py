"""No suite lowers the floor of an acceptance, and the shipped suites of vehicles reach it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from maxq.design.model.powered import powered_spans
from maxq.design.verify.baseline import against_baseline
from maxq.design.verify.floor import FLOOR, Evidence, missing_evidence, switched_off
from maxq.design.verify.flown import load_wanted
from maxq.design.verify.memory import PartsOnDisk
from maxq.design.verify.parts import Parts
from maxq.design.verify.suite import JudgedRequirement, LoadedSuite, read_suite
from maxq.design.verify.verify import missing_of, prepare, verify
from maxq.sim.campaign.statistics import allowed_failures
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.tools.verify.outcome import headline

DESIGN = "designs/ksr3-robust.toml"
CODE = Path(__file__).parents[1] / "examples/flight_software/pd_law.py"
EMPTY = """
schema = 2
name = "standard"
[margins]
times_s = [40.0]
cases = 1
corner_sigmas = 0.0
success = 0.01
confidence = 0.01
between_nodes = "ignore"
[margins.three_sigma]
bending_frequency = 0.0
bending_slope = 0.0
bending_damping = 0.0
slosh_frequency = 0.0
slosh_mass = 0.0
slosh_damping = 0.0
actuator_frequency = 0.0
thrust = 0.0
normal_force = 0.0
inertia = 0.0
centre_of_pressure_m = 0.0
delay_s = 0.0
[certificate]
times_s = [30.0]
planes = ["pitch"]
in_flight = false
[[campaign]]
file = "campaigns/ksr3"
runs = 1
success = 0.01
confidence = 0.01
set = ["run.duration_s=1.0"]
"""
"""A suite that asks for every part, and of each for next to nothing."""


STANDARD = ("dispersed_limit=[]", "margins.between_nodes=ignore")
"""Changes of `standard` without which it takes the marks of a flight, and a search for the worst instants."""


@cache
def _along(scenario: str) -> LoadedScenario:
    return load_scenario(scenario, [f'design="{DESIGN}"'])


def evidence(loaded: LoadedSuite, in_flight: tuple[str, ...] = FLOOR.planes) -> Evidence:
    """Return the evidence of a suite that needs no marks: its campaigns, operating points and a windy flight."""
    suite, along = loaded.suite, _along(loaded.suite.scenario)
    campaigns = [load_wanted(loaded, wanted, DESIGN, None) for wanted in suite.campaign]
    none: Any = None
    job = Parts(suite, along, along, PartsOnDisk(None), lambda *_: None, 1, next(iter(campaigns), none))
    points_s = {"margins": job.points_s(suite.margins), "certificate": job.points_s(suite.certificate)}
    windy = load_scenario(suite.scenario, [f"wind.profile={suite.limit_wind}"]).scenario
    spans, vehicles = powered_spans(along), job.described_by_stage()
    return Evidence(suite, along, spans, points_s, vehicles, True, [windy], campaigns, frozenset(in_flight))


@pytest.fixture(scope="module")
def standard() -> Evidence:
    """Return the evidence of the suite `standard` without the limits that its marks need."""
    loaded = read_suite("standard", STANDARD)
    return evidence(loaded)


def test_standard_reaches_the_floor(standard: Evidence) -> None:
    assert missing_evidence(standard) == ()


def test_the_floor_of_runs_is_the_fewest_that_show_its_level() -> None:
    fewest = [allowed_failures(runs, FLOOR.success, FLOOR.confidence) for runs in (FLOOR.runs - 1, FLOOR.runs)]
    assert fewest == [-1, 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (["margins.success=0.95"], "linear margins: 95 % with 90 % confidence, not 99.73 % with 90 %"),
        (["margins.confidence=0.5"], "linear margins: 99.73 % with 50 % confidence, not 99.73 % with 90 %"),
        (["margins.cases=100"], "linear margins: 100 vehicles, not 852"),
        (["margins.planes=['pitch']"], "linear margins: not in yaw"),
        (["margins.nodes_per_stage=5"], "linear margins: no operating point from "),
        (["margins.nominal.delay_ms="], "linear margins: no limit as designed on delay_ms"),
        (["margins.only=certificate"], "linear margins: 'certificate' was judged alone"),
        (["margins.only=vehicle 5"], "linear margins: 'vehicle 5' was judged alone"),
        (["certificate.planes=['yaw']"], "certificate: not in pitch"),
        (["certificate.times_s=[20.0,40.0]"], "certificate: no operating point from 20 to 40 s"),
        (["campaign.0.runs=100"], "campaign ksr3: 100 runs, not 852"),
        (["campaign.0.runs=1"], "campaign ksr3: 1 run, not 852"),
        (["campaign.0.success=0.9"], "campaign ksr3: 90 % with 90 % confidence, not 99.73 % with 90 %"),
        (["campaign.0.availability=0.9"], "campaign ksr3: judged by availability, not by each requirement"),
        (
            ["campaign.0.set=['run.duration_s=40.0']"],
            "campaign ksr3: flown to 40 s, not to the last burnout at 59.29 s",
        ),
        (["campaign.0.set=['run.start_s=40.0']"], "campaign ksr3: flown from 40 s, not from liftoff at 0.1069 s"),
        (
            ["campaign.0.set=['requirement=[]']"],
            "campaign ksr3: no requirement, and so no verdict on all requirements together",
        ),
        (["campaign.0.set=['switches.slosh=false']"], "campaign ksr3: switches.slosh = false"),
        (["campaign.0.set=['switches.actuator=linear']"], "campaign ksr3: switches.actuator = linear"),
    ],
)
def test_less_than_the_floor_is_named(changes: list[str], said: str) -> None:
    found = missing_evidence(evidence(read_suite("standard", [*STANDARD, *changes])))
    assert len(found) == 1
    assert found[0].startswith(said)


def test_a_flight_in_wind_to_burnout_and_the_whole_model_belong_to_the_floor(standard: Evidence) -> None:
    (windy,) = standard.flights
    still = load_scenario("nominal").scenario
    short = load_scenario("nominal", ["wind.profile=winds/anheung-november.csv", "run.duration_s=40.0"]).scenario
    late = load_scenario("nominal", ["wind.profile=winds/anheung-november.csv", "run.start_s=40.0"]).scenario
    for flights in ([], [still], [short], [late]):
        found = missing_evidence(replace(standard, flights=flights))
        assert found == ("no flight in wind from liftoff to the last burnout",)
    frozen = load_scenario("nominal", ["switches.slosh=false", "switches.bending=false"]).scenario
    assert switched_off(frozen) == ["switches.slosh = false", "switches.bending = false"]
    held = load_scenario("nominal", ["run.freeze_vehicle_at_s=40.0"]).scenario
    assert switched_off(held) == ["run.freeze_vehicle_at_s = 40"]
    found = missing_evidence(replace(standard, flights=[windy, frozen, frozen]))
    assert found == ("switches.slosh = false in 2 flights", "switches.bending = false in 2 flights")
    assert missing_evidence(replace(standard, in_flight=frozenset({"pitch"}))) == (
        "certificate: no in-flight response in yaw",
    )


def test_every_flight_and_campaign_flies_the_design_that_is_judged(standard: Evidence) -> None:
    """No flight or campaign of a suite flies another design than the one whose margins are measured."""

    def flight(design: str, *changes: str) -> Scenario:
        wind = "wind.profile=winds/anheung-november.csv"
        return load_scenario("nominal", [f'design="{design}"', wind, *changes]).scenario

    other, text = "designs/ksr3-free.toml", "another design or flight code than the judged one"
    judged = replace(standard, judged=flight(DESIGN))
    assert missing_evidence(replace(judged, flights=[flight(DESIGN)])) == ()
    assert missing_evidence(replace(judged, flights=[flight(DESIGN), flight(other)])) == (f"{text} in 1 flight",)
    changed = read_suite("standard", [*STANDARD, f"campaign.0.set=['design=\"{other}\"']"])
    assert missing_evidence(replace(evidence(changed), judged=judged.judged, flights=[flight(DESIGN)])) == (
        f"campaign ksr3: {text}",
    )
    mine = flight(DESIGN)
    renamed = mine.model_copy(update={"vehicle": mine.vehicle.model_copy(update={"name": "other"})})
    assert missing_evidence(replace(judged, judged=renamed, flights=[renamed])) == (
        "campaign ksr3: another vehicle than the judged one",
    )
    at_socket = ("design=", "vehicle.computer.law=external", "vehicle.computer.address=tcp://127.0.0.1:5000")
    external = replace(standard, judged=flight(DESIGN, *at_socket), flights=[flight(DESIGN, *at_socket)])
    assert "flight code at a socket, which no hash covers" in missing_evidence(external)
    guided = (*at_socket[1:], "vehicle.computer.interface=2", "vehicle.computer.sequencing=flight-code")
    external = replace(standard, judged=flight(DESIGN, *guided), flights=[flight(DESIGN, *guided)])
    text = "gimbal angles not compared with the design: the code has its own guidance"
    assert text in missing_evidence(external)


def test_the_flight_of_the_operating_points_has_the_whole_model(standard: Evidence) -> None:
    """The linear margins are those of this flight, to which changes of the other flights do not apply."""
    along = load_scenario("nominal", [f'design="{DESIGN}"', "switches.slosh=false"])
    assert missing_evidence(replace(standard, along=along)) == (
        "switches.slosh = false in the flight of the operating points",
    )


def test_a_suite_that_is_looser_than_its_baseline_is_a_screening(standard: Evidence) -> None:
    loosened = against_baseline(read_suite("standard", ["margins.nominal.delay_ms=0.1"])).loosened
    assert missing_evidence(replace(standard, loosened=loosened)) == (
        "looser than the suite standard: limit loosened: margins.nominal.delay_ms, 10 -> 0.1",
    )


def test_one_unguarded_flight_is_found_and_the_baseline_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Flight code that shares the judge's process in a single flight is found, and the baseline is read once."""
    read, lack = list[str](), "flight code ran in the process that judges it"

    def counted(name: str, *more: Any) -> LoadedSuite:
        read.append(name)
        return read_suite(name, *more)

    for module in ("verify", "baseline"):
        monkeypatch.setattr(f"maxq.design.verify.{module}.read_suite", counted)
    for guard, count in (("true", 0), ("false", 1)):
        path = tmp_path / f"{guard}.toml"
        changed = f'[[flight]]\nname = "b"\nset = ["run.duration_s=1.0", "vehicle.computer.guard={guard}"]\n'
        path.write_text(f'schema = 2\n[[flight]]\nname = "a"\nset = ["run.duration_s=1.0"]\n{changed}')
        prepared = prepare(f"{CODE}:Autopilot", read_suite(path), None, PartsOnDisk(None))
        job = prepared.parts(PartsOnDisk(None), lambda *_: None, 1)
        assert missing_of(prepared, job, ()).count(lack) == count
    assert read == ["standard", "standard"]


def test_flight_code_without_a_linear_model_is_screened(standard: Evidence) -> None:
    found = missing_evidence(replace(standard, linear=False, vehicles=(), in_flight=frozenset()))
    assert found == (
        "no dispersed vehicle: flight code has no linear model",
        "certificate: no in-flight response in pitch and yaw",
    )
    unguarded = missing_evidence(replace(standard, guarded=False))
    assert unguarded == ("flight code ran in the process that judges it",)


def test_a_campaign_whose_spreads_are_zero_shows_nothing(standard: Evidence, tmp_path: Path) -> None:
    text = 'schema = 1\nextends = "campaigns/ksr3"\n[[disperse]]\nkey = "vehicle.stage.0.engine.thrust_factor"\n'
    for sigma, said in (("0.0", "no deviation"), ("0.01", "no deviation of mass, aero, bending, tank, actuator")):
        path = tmp_path / "still.toml"
        path.write_text(f'{text}distribution = "normal"\nthree_sigma = {sigma}\n')
        found = missing_evidence(evidence(read_suite("standard", [*STANDARD, f"campaign.0.file={path}"])))
        assert found[0] == f"campaign still: {said}"


@pytest.mark.slow
def test_a_suite_that_asks_for_next_to_nothing_accepts_nothing(tmp_path: Path) -> None:
    path = tmp_path / "vac.toml"
    path.write_text(EMPTY)
    found = verify(DESIGN, read_suite(path), memory=tmp_path / "memory")
    assert {r.judgement for r in found.requirements} == {"accepted"}
    assert found.judgement == "passed screening"
    assert {
        "no flight in wind from liftoff to the last burnout",
        "campaign ksr3: 1 % with 1 % confidence, not 99.73 % with 90 %",
        "campaign ksr3: 1 run, not 852",
        "campaign ksr3: flown to 1 s, not to the last burnout at 59.29 s",
        "linear margins: 1 vehicle, not 852",
        "linear margins: not in yaw",
        "linear margins: no limit as designed on gain_up_db, gain_down_db, rigid_phase_deg, delay_ms",
        "dispersed vehicles: no deviation in the stage",
        "certificate: not in yaw",
        "certificate: no in-flight response in pitch and yaw",
    } <= set(found.missing_evidence)
    line = headline(found)
    assert line.startswith("PASSED SCREENING: ")
    assert line.endswith(" A screening can reject, not accept.")


def _line(*requirements: JudgedRequirement, missing: tuple[str, ...] = ()) -> str:
    def of(judgement: str) -> list[JudgedRequirement]:
        return [r for r in requirements if r.judgement == judgement]

    verdicts = [v for v in ("rejected", "undecided") if of(v)]
    judgement = verdicts[0] if verdicts else "passed screening" if missing else "accepted"
    found: Any = SimpleNamespace(requirements=requirements, of=of, judgement=judgement, missing_evidence=missing)
    found.compared = SimpleNamespace(agreed="")
    return headline(found)


def test_the_last_line_names_outcome_reason_and_count() -> None:
    one = JudgedRequirement(
        "margins", "upper gain margin, as designed", ">= 6 dB", "5.76 dB", "rejected", -0.04, "0.3 s, pitch"
    )
    yaw = replace(one, where="0.3 s, yaw")
    good = replace(one, judgement="accepted", found="6.6 dB", room=0.1, name="lower gain margin, as designed")
    gust = JudgedRequirement("scenarios", "gust", "<= 17 deg", "slosh angle 22.99 deg", "rejected", -0.35, "at 40.12 s")
    flown = JudgedRequirement(
        "campaign", "c: q", "<= 8, 99 % with 90 %", "4 of 60 failed", "undecided", 0.2, "run 3", 7
    )
    assert _line(one, yaw, good, good, missing=("no certificate",)) == (
        "REJECTED: upper gain margin 5.76 dB < 6 dB at 0.3 s (pitch, yaw); 2 of 4 requirements met. "
        "A screening can reject, not accept."
    )
    assert (
        _line(one, gust, good) == "REJECTED: gust: slosh angle 22.99 deg > 17 deg at 40.12 s; 1 of 3 requirements met"
    )
    load = replace(gust, wanted="<= 5e+04 Pa deg", found="q alpha 5.2e+04 Pa deg", room=-0.9, where="")
    assert _line(gust, load) == "REJECTED: gust: q alpha 5.2e+04 Pa deg > 5e+04 Pa deg; 0 of 2 requirements met"
    lost = replace(flown, judgement="rejected", room=-0.5)
    expected = "REJECTED: c: q: 4 of 60 failed, required <= 8, 99 % with 90 % (run 3); 0 of 1 requirement met"
    assert _line(lost) == expected
    assert _line(good, flown) == (
        "UNDECIDED: c: q: 4 of 60 failed, required <= 8, 99 % with 90 %, 7 more runs would settle it; "
        "1 of 2 requirements met"
    )
    assert _line(good) == (
        "ACCEPTED: tightest requirement: lower gain margin 6.6 dB, limit 6 dB at 0.3 s (pitch), "
        "10 % of the limit left; 1 of 1 requirement met"
    )
    assert _line(good, missing=("a", "b", "c", "d")).endswith(
        "below the floor of an acceptance: a, b, c, and 1 more. A screening can reject, not accept."
    )
