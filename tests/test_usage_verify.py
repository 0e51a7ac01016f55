"""The command `simverify` prints and writes what docs/simverify.md documents."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import re
import shlex
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import design_nodes
import numpy as np
import petrelkit as petrel
import pytest
import test_oracle_boosters as boosters
from flightkit import load
from jsonschema import Draft202012Validator
from junit_form import is_junit

import maxq
from maxq import ScenarioError
from maxq.design.model.dispersion import Dispersion
from maxq.design.model.spread import Spread, campaign_of
from maxq.design.quantities import SWEPT, LoopLimits, violation
from maxq.design.verify import fitted as fitted_module
from maxq.design.verify import verify as verify_module
from maxq.design.verify.fitted import fit
from maxq.design.verify.flown import campaign_requirements, load_flight, load_wanted
from maxq.design.verify.judging import Check
from maxq.design.verify.linear import (
    Authority,
    MarginCase,
    MarginStudy,
    authority_requirement,
    margin_requirements,
    meet_limits,
)
from maxq.design.verify.linear import vehicles as vehicles_of
from maxq.design.verify.memory import PartsOnDisk, content_hash
from maxq.design.verify.parts import Parts
from maxq.design.verify.suite import (
    JudgedRequirement,
    LinearMargins,
    overall,
    read_suite,
    room_left,
    set_words,
    shared_risk,
)
from maxq.sim.campaign.statistics import judge_failures
from maxq.sim.input.files import builtin_files
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.schemas import json_schema
from maxq.tools.simverify import main
from maxq.tools.verify import report as pack_report
from maxq.tools.verify.report import page_of, ranked
from maxq.tools.verify.run import campaigns_of

SMALL = """
schema = 2
description = "as little as can be judged"

[margins]
times_s = [20.0, 40.0]
cases = 8
corner_sigmas = 0.5
success = 0.5

[margins.nominal]
gain_up_db = {gain_db}

[[flight]]
name = "six seconds"
set = ["run.duration_s=6.0"]
"""


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    path = tmp_path / "small.toml"
    path.write_text(SMALL.format(gain_db=3.0))
    return path


def _run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    try:
        code = main(list(words))
    except SystemExit as ended:
        code = int(ended.code or 0)
    out, err = capsys.readouterr()
    return code, out, err


@pytest.mark.parametrize("name", ["standard", "ksr3-ringed"])
def test_campaigns_of_shipped_suites_fly_the_vehicle_that_is_judged(name: str) -> None:
    suite = read_suite(name).suite
    for campaign in suite.campaign:
        assert maxq.load(campaign.file).base.scenario.vehicle == load_scenario(suite.scenario).scenario.vehicle


def test_a_hash_is_that_of_the_content_as_json() -> None:
    """A list of plain numbers is hashed as it is, NumPy's numbers in a list as arrays with their type."""
    plain = [1.0, 2, "x", None, True]
    text = json.dumps({"tuple": [plain, [{"array": ["<f8", [], "AAAAAAAA+D8="]}, 2.0]]})
    assert content_hash(plain, [np.float64(1.5), 2.0]) == hashlib.sha256(text.encode()).hexdigest()


