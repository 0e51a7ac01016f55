"""Every wrong input gives one line that names file, key, value, what is wrong and what is allowed."""

from __future__ import annotations

import os
import pickle
import re
import tomllib
from pathlib import Path

import pytest
from scenario_files import modes_csv, write_ascent, write_free

from maxq import ScenarioError
from maxq.sim.input.errors import suggestion
from maxq.sim.scenario.loader import load_scenario, load_scenario_text

VEHICLE = "vehicles/rocket/vehicle.toml"
MODES = "vehicles/rocket/modes.csv"
WIND = "winds/west.csv"
ASCENT = "ascent.toml"
MISTAKES = tomllib.loads((Path(__file__).parent / "data" / "scenario_mistakes.toml").read_text())["mistake"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    write_ascent(tmp_path)
    return tmp_path


def said_of(scenario: str | Path, *overrides: str) -> str:
    """Return the error line that the user reads."""
    with pytest.raises(ScenarioError) as caught:
        load_scenario(scenario, overrides)
    line = str(caught.value)
    assert "\n" not in line
    return line


def test_the_files_are_right_before_they_are_spoilt(here: Path) -> None:
    assert load_scenario("ascent.toml").name == "ascent"


@pytest.mark.parametrize("mistake", MISTAKES, ids=lambda mistake: mistake["says"][:60])
def test_a_mistake_is_said_in_one_line(here: Path, mistake: dict[str, str]) -> None:
    spoilt = here / mistake["file"]
    text = spoilt.read_text()
    assert mistake["old"] in text
    spoilt.write_text(text.replace(mistake["old"], mistake["new"], 1))
    line = said_of("ascent.toml")
    assert line.startswith(f"{mistake.get('shown', mistake['file'])}: "), line
    assert mistake["says"] in line, line


def test_a_file_that_is_not_there(here: Path) -> None:
    assert said_of("ascend.toml").startswith("ascend.toml: no such file; allowed: a scenario file (.toml)")
    assert said_of("winds").startswith("winds: is a folder; allowed: a scenario file (.toml)")
    assert said_of("").startswith('"": no such file; allowed: a scenario file (.toml)')
    assert said_of("a\0b.toml").startswith("a\\x00b.toml: no such file; allowed: a scenario file (.toml)")
    assert said_of("x" * 5000).startswith("x" * 236 + " ...: neither a file nor a built-in scenario; allowed: ")


def test_a_name_that_is_neither_a_file_nor_ours(here: Path) -> None:
    """A name that is neither a file nor built in is rejected without the long list of all names."""
    assert said_of("zzz") == (
        "zzz: neither a file nor a built-in scenario; allowed: a scenario file (.toml), "
        "or a built-in scenario (simrun --list names them)"
    )
    assert said_of("nominla") == "nominla: no such file; did you mean nominal? Allowed: a scenario file (.toml)"


def test_a_file_that_is_nearly_there(here: Path) -> None:
    """The message suggests a file with a similar path, or one with this name in another folder."""
    for key, asked, meant in (
        ("design", "designs/trail.toml", "designs/trial.toml"),
        ("vehicle", "vehicles/rockte", "vehicles/rocket"),
        ("vehicle", "ksr3", "vehicles/ksr3"),
        ("design", "ksr3-default", "designs/ksr3-default.toml"),
        ("wind.profile", "winds/wset.csv", "winds/west.csv"),
        ("wind.profile", "anheung-november", "winds/anheung-november.csv"),
    ):
        line = said_of("ascent.toml", f"{key}={asked}")
        assert line.startswith(f'--set: {key} = "{asked}": no such file; did you mean {meant}? Allowed: '), line
    assert "no such file; allowed: " in said_of("ascent.toml", "design=no/such/folder.toml")
    assert "no such file; allowed: " in said_of("ascent.toml", "wind.profile=zzz.csv")


def test_a_line_that_is_no_toml_is_shown(here: Path) -> None:
    for wrong in ("altitude_m = 30,0", "name = ascent", "[run"):
        (here / "wrong.toml").write_text(f"schema = 1\n  {wrong}\n")
        line = said_of("wrong.toml")
        assert line.startswith("wrong.toml: is not valid TOML: ")
        assert line.endswith(f": {wrong}"), line
        assert "(at line 2, column " in line
    (here / "wrong.toml").write_text("a = [1,\n")
    assert said_of("wrong.toml").startswith("wrong.toml: is not valid TOML: ")
    (here / "wrong.toml").write_text("a = " + "9" * 500 + "x\n")
    assert len(said_of("wrong.toml")) < 250


@pytest.mark.parametrize("key", ["extends", "unset", "vehicle.extends", "vehicle_overrides.unset", "design.extends"])
def test_what_works_in_a_file_only(here: Path, key: str) -> None:
    line = said_of("ascent.toml", f"{key}=x")
    assert line.startswith(f'--set: {key} = "x": works in a file only; allowed: ')
    assert "did you mean" not in line


@pytest.mark.parametrize("text", ["/dev/stdin", "~/x", "2026-02-30", "noon"])
def test_a_date_that_is_none(here: Path, text: str) -> None:
    line = said_of("ascent.toml", f"site.utc={text}")
    assert line == f'--set: site.utc = "{text}": is not a date and time; allowed: ISO 8601, as 2026-01-31T12:00:00Z'


@pytest.mark.parametrize(
    ("at", "kind", "key", "hz"),
    [
        ("gimbal_command", "sine", "frequency_hz", "50.1"),
        ("rate_command", "multisine", "frequencies_hz", "[1.0, 50.1]"),
        ("gimbal_command", "chirp", "stop_frequency_hz", "50.1"),
    ],
)
def test_a_signal_above_half_of_the_sample_rate(here: Path, at: str, kind: str, key: str, hz: str) -> None:
    """The flight computer takes 100 samples a second. A force on the body has no samples."""
    start = "frequency_hz=1.0," if kind == "chirp" else ""
    amplitude = "amplitude_deg" if at == "gimbal_command" else "amplitude_degps"
    signal = f'injection=[{{{{at="{at}",axis="pitch",kind="{kind}",{start}{key}={{}},stop_s=9.0,{amplitude}=0.1}}}}]'
    line = said_of("ascent.toml", signal.format(hz))
    assert line == f"--set: injection.0.{key} = {hz}: would alias; allowed: at most 50 Hz, half of the sample rate"
    load_scenario("ascent.toml", [signal.format(hz.replace("50.1", "50.0"))])
    free = signal.format(hz).replace(at, "body_force").replace("pitch", "x").replace(amplitude, "amplitude_N")
    load_scenario("ascent.toml", [free])


def test_times_that_no_flight_lasts(here: Path) -> None:
    assert said_of("ascent.toml", "run.duration_s=1e12") == (
        "--set: run.duration_s = 1000000000000.0: is longer than any flight; "
        "allowed: times up to 1e+08 s, which are three years"
    )
    assert "log.fast_hz = 1e-12: has a period longer than any flight" in said_of("ascent.toml", "log.fast_hz=1e-12")


def test_a_binary_file(here: Path) -> None:
    (here / "binary.toml").write_bytes(b"\x7fELF\x02\x01\xff\xfe" * 50)
    assert said_of("binary.toml") == (
        "binary.toml: is not text: byte 0xff at position 6; allowed: a TOML file in UTF-8"
    )
    (here / "zeros.toml").write_bytes(bytes(200))
    assert "is a binary file: it holds zero bytes" in said_of("zeros.toml")
    (here / WIND).write_bytes(b"PK\x03\x04\xff")
    assert said_of("ascent.toml") == f"{WIND}: is not text: byte 0xff at position 4; allowed: a CSV file in UTF-8"


def test_toml_that_python_cannot_hold(here: Path) -> None:
    (here / "deep.toml").write_text("a = " + "[" * 5000)
    assert said_of("deep.toml").startswith("deep.toml: is not valid TOML: ")
    (here / "long.toml").write_text("seed = " + "9" * 6000)
    assert said_of("long.toml").startswith("long.toml: is not valid TOML: ")
    assert said_of("ascent.toml", "run.duration_s=" + "9" * 400).startswith("--set: run.duration_s = 999")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no pipes")
def test_what_is_no_ordinary_file(here: Path) -> None:
    os.mkfifo(here / "pipe.toml")
    assert said_of("pipe.toml").startswith("pipe.toml: is not an ordinary file; allowed: a scenario file")


def test_a_file_that_may_not_be_read(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Path.read_bytes

    def refuse_winds(path: Path) -> bytes:
        if path.name == "west.csv":
            raise PermissionError(13, "Permission denied")
        return real(path)

    monkeypatch.setattr(Path, "read_bytes", refuse_winds)
    assert said_of("ascent.toml") == f"{WIND}: cannot be read: permission denied; allowed: a file you may read"


def test_extends_in_a_loop(here: Path) -> None:
    (here / "a.toml").write_text('extends = "b.toml"\n')
    (here / "b.toml").write_text('extends = "a"\n')
    line = said_of("a.toml")
    assert line == 'b.toml: extends = "a": files extend each other in a loop: a.toml -> b.toml -> a.toml'
    (here / "self.toml").write_text('extends = "self.toml"\n')
    assert "loop: self.toml -> self.toml" in said_of("self.toml")


def test_extends_of_what_is_not_there(here: Path) -> None:
    (here / "a.toml").write_text('extends = "missing"\n')
    assert said_of("a.toml").startswith('a.toml: extends = "missing": no such file; allowed: a scenario file')
    (here / "a.toml").write_text("extends = 3\n")
    assert said_of("a.toml").startswith("a.toml: extends = 3: has the wrong type; allowed: the name of ")
    (here / "a.toml").write_text('extends = "ascent.toml"\nunset = ["wind.profil"]\n')
    assert said_of("a.toml") == ("a.toml: unset.wind.profil: there is no such key to remove; did you mean profile?")
    (here / "a.toml").write_text('unset = ["wind.profile"]\nvehicle = "vehicles/rocket"\n')
    assert said_of("a.toml").startswith("a.toml: unset: there is nothing to remove keys from")


def test_the_file_that_says_it_is_named(here: Path) -> None:
    """An error names the file that contains the wrong value, not the file that was requested."""
    (here / "child.toml").write_text('extends = "ascent.toml"\n[run]\nstep_s = -1.0\n')
    assert said_of("child.toml").startswith("child.toml: run.step_s = -1.0: is out of range")
    (here / "child.toml").write_text('extends = "ascent.toml"\n[run]\nstep_s = 0.01\n')
    (here / ASCENT).write_text((here / ASCENT).read_text().replace("duration_s = 300.0", "duration_s = -3.0"))
    assert said_of("child.toml").startswith("ascent.toml: run.duration_s = -3.0: is out of range")


def test_overrides_that_are_wrong(here: Path) -> None:
    assert said_of("ascent.toml", "run.step_s").startswith("--set: run.step_s: has no '='; allowed: --set KEY=VALUE")
    assert said_of("ascent.toml", "run..step_s=1").startswith("--set: run..step_s: is not the path of a key")
    assert said_of("ascent.toml", "run.step=1") == "--set: run.step = 1: unknown key; did you mean step_s?"
    assert said_of("ascent.toml", "run.step_s=fast").startswith('--set: run.step_s = "fast": has the wrong type')
    assert said_of("ascent.toml", "vehicle.stage.1.name=x") == (
        "--set: vehicle.stage.1.name: 1 is not an element of this list; allowed: an index 0 .. 0"
    )
    assert said_of("ascent.toml", "vehicle.stage.0.tank.0.damping=0.1").startswith(
        "--set: vehicle.stage.0.tank.0.damping = 0.1: unknown key; did you mean damping_ratio?"
    )
    assert said_of("ascent.toml", "run.duration_s.x=1") == (
        "--set: run.duration_s.x: run.duration_s is a value and has no keys below it"
    )
    assert said_of("ascent.toml", "run.step_s=1\nx=3").startswith('--set: run.step_s = "1\\nx=3": has the wrong')
    assert said_of("ascent.toml", "design.gain.yaw=pitch").startswith(
        '--set: design.gain = {yaw = "pitch"}: unknown key; did you mean gains?'
    )
    assert said_of("ascent.toml", "wind.profil=") == (
        "--set: wind.profil: there is no such key to remove; did you mean profile?"
    )


def test_overrides_in_files_that_are_wrong(here: Path) -> None:
    text = (here / ASCENT).read_text()
    (here / ASCENT).write_text(text + "[vehicle_overrides]\nstage.0.tank.0.damping_ratio = 3.0\n")
    assert said_of("ascent.toml").startswith(
        "ascent.toml: vehicle_overrides.stage.0.tank.0.damping_ratio = 3.0: is out of range; allowed:"
    )
    (here / ASCENT).write_text(text + "[design_overrides]\nfilter.zero_hz = 3.0\n")
    assert said_of("ascent.toml").startswith("ascent.toml: design_overrides.filter.zero_hz = 3.0: unknown key")
    (here / ASCENT).write_text(text.replace('design = "designs/trial.toml"\n', "") + "[design_overrides]\nname='x'\n")
    assert said_of("ascent.toml") == "ascent.toml: design_overrides: the scenario has no design"


def test_a_vehicle_without_thrust_is_never_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = write_free(tmp_path)
    path.write_text('vehicle = "brick"\n')
    assert "is held down until thrust exceeds weight, but it has no thrust" in said_of("free.toml")
    path.write_text('vehicle = "brick"\n[initial]\nheld = false\n')
    assert load_scenario("free.toml").scenario.held is False


@pytest.mark.parametrize(
    "inertia",
    [
        "[[1,0,0],[0,1,0],[0,0,2.1]]",
        "[[1,2,0],[2,1,0],[0,0,1]]",
        "[[1,0.1,0],[0,1,0],[0,0,1]]",
        "[[0,0,0],[0,1,0],[0,0,1]]",
    ],
)
def test_inertia_that_no_body_can_have(tmp_path: Path, inertia: str) -> None:
    path = write_free(tmp_path)
    line = said_of(path, f"vehicle.stage.0.mass.inertia_kgm2={inertia}")
    assert line.startswith("--set: vehicle.stage.0.mass.inertia_kgm2 = [[")
    assert "no rigid body has this inertia" in line or "is symmetric" in line


def test_too_many_modes_and_tanks(here: Path) -> None:
    (here / MODES).write_text(modes_csv(modes=13))
    allowed = "allowed: mode numbers 1 .. 12"
    assert said_of("ascent.toml") == f"{MODES}: line 38, mode = 13.0: too many modes (and in 5 more rows); {allowed}"
    (here / MODES).write_text(modes_csv())
    tank = '[[stage.tank]]\ntable = "tank.csv"\ndamping_ratio = 0.02\n'
    text = (here / VEHICLE).read_text()
    (here / VEHICLE).write_text(text.replace("[stage.bending]", 7 * tank + "[stage.bending]"))
    assert len(load_scenario("ascent.toml").vehicle.stage[0].tank) == 8
    (here / VEHICLE).write_text(text.replace("[stage.bending]", 8 * tank + "[stage.bending]"))
    assert "stage.0.tank = [" in said_of("ascent.toml")
    assert "has too many elements; allowed: a list of tables, at most 8" in said_of("ascent.toml")


def test_text_from_a_log_cannot_name_files(here: Path) -> None:
    with pytest.raises(ScenarioError, match="names a file, which a scenario given as text cannot do"):
        load_scenario_text((here / ASCENT).read_text())
    with pytest.raises(ScenarioError, match="self-contained"):
        load_scenario_text('extends = "ascent.toml"')


def test_more_mistakes_are_counted(here: Path) -> None:
    assert said_of("ascent.toml", "run.step_s=-1", "run.seed=-1", "log.fast_hz=0").endswith("(and 2 more)")


def test_the_error_survives_another_process() -> None:
    error = ScenarioError("a.toml", "is wrong", "x.y", value="two\nlines", allowed="less", more=3)
    assert str(pickle.loads(pickle.dumps(error))) == str(error)
    assert str(error) == 'a.toml: x.y = "two\\nlines": is wrong; allowed: less (and 3 more)'


@pytest.mark.parametrize(
    ("word", "known", "expected"),
    [
        ("altitude_km", ["altitude_m", "latitude_deg"], "altitude_m"),
        ("rate_BI_degs", ["rate_BI_radps", "rate_BI_degps"], "rate_BI_degps"),
        ("altitude", ["latitude_deg", "altitude_m"], "altitude_m"),
        ("qqq", ["altitude_m"], ""),
    ],
)
def test_suggestions(word: str, known: list[str], expected: str) -> None:
    assert re.findall(r"did you mean (\w+)\?", suggestion(word, known)) == ([expected] if expected else [])


ODD_VALUES = [  # make test tries every fourth, make test-long all
    "",
    "true",
    "-1",
    "0",
    "nan",
    "1e300",
    '"text"',
    "2002-11-28",
    "[]",
    "[[]]",
    "[{}]",
    "{}",
    "9" * 400,
    "1e-320",
]


def keys_below(value: object, path: str = "") -> list[str]:
    """Return the paths of everything in a TOML document."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = [path] if path else []
    for key, item in list(items) if isinstance(value, dict) else list(items)[:2]:
        found += keys_below(item, f"{path}.{key}".lstrip("."))
    return found


@pytest.mark.slow
@pytest.mark.parametrize(
    "odd",
    [
        pytest.param(odd, id=odd[:10] or "removed", marks=pytest.mark.long if n % 4 else [])
        for n, odd in enumerate(ODD_VALUES)
    ],
)
def test_no_value_of_any_key_gives_a_traceback(here: Path, odd: str) -> None:
    """Every key of a full scenario takes an odd value in turn: it is accepted, or rejected with a one-line error."""
    text = load_scenario("ascent.toml").as_flown
    lines = []
    for key in keys_below(tomllib.loads(load_scenario("ascent.toml", ["injection=[]"]).as_flown)):
        try:
            load_scenario_text(text, [f"{key}={odd}"])
        except ScenarioError as error:
            lines.append(str(error))
    assert len(lines) > 50
    assert [line for line in lines if "\n" in line or not line.startswith(("--set: ", "scenario as "))] == []