@pytest.mark.slow
def test_accepted_design_leaves_verdict_and_pack(
    tmp_path: Path, suite: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MAXQ_CACHE", "")  # the user's own: kernels are compiled there already
    monkeypatch.setattr("maxq.design.verify.memory.default_folder", lambda: tmp_path / "memory")
    out = tmp_path / "out"
    code, said, _ = _run(capsys, "ksr3-robust", "--suite", str(suite), "--out", str(out), "--junit", f"{out}/v.xml")
    assert code == 0, said
    is_junit(out / "v.xml")
    assert said.splitlines()[0] == (
        "the suite does not limit: gain margin 6 dB, phase margin 30 deg, peak of mode 2 -6 dB, rigid-body frequency "
        "0.5 Hz, rigid-body damping ratio 0.7"
    )
    last = said.rstrip().splitlines()[-1]
    assert re.fullmatch(
        r"PASSED SCREENING: tightest requirement: .*; (\d+) of \1 requirements met; below .* accept\.", last
    )
    verdict = json.loads((out / "verdict.json").read_text())
    Draft202012Validator(json_schema("verdict")).validate(verdict)
    cases = ElementTree.parse(out / "v.xml").getroot().findall("testsuite/testcase")
    found = [(case.get("classname"), case.get("name"), [child.tag for child in case]) for case in cases]
    assert found == [
        (r["part"], f"{r['name']} ({r['where']})" if r["where"] else r["name"], []) for r in verdict["requirements"]
    ]
    assert verdict["verdict"] == "passed screening"
    assert verdict["against_basis"] == said.splitlines()[:2]
    assert {r["part"] for r in verdict["requirements"]} == {"scenarios", "margins", "dispersed"}
    assert verdict["flights"][0]["again"].startswith("simrun nominal --set 'design=")
    gaps = [
        "0.1069 to 20 s: under thrust, before the first operating point",
        "40 to 59.09 s: under thrust, after the last operating point",
        "59.09 to 59.29 s: tail-off, with less than half of the largest thrust",
    ]
    lines = said.splitlines()
    assert lines[lines.index("not covered by operating points") + 1 :][:4] == [*(f"  {gap}" for gap in gaps), ""]
    recorded = [f"{one['begin_s']:.4g} to {one['end_s']:.4g} s: {one['why']}" for one in verdict["not_covered"]]
    assert recorded == gaps
    page = (out / "review.html").read_text()
    assert re.findall(r"<li[^>]*>not covered by operating points: ([^<]*)</li>", page) == gaps
    assert "The design file states, which is no finding of this review: " in page
    shares = re.findall(r'"name": "(\d+) % of vehicles are worse",[^}]*"dash": "([^"]*)"', page)
    assert set(shares) == {("50", ""), ("10", "2 2")}  # two looks: one key for all panels
    assert set(re.findall(r"https?:[^\"']*", page)) == {"http://www.w3.org/2000/svg"}  # nothing from outside
    assert {"flights.csv", "margins-pitch.csv", "nichols-pitch.csv"} <= {f.name for f in (out / "figures").iterdir()}
    assert verdict["command"] in page.replace("&#x27;", "'")

    again, told, _ = _run(capsys, "ksr3-robust", "--suite", str(suite), "--out", str(out), "--no-pack")
    assert again == 0
    remembered = json.loads((out / "verdict.json").read_text())
    assert remembered["parts"]["worked_out"] == 0
    assert remembered["requirements"] == verdict["requirements"]
    assert "results recalled" in told


@pytest.mark.slow
def test_rejected_and_undecided_have_their_codes(
    tmp_path: Path, suite: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    quick = ("--suite", str(suite), "--out", str(tmp_path / "out"), "--no-pack", "--afresh")
    suite.write_text(SMALL.format(gain_db=30.0))
    code, said, _ = _run(capsys, "ksr3-robust", *quick)
    assert code == 1
    verdict = json.loads((tmp_path / "out" / "verdict.json").read_text())
    assert 0.0 < sum(verdict["walls_s"].values()) <= verdict["wall_s"]
    assert "\n\nrequirements not shown to be met\n  missed: upper gain margin, as designed" in said
    code, said, _ = _run(
        capsys, "ksr3-robust", *quick, "--set", "margins.nominal.gain_up_db=3.0", "--set", "margins.success=0.99"
    )
    assert code == 3
    assert "289 more runs would settle it" in said  # 297 without failure show 99 % with 90 %; 8 are there


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "give a DESIGN, e.g. simverify ksr3-robust"),
        (("ksr3-robst",), "no such file"),
        (("ksr3-robust", "ksr3-robust"), "named twice"),
        (("ksr3-robust", "--suit", "x"), "unknown option --suit; did you mean --suite?"),
        (("ksr3-robust", "--suite", "standrad"), "did you mean standard?"),
        (("ksr3-robust", "--set", "margins.case=3"), "margins.case"),
        (("ksr3-robust", "--set", "margins.success=1.5"), "margins.success"),
        (("ksr3-robust", "--set", "flight=[{name='a',set=['run.step=1']}]"), "run.step"),
        (("ksr3-robust", "--set", "flight=[{name='a'},{name='a'}]"), "name of another flight"),
        (("ksr3-robust", "--set", "campaign=[{file='nothing'}]"), "nothing"),
        (("ksr3-robust", "--set", "dispersed_limit.0.requirement='slosh angel'"), "did you mean slosh angle?"),
        (("ksr3-robust", "--only", "nominl"), "the suite has no such part"),
        (("ksr3-robust", "--set", "dispersed_limit.0.why=''"), 'dispersed_limit.0.why = "": a limit without a reason'),
    ],
)
def test_wrong_input_is_one_line(
    words: tuple[str, ...], said: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    more = ("--out", str(tmp_path / "out")) if words else ()
    code, out, err = _run(capsys, *words, *more)
    assert code == 2
    assert out == ""
    assert err.count("\n") == 1
    assert said in err


@pytest.mark.long
def test_the_pack_of_another_vehicle_has_no_word_of_the_first(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """A flight, the figures of an operating point and the page do not mention the first vehicle."""
    words = ["flight=[{name='begin',set=['run.duration_s=8']}]", "campaign=[]", "dispersed_limit=[]"]
    words += ["certificate=", "margins.worst=", "margins.times_s=[40.0]", "margins.cases=1", "margins.corner_sigmas=0"]
    changes = [x for word in (*words, "margins.between_nodes='ignore'") for x in ("--set", word)]
    design, suite = str(petrel.folder() / "design.toml"), str(petrel.folder() / "suite.toml")
    _run(capsys, design, "--suite", suite, *changes, "--out", str(tmp_path))
    page = (tmp_path / "review.html").read_text()
    text = re.sub(r"(?s)<style.*?</style>|<script.*?</script>|<[^>]*>", " ", page)
    assert "petrel" in text
    assert "margins" in text
    assert not re.search(r"ksr|anheung|korea|reconstruct|\bkari\b|\bpaper\b|\bLee\b", text, re.IGNORECASE)
    whys = [(one["stage"], one["why"]) for one in json.loads((tmp_path / "verdict.json").read_text())["not_covered"]]
    assert whys[:3] == [
        (1, "under thrust, before the first operating point"),
        (1, "under thrust, after the last operating point"),
        (1, "tail-off, with less than half of the largest thrust"),
    ]
    assert whys[3][1].startswith("coast, the airframe is unstable (M_alpha up to ")
    assert {why for stage, why in whys[4:] if not why.startswith("coast")} == {"under thrust, no operating point"}
    assert not re.search(r"ksr|reconstruct", (tmp_path / "verdict.json").read_text(), re.IGNORECASE)


@pytest.mark.slow
def test_a_wrong_part_is_refused_before_anything_is_flown(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verify_module, "fit", lambda *given: pytest.fail("flown for the marks"))
    design, suite = str(petrel.folder() / "design.toml"), str(petrel.folder() / "suite.toml")
    code, _, err = _run(capsys, design, "--suite", suite, "--only", "pitch gyro dead for 0.2 s, third")
    assert code == 2
    assert ", second, fairing off, " in err  # parts of each stage
    with pytest.raises(pytest.fail.Exception):
        _run(capsys, design, "--suite", suite, "--only", "pitch gyro dead for 0.2 s, second")


def test_dispersed_limits_stand_in_for_the_scenarios_own(tmp_path: Path) -> None:
    path = tmp_path / "limits.toml"
    path.write_text("""
schema = 2
[[dispersed_limit]]
requirement = "slosh angle"
limit = 17.0
why = "a test"
[[flight]]
name = "own"
[[flight]]
name = "dispersed"
limits = "dispersed"
[[campaign]]
file = "campaigns/ksr3"
limits = "dispersed"
set = ["vehicle.stage.0.tank.0.damping_ratio=0.1"]
""")
    loaded = read_suite(path)
    design = "designs/ksr3-robust.toml"
    flights = [load_flight(loaded, flown, design, None) for flown in loaded.suite.flight]
    bounds = [{r.name: r.limit for r in scenario.scenario.requirement} for scenario, _ in flights]
    assert [b["slosh angle"] for b in bounds] == [10.0, 17.0]
    assert bounds[0] | {"slosh angle": 17.0} == bounds[1]  # no other
    assert [c for c in flights[1][1] if c.startswith("requirement")] == ["requirement.6.limit=17.0"]
    base = load_wanted(loaded, loaded.suite.campaign[0], design, None).base.scenario
    assert {r.name: r.limit for r in base.requirement} == bounds[1]
    assert [tank.damping_ratio for tank in base.vehicle.stage[0].tank] == [0.1, 0.02]


def test_list_names_suites_and_designs(capsys: pytest.CaptureFixture[str]) -> None:
    code, out, _ = _run(capsys, "--list")
    assert code == 0
    for name in (*builtin_files("suite"), "ksr3-robust"):
        assert f"  {name}" in out


class Known:
    """A memory that contains the marks of a flight from the start."""

    def __init__(self, whole: dict[str, Any], *stages: dict[str, Any]) -> None:
        self.marks = whole, list(stages)

    def recall(self, *_: object) -> Any:
        return self.marks


NOMINAL_MARKS = {
    "sample_s": 0.01,
    "longer_s": 0.005,
    "gimbal_limit_deg": 6.0,
    "gimbal_rate_limit_degps": 30.0,
    "burnout_s": 59.0,
    **{
        f"{name}_{unit}": value
        for name in ("before_max_q", "max_q", "after_max_q")
        for unit, value in (("s", 40.0), ("altitude_m", 9500.0), ("mode_1_gust_m", 46.0), ("slosh_gust_m", 322.0))
    },
}
STAGE_MARKS = {
    "stage": 0,
    "ignition_s": 0.1,
    "stage_burnout_s": 59.0,
    "early_s": 12.0,
    "late_s": 45.0,
    "strongest_s": 40.0,
    "gimbal_moment_Nm": 1e4,
}

WITHOUT_BOOSTERS = (
    "one booster with more mass flow: no outer booster",
    "one booster with more thrust: no outer booster",
    "boosters separate late: no booster stage",
)


def _fitted(name: str | Path, scenario: str | Path, *stages: dict[str, Any]):
    memory: Any = Known(NOMINAL_MARKS, *stages)
    return fit(read_suite(name), load_scenario(scenario), memory)


def test_standard_suite_asks_for_what_can_fail() -> None:
    fitted = _fitted("standard", "nominal", STAGE_MARKS)
    suite = fitted.suite
    names = {f.name for f in suite.flight}
    assert len(suite.flight) == 41
    assert fitted.left_out == (
        *WITHOUT_BOOSTERS,
        *(f"one engine out {when}: no outer engine" for when in ("early", "late")),  # it has a single one
    )
    assert {
        "thrust lost early",
        "attitude transient",
        "yaw actuator stuck for 0.2 s",
        "pitch gyro dead for 0.2 s",
    } <= names
    assert sum("turned by" in name for name in names) == 7
    assert sum(name.startswith("gust of") for name in names) == 9
    assert suite.certificate is not None
    margins, campaign = suite.margins, suite.campaign[0]
    assert margins is not None
    assert margins.planes == ("pitch", "yaw")
    assert margins.edges[0] * 59.0 < 0.5  # s after release
    assert margins.nominal.delay_ms == 10.0
    assert margins.why
    assert campaign.why
    assert campaign.success == maxq.load("campaigns/ksr3").campaign.success
    computer = load_scenario("nominal").vehicle.computer
    assert computer is not None
    limits = {x.requirement: float(x.limit) for x in suite.dispersed_limit}
    assert limits["gimbal angle"] < computer.command_limit_deg
    actuator = load_scenario("nominal").vehicle.stage[0].actuator
    assert actuator is not None
    assert limits["gimbal rate"] < actuator.rate_limit_degps


@pytest.mark.slow
def test_gusts_are_as_thick_as_the_vehicle_climbs_while_a_mode_swings() -> None:
    """A gust is as thick as the climb during a mode's period, from mode frequencies and logged heights.

    Such a gust excites a mode nearly most.
    """
    base = load_scenario("nominal")
    marks, _ = fitted_module._marks(base)
    flight, modes = fly(base), base.vehicle.stage[0].bending.pitch
    time_s, height_m = flight.time_s("altitude_m"), flight["altitude_m"]
    for place in ("before_max_q", "max_q", "after_max_q"):
        at_s = float(marks[f"{place}_s"])
        climb_mps = np.diff(np.interp([at_s - 0.5, at_s + 0.5], time_s, height_m))[0]
        for n in (1, 2):
            mine = modes["mode"] == n
            times, first = np.unique(modes["time_s"][mine], return_index=True)
            hz = np.interp(at_s, times, modes["frequency_hz"][mine][first])
            assert marks[f"{place}_mode_{n}_gust_m"] == pytest.approx(climb_mps / hz, rel=0.02), place
    # what swings on after a gust that lasts T: the transform of 1 - cos(2 pi t / T) at f, by quadrature
    lasting = np.linspace(0.2, 3.0, 57)  # in periods of the mode
    left = []
    for t_end in lasting:
        t = np.linspace(0.0, t_end, 4001)
        left.append(abs(np.trapezoid((1.0 - np.cos(2.0 * np.pi * t / t_end)) * np.exp(2j * np.pi * t), t)))
    assert left[int(np.argmin(abs(lasting - 1.0)))] == pytest.approx(0.96 * max(left), rel=0.01)


def test_a_fitted_suite_names_every_part_of_the_vehicle() -> None:
    """A fitted suite has scaled values, half a sample of added delay, and times and altitudes of its own flight."""
    flights = {f.name: f for f in _fitted("standard", "nominal", STAGE_MARKS).suite.flight}
    stage = load_scenario("nominal").vehicle.stage[0]
    assert all("run.stop_at=['burnout','impact']" in f.set for f in flights.values())
    smooth = flights["slosh, smooth walls"].set[2:]
    assert smooth == tuple(
        f"vehicle.stage.0.tank.{n}.damping_ratio={0.05 * t.damping_ratio}" for n, t in enumerate(stage.tank)
    )
    assert "vehicle.computer.delay_s=0.008" in flights["delay"].set
    assert "run.duration_s=24.0" in flights["thrust lost early"].set
    assert "altitude_m=9500.0,thickness_m=300,edge_m=150.0" in flights["gust of 300 m max q"].set[2]
    assert "thickness_m=46.0,edge_m=23.0" in flights["gust tuned to mode 1 max q"].set[2]
    low = [
        f"vehicle.stage.0.bending.{key}={[x] * 3}" for key, x in (("frequency_factor", 0.9), ("damping_ratio", 0.0025))
    ]
    assert set(low) <= set(flights["bending at 0.9 of its frequency"].set)
    assert read_suite("standard").suite.flight  # what is fitted is a copy


def test_generic_flights_treat_boosters() -> None:
    """Engines and tanks of core and boosters deviate together; one booster deviates alone; one separation is late.

    The second stage keeps its first booster, and the core flies on alone.
    """
    liquid = {"time_s": 0.0, "slosh_mass_kg": 50.0, "pendulum_length_m": 0.5, "hinge_station_m": 7.0}
    tanks = {"tank": [{"table": [liquid], "damping_ratio": 0.02}]}
    stays, leaves = boosters.solid("stays", (0.5, 0.9)) | tanks, boosters.solid("leaves", (0.0, -1.2))
    stages = (
        boosters.core({"separation_after_burnout_s": 1.5}, [stays, leaves], name="all"),
        boosters.core({"separation_s": 20.0}, [stays], name="one") | boosters.AFTER,
        boosters.core(boosters.AFTER, [], name="alone"),
    )
    base = load(boosters.launcher(*stages))
    marks = [STAGE_MARKS | {"stage": n} | fitted_module._of_boosters(base, n) for n in range(3)]
    memory: Any = Known(NOMINAL_MARKS | {"limit_wind": "calm.csv"}, *marks)
    fitted = fit(read_suite("launcher"), base, memory)
    changes = {f.name: f.set for f in fitted.suite.flight}
    engines = ["0.engine", "1.engine", "2.engine", "0.booster.0.engine", "0.booster.1.engine", "1.booster.0.engine"]
    assert sorted(changes["hot engine"]) == sorted(f"vehicle.stage.{e}.mass_flow_factor=1.03" for e in engines)
    assert sorted(changes["cold engine"]) == sorted(f"vehicle.stage.{e}.mass_flow_factor=0.97" for e in engines)
    turned = [f"vehicle.stage.{e}.misalignment_deg=[0.29,0.29]" for e in engines]
    assert sorted(changes["engine misaligned"]) == sorted(turned)
    smooth = [f"vehicle.stage.{n}.booster.0.tank.0.damping_ratio=0.001" for n in (0, 1)]
    assert list(changes["slosh, smooth walls"][-2:]) == smooth
    assert changes["one booster with more thrust, all"] == ("vehicle.stage.0.booster.1.engine.thrust_factor=1.042",)
    flow = [f"vehicle.stage.{n}.booster.0.engine.mass_flow_factor=1.042" for n in (0, 1)]
    assert list(changes["one booster with more mass flow, one"]) == flow
    assert changes["boosters separate late, all"] == ("vehicle.stage.0.separation_after_burnout_s=3.5",)
    assert changes["boosters separate late, one"] == ("vehicle.stage.1.separation_s=22.0",)
    assert "boosters separate late, stage 3: no booster stage" in fitted.left_out


def test_a_suite_adds_flights_to_those_of_another(tmp_path: Path) -> None:
    own = '[[append.flight]]\nname = "{}"\nset = ["run.duration_s=1"]\n'
    for name, base, flight in (("mine", "quick", "calm"), ("yours", "mine.toml", "short")):
        (tmp_path / f"{name}.toml").write_text(f'schema = 2\nextends = "{base}"\n{own.format(flight)}')
    names = [f.name for f in read_suite("quick").suite.flight]
    assert [f.name for f in read_suite(tmp_path / "yours.toml").suite.flight] == [*names, "calm", "short"]
    (tmp_path / "yours.toml").write_text(f'schema = 2\nextends = "mine.toml"\n{own.format("calm")}')
    with pytest.raises(ScenarioError) as error:
        read_suite(tmp_path / "yours.toml")
    assert str(error.value).startswith(
        f'{tmp_path / "yours.toml"}: append.flight.0.name = "calm": is the name of another'
    )


@pytest.mark.long
def test_a_suite_for_several_stages_and_engines() -> None:
    """A vehicle with nine engines below and one above has faults in each stage, none of them KSR-III's."""
    stages = [STAGE_MARKS | {"stage": n, "strongest_s": 10.0 * n + 5.0} for n in range(3)]
    stages[0]["outer_engine"] = 2
    fitted = _fitted(petrel.folder() / "suite.toml", petrel.folder() / "scenario.toml", *stages)
    flights = {f.name: f for f in fitted.suite.flight}
    of_each = [name for name in flights if name.startswith("pitch gyro dead")]
    assert [name.partition(", ")[2] for name in of_each] == [s.name for s in petrel.scenario().vehicle.stage]
    assert "stage=1,at_s=15.0,until_s=15.2" in flights[of_each[1]].set[1]
    assert "engine=2," in flights["one engine out late, first"].set[1]
    outer = (f"one engine out {when}, stage {n}: no outer engine" for when in ("early", "late") for n in (2, 3))
    assert fitted.left_out == (*WITHOUT_BOOSTERS, *outer)
    hot = flights["hot engine"].set
    assert len(hot) == 11
    assert all(change.endswith("mass_flow_factor=1.03") for change in hot)
    assert "limit_wind.csv" in flights["limit wind"].set[0]
    for flown in fitted.suite.flight:  # each of them can be loaded
        load_flight(fitted, flown, str(petrel.folder() / "design.toml"), None)
    assert not re.search(r"ksr|anheung", str(fitted.suite), re.IGNORECASE)


@pytest.mark.parametrize(
    ("flight", "said"),
    [
        ('set=["wind.turn_deg=${max_g_s}"]', "did you mean max_q_s?"),
        ('set=["wind.turn_deg=$nothing_of_it"]', "no such mark"),
        ('scale={"vehicle.stage.*.tank.*.damping_ratio"="much"}', "is no number"),
    ],
)
def test_a_wrong_mark_is_named(flight: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "marks.toml"
    path.write_text(f'schema = 2\nflight = [{{name="a", {flight}}}]\n')
    with pytest.raises(ScenarioError, match=re.escape(said)) as found:
        _fitted(path, "nominal", STAGE_MARKS)
    assert "flight a" in str(found.value)


def test_vehicles_deviate_by_the_starter_set_unless_a_suite_says_otherwise() -> None:
    """Modes 1, 2 and all beyond, every tank, actuator, thrust, air and inertia deviate by three sigma."""
    assert Spread().model_dump() == {
        "bending_frequency": (0.05, 0.10, 0.15),
        "bending_slope": 0.2,
        "bending_damping": 0.5,
        "slosh_frequency": 0.05,
        "slosh_mass": 0.10,
        "slosh_damping": 0.5,
        "actuator_frequency": 0.15,
        "delay_s": 0.002,
        "thrust": 0.03,
        "normal_force": 0.15,
        "centre_of_pressure_m": 0.25,
        "inertia": 0.05,
        "correlated": (),
        "campaign": None,
    }


def test_a_flight_for_each_value(tmp_path: Path) -> None:
    path = tmp_path / "each.toml"
    flight = (
        '[[flight]]\nname = "{}"\neach = {{v = [1.0, 2.5], axis = ["pitch", "yaw"]}}\nset = ["x=$v", "a=\'$axis\'"]\n'
    )
    path.write_text(flight.format("$axis at $v"))
    flights = read_suite(path).suite.flight
    assert [f.name for f in flights] == ["pitch at 1", "yaw at 1", "pitch at 2.5", "yaw at 2.5"]
    assert flights[3].set == ("x=2.5", "a='yaw'")
    path.write_text(flight.format("at $v"))
    with pytest.raises(ScenarioError, match=r"does not distinguish the flights of \$axis"):
        read_suite(path)


def test_designs_that_are_picked_from_share_the_risk_and_have_their_own_draws() -> None:
    loaded = read_suite("standard")
    campaigns = [maxq.load("campaigns/ksr3").campaign]
    assert shared_risk(loaded, campaigns, 1) == []
    found = [shared_risk(loaded, campaigns, 4, number) for number in range(4)]
    assert found[0] == ["margins.confidence=0.975", "campaign.0.confidence=0.975"]
    assert found[2] == [
        "margins.confidence=0.975",
        "margins.seed=3",
        "campaign.0.confidence=0.975",
        "campaign.0.seed=20021130",
    ]
    changed = read_suite("standard", found[2])
    wanted = campaigns_of(changed, "designs/ksr3-robust.toml")[0]
    assert (wanted.confidence, wanted.seed, wanted.runs) == (0.975, 20021130, 1200)
    assert changed.suite.margins is not None
    assert (changed.suite.margins.seed, changed.suite.margins.confidence) == (3, 0.975)
    again = changed.command("designs/ksr3-robust.toml")
    assert again.startswith(
        "simverify ksr3-robust --set margins.confidence=0.975 --set margins.seed=3 --set campaign.0"
    )


def test_commands_need_few_quotes() -> None:
    """Double quotes are inside single ones, where TOML has the same meaning; the rest is unchanged."""
    changes = ("run.stop_at=['burnout','impact']", 'name="it\'s"', "design=runs/it's.toml", r"name='\d'")
    words = set_words(changes)
    assert words == ["--set", 'run.stop_at=["burnout","impact"]', *(w for c in changes[1:] for w in ("--set", c))]
    assert shlex.join(words[:2]) == """--set 'run.stop_at=["burnout","impact"]'"""


def test_a_candidate_picked_because_it_passed_keeps_the_risk() -> None:
    """The risk is kept over ten candidates just below the requirement, tried until one is accepted.

    If each has its share of the risk, at most one search in ten accepts one. If each has the whole risk, far more do.
    """
    rng = np.random.default_rng(8)
    accepted = dict.fromkeys((0.9, 0.99), 0)
    for _ in range(300):
        failures = rng.binomial(400, 0.05, 10)
        for confidence in accepted:
            shown = [judge_failures(int(k), 400, 0.95, confidence, planned=400).judgement for k in failures]
            accepted[confidence] += "met" in shown
    assert accepted[0.99] / 300 <= 0.1
    assert accepted[0.9] / 300 > 0.13


def test_one_comparison_for_designs_and_verdicts() -> None:
    """A limit of 30.00 deg is met within the search's tolerance in designs and verdicts, with no margin."""
    for value, met in ((30.0, True), (30.0 - 4e-4, True), (30.0 - 6e-4, False), (31.0, True)):
        assert (violation(value, 30.0, ">=", "deg") <= 0.0) == met
        assert (violation(-value, -30.0, "<=", "dB") <= 0.0) == met
        check = Check("phase_margin_deg", "", "deg", ">=", 30.0, np.array([value]), np.array([1.0]))
        assert check.passed == met
        one = np.full((1, 1, len(SWEPT)), np.inf)
        one[..., SWEPT.index("rigid_phase_deg")] = value
        assert meet_limits(one, LoopLimits(rigid_phase_deg=30.0)).tolist() == [met]
    nodes = np.full((3, 2, len(SWEPT)), np.inf)  # limits are met by a vehicle that meets them at every node
    nodes[0, 1, SWEPT.index("rigid_phase_deg")] = 29.0
    nodes[1, 0] = np.nan  # unstable
    assert meet_limits(nodes, LoopLimits(rigid_phase_deg=30.0)).tolist() == [False, False, True]
    at, none = np.array([1.0]), np.array([np.nan])
    assert not Check("phase_margin_deg", "", "deg", ">=", 30.0, none, at).passed  # of an unstable loop
    assert Check("second_mode_db", "", "dB", "<=", 0.0, np.array([-np.inf]), at).passed  # there is no such mode
    assert Check("first_mode_phase_deg", "", "deg", ">=", 45.0, np.array([np.inf]), at).passed  # nor this one
    assert room_left(30.0 - 4e-4, 30.0, ">=", "deg") == 0.0
    assert room_left(29.0, 30.0, ">=", "deg") == pytest.approx(-1.0 / 30.0)


def test_every_reason_has_limit_value_vehicle_and_command() -> None:
    """The worst of random vehicles is named, with the command that measures it alone."""
    wanted = LinearMargins(cases=60, dispersed=LoopLimits(rigid_phase_deg=15.0))
    values = np.full((60, 1, len(SWEPT)), np.inf)
    values[:, 0, SWEPT.index("rigid_phase_deg")] = 20.0 - 0.1 * np.arange(60.0)
    nominal = MarginCase("", ({"rigid_phase_deg": 28.0},))
    study = MarginStudy("", "yaw", (40.0,), nominal, (), values)
    loaded = read_suite("standard", ["margins.seed=7"])
    *_, row = margin_requirements(study, wanted, lambda label: loaded.command("designs/ksr3-robust.toml", None, label))
    assert row.found == "51 of 60; phase margin, rigid body: 14.10 deg, required >= 15 deg"
    assert row.where == "vehicle 59, 40 s, yaw"
    *_, of_stage = margin_requirements(dataclasses.replace(study, stage="stage 1 (first)"), wanted)
    assert "; phase margin, rigid body, stage 1 (first): 14.10 deg" in of_stage.found
    assert row.again == "simverify ksr3-robust --set margins.seed=7 'vehicle 59'"
    only = dataclasses.replace(study, random=values[59:], first=59)
    alone = margin_requirements(only, wanted.model_copy(update={"only": "vehicle 59"}))
    assert [(r.found, r.judgement) for r in alone] == [("stable", "accepted"), ("14.10 deg", "rejected")]
    node, campaign = design_nodes.node_at(40.0), campaign_of(Spread(), design_nodes.nominal())
    corners, drawn = vehicles_of(wanted.model_copy(update={"only": "vehicle 812"}), node, campaign)
    assert ([d.label for d in drawn], corners) == (["vehicle 812"], [])
    assert drawn[0] == vehicles_of(LinearMargins(cases=813), node, campaign)[1][812]


@pytest.mark.long
def test_a_vehicle_measured_alone_is_that_of_the_study(tmp_path: Path) -> None:
    """The vehicle is measured along its dispersed flight to the operating point, not along the nominal one."""
    changes = ["flight=[]", "certificate=", "margins.worst=", "margins.times_s=[35.0]", "margins.planes=['pitch']"]
    changes += ["margins.between_nodes='ignore'", "margins.cases=4", "margins.trajectories=3", "campaign.0.runs=3"]
    suite = read_suite("standard", changes)
    (study,) = verify_module.verify("designs/ksr3-robust.toml", suite, memory=tmp_path).margins
    for number in (1, 3):
        (alone,) = verify_module.verify(
            "designs/ksr3-robust.toml", suite.only(f"vehicle {number}"), memory=tmp_path
        ).margins
        np.testing.assert_array_equal(alone.random, study.random[[number]])
    still = read_suite("standard", [*changes, "margins.trajectories=0"]).only("vehicle 4")
    (nominal,) = verify_module.verify("designs/ksr3-robust.toml", still, memory=tmp_path).margins
    assert (nominal.random != study.random[[3]]).any()


def test_no_slosh_advice_where_nothing_sloshes() -> None:
    """A suite's scenario that holds the liquid still gives no advice on slosh, although there are tanks."""
    still = load_scenario("nominal", ["switches.slosh=false"])
    none: Any = None
    job = Parts(SimpleNamespace(margins=LinearMargins()), still, still, none, none, 1)
    assert job.slosh() == []


@pytest.mark.parametrize(("wind_mps", "judgement"), [(9.0, "accepted"), (10.0, "accepted"), (10.1, "rejected")])
def test_the_wind_that_can_be_trimmed_is_that_of_the_worst_time(wind_mps: float, judgement: str) -> None:
    found = [Authority(t, 300.0, 2e4, 1.5, 5.0, w) for t, w in ((20.0, 14.0), (30.0, 10.0), (40.0, math.inf))]
    row = authority_requirement(found, wind_mps)
    assert (row.judgement, row.found, row.where) == (judgement, "10.0 m/s", "30 s")
    assert row.room == pytest.approx(10.0 / wind_mps - 1.0)


def test_a_campaign_s_requirement_names_its_worst_run() -> None:
    worst = tuple(SimpleNamespace(run=run, value=value) for run, value in ((41, 9.0), (7, 8.5)))
    shown = SimpleNamespace(failures=4, runs=60, judgement="", more=0)
    text = "9", "8", "deg"
    verdict = SimpleNamespace(
        kind="limit", bound=8.0, metric="m_deg", name="m", worst=worst, worst_text=text, shown=shown
    )
    result = SimpleNamespace(
        success=0.99,
        confidence=0.9,
        name="c",
        folder=Path("c"),
        first_lost=None,
        availability=None,
        verdicts=(verdict, SimpleNamespace(**{**vars(verdict), "worst": worst[:1]})),
    )
    for row in campaign_requirements(result):
        assert (row.found, row.wanted) == ("4 of 60 failed, worst 9 deg", "<= 8 deg, 99 % with 90 %")
        assert (row.where, row.again) == ("run 41", "simrun refly c --run 41")


def test_verdict_of_all_is_that_of_the_worst() -> None:
    one = JudgedRequirement("margins", "x", ">= 1", "2", "accepted", 1.0)
    doubt, bad = dataclasses.replace(one, judgement="undecided"), dataclasses.replace(one, judgement="rejected")
    assert overall([one]) == "accepted"
    assert overall([one, doubt]) == "undecided"
    assert overall([doubt, bad, one]) == "rejected"
    assert overall([]) == "undecided"
    assert overall([one], ["no certificate"]) == "passed screening"
    assert overall([bad], ["no certificate"]) == "rejected"


def test_a_part_is_known_by_the_bits_that_it_depends_on(tmp_path: Path) -> None:
    things = [0.1, 0.1 + 1e-18, 0.2, 1, True, "1", None, (1,), ((1,),), np.ones(2), np.ones((1, 2)), Dispersion()]
    memory = PartsOnDisk(tmp_path)
    for thing in things:
        memory.recall("part", thing, lambda: 7)
    assert (memory.recalled, memory.worked_out) == (0, len(things) - 1)  # the same float, of this computation
    for number in (1.0, math.nextafter(1.0, 2.0)):
        memory.recall("other", number, lambda: 7)
    assert memory.worked_out == len(things) + 1
    with pytest.raises(TypeError, match="no plain form of object"):
        memory.recall("part", object(), lambda: 7)


def test_memory_works_out_once_and_again_when_a_file_is_damaged(tmp_path: Path) -> None:
    count = [0]

    def work_out() -> int:
        count[0] += 1
        return 7

    memory = PartsOnDisk(tmp_path)
    assert [memory.recall("part", (1.0,), work_out) for _ in range(3)] == [7, 7, 7]
    assert memory.recall("part", (2.0,), work_out) == 7
    assert count == [2]
    for made, damage in enumerate((b"", b"\x80\x04N.", whole(tmp_path).replace(b"7", b"8"), whole(tmp_path)[:-1]), 3):
        for file in tmp_path.glob("part-*"):
            file.write_bytes(damage)
        assert memory.recall("part", (1.0,), work_out) == 7
        assert count == [made]


def test_an_entry_with_any_bit_flipped_or_of_another_making_is_made_anew(tmp_path: Path) -> None:
    """Entries with a flipped bit, with another part's content or with impossible values are computed again.

    This holds also for a correct checksum.
    """

    def recalled(depends: tuple[float, ...] = (1.0,)) -> tuple[Any, int]:
        memory = PartsOnDisk(tmp_path)
        return memory.recall("part", depends, lambda: {"room": np.array([0.25, depends[0]])}), memory.worked_out

    recalled((2.0,))
    other = whole(tmp_path)
    recalled()
    (path,) = (file for file in tmp_path.glob("part-*") if file.read_bytes() != other)
    good = path.read_bytes()
    key = good.split(b"\n")[1]
    bad = [other]
    for k in range(0, 8 * len(good), 7):  # each byte, and each place in a byte
        flipped = bytearray(good)
        flipped[k // 8] ^= 1 << k % 8
        bad.append(bytes(flipped))
    for content in (
        "{}",
        "[",
        '{"maxq.nosuch:X": {}}',
        '{"maxq.design.model.dispersion:Dispersion": {}}',
        '{"path": []}',
        '{"array": ["<f8", [2], "AAAA"]}',
        '{"mapping": 3}',
        "[" * 100_000,
    ):
        rest = key + b"\n" + content.encode()
        bad.append(hashlib.sha256(rest).hexdigest().encode() + b"\n" + rest)
    for damaged in bad:
        path.write_bytes(damaged)
        value, worked_out = recalled()
        assert (value["room"].tolist(), worked_out) == ([0.25, 1.0], 1)
        assert path.read_bytes() == good
    assert recalled()[1] == 0


def whole(folder: Path) -> bytes:
    return next(folder.glob("part-*")).read_bytes()


def test_memory_gives_back_what_it_was_given(tmp_path: Path) -> None:
    node = Dispersion(label="a", thrust=1.1)
    things = [
        None, True, 3, -0.0, math.inf, "text", (1, [2.0, ()]), {1: "a", "b": (2,)}, 1 + 2j, Path("a/b"), node,
        np.float64(0.1), np.int64(3), np.arange(6.0).reshape(2, 3), np.zeros((0, 2)), np.array([1 + 1e-30j]),
    ]  # fmt: skip  # a table
    PartsOnDisk(tmp_path).recall("part", 1.0, lambda: things)
    memory = PartsOnDisk(tmp_path)
    again = memory.recall("part", 1.0, list[Any])
    assert memory.recalled == 1
    for thing, other in zip(things, again, strict=True):
        assert type(other) is type(thing)
        assert np.array_equal(other, thing) if isinstance(thing, np.ndarray) else other == thing
    with pytest.raises(TypeError, match="no plain form of object"):
        memory.recall("part", 2.0, object)


@pytest.mark.parametrize(
    "name", ["os:system", "maxq.sim.files:write_whole", "maxq.sim.nothing:X", "builtins:eval", "maxq.sim.files:Path"]
)
def test_memory_makes_nothing_but_results(tmp_path: Path, name: str) -> None:
    memory = PartsOnDisk(tmp_path)
    memory.recall("part", 1.0, lambda: 7)
    (path,) = tmp_path.glob("part-*")
    rest = path.read_bytes().split(b"\n")[1] + b"\n" + json.dumps({name: ["true"]}).encode()
    path.write_bytes(hashlib.sha256(rest).hexdigest().encode() + b"\n" + rest)
    assert memory.recall("part", 1.0, lambda: 8) == 8
    assert (memory.recalled, memory.worked_out) == (0, 2)


def test_every_key_of_a_suite_says_what_it_means() -> None:
    def check(section: Any) -> None:
        for name, field in section.model_fields.items():
            if hasattr(field.annotation, "model_fields"):
                check(field.annotation)
            else:
                assert field.description or name in ("margins", "nominal", "dispersed"), name

    check(LinearMargins)


def test_ranking_puts_fewer_rejections_first() -> None:
    class Stub:
        def __init__(self, *merit: float) -> None:
            self.merit = merit

    worse, better = Stub(-2, 0, 0.5), Stub(-1, -3, 0.1)
    assert ranked([worse, better]) == [better, worse]  # type: ignore[arg-type,comparison-overlap]  # merit is all it asks
    assert callable(page_of)


def test_requirements_of_each_plane_stand_under_its_name() -> None:
    """Requirements of pitch and yaw are grouped by plane, instead of equal names in one list."""

    def asked(*wheres: str) -> list[JudgedRequirement]:
        return [JudgedRequirement("margins", "stable", "", "", "accepted", math.nan, where) for where in wheres]

    both = asked("", "5 s, pitch", "9 s, pitch", "", "5 s, yaw", "7 s, yaw", "")
    assert pack_report._headings(both) == [", pitch"] * 3 + [", yaw"] * 4
    assert pack_report._headings(asked("", "at 3 s", "5 s, pitch")) == [""] * 3


def test_the_summary_names_the_evidence_of_each_part() -> None:
    margins = SimpleNamespace(planes=("pitch", "yaw"), worst=SimpleNamespace(sigmas=2.5))
    results = SimpleNamespace(
        flights=[1, 2], margins=[SimpleNamespace(times_s=[1.0] * 9, random=[1] * 60, corners=[1] * 4)], measured=[]
    )
    parts = [("scenarios", "accepted"), ("margins", "rejected"), ("dispersed", "undecided"), ("worst", "accepted")]
    found: Any = SimpleNamespace(
        suite=SimpleNamespace(margins=margins, certificate=None),
        results=results,
        deviations="",
        campaigns=[],
        requirements=[SimpleNamespace(part=part, judgement=judgement) for part, judgement in parts],
    )
    assert [(row["name"], row["asked"], row["counts"]) for row in pack_report._summary(found)] == [
        ("scenarios", "2 flights, each within its limits", [1, 0, 0]),
        ("margins", "linear margins of the design at 9 operating points, pitch and yaw", [0, 1, 0]),
        ("dispersed", "the same of 64 dispersed vehicles", [0, 0, 1]),
        ("worst", "search for the worst vehicle within 2.5 sigma", [1, 0, 0]),
    ]
