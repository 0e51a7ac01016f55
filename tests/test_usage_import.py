"""`simvehicle import`: its table, its file, and one line for each kind of wrong input."""

from __future__ import annotations

import gzip
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import orkkit
import pytest

from maxq import ScenarioError
from maxq.sim.input import xml_tree
from maxq.tools import simvehicle
from maxq.tools.vehicle import openrocket
from maxq.tools.vehicle.airframe import equivalent_trapezoid, revolved
from maxq.tools.vehicle.airframe_layout import write_layout
from maxq.tools.vehicle.build import build, warnings
from maxq.tools.vehicle.layout import read_layout
from maxq.tools.vehicle.openrocket import SHAPES, read_openrocket
from maxq.tools.vehicle.report import tables


def test_the_command_says_what_was_taken_assumed_and_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    design = orkkit.write_design(tmp_path, orkkit.xml())
    drag = tmp_path / "cd.csv"
    drag.write_text("0.0, 0.5\n2.0, 0.4\n")
    assert simvehicle.main(["import", str(design), "--drag", str(drag), "--out", str(tmp_path / "out")]) == 0
    out = " ".join(capsys.readouterr().out.split())
    for words in (
        "taken components 2 stages, 19 components, ",
        "taken drag ",
        "assumed stiffness Young's modulus by the name of the material: nose 20 GPa; tube 20 GPa",
        "assumed free fins trapezoid of the same area",
        "missing tube fins normal force of tube fins",
        "missing recovery the flight ends at the apogee",
    ):
        assert words in out
    layout = (tmp_path / "out" / "layout.toml").read_text()
    assert layout.startswith("# Every component: imported from ")
    assert "# missing: recovery: the flight ends at the apogee\n" in layout
    aero = read_layout(tmp_path / "out" / "layout.toml").stage[0].aero
    assert aero is not None
    assert np.interp(1.0, aero.table["mach"], aero.table["CA"]) == pytest.approx(0.45, rel=1e-12)


def test_overrides_of_mass_and_centre_are_those_of_the_design(tmp_path: Path) -> None:
    mass = "<overridemass>0.5</overridemass><overridecg>0.1</overridecg>"
    below = '<masscomponent><name>bay</name><axialoffset method="top">0.0</axialoffset><packedlength>0.2</packedlength>'
    below += "<mass>1.0</mass></masscomponent>"
    whole = mass + "<overridesubcomponentsmass>true</overridesubcomponentsmass>"
    whole += "<overridesubcomponentscg>true</overridesubcomponentscg>"
    plain = read_openrocket(orkkit.write_design(tmp_path, orkkit.xml()))
    text = (
        orkkit.xml(nose=mass)
        .replace("<length>0.4</length>", f"<length>0.4</length>{whole}")
        .replace("<thickness>0.002</thickness></tubecoupler>", f"<thickness>0.002</thickness></tubecoupler>{below}")
    )
    changed = read_openrocket(orkkit.write_design(tmp_path, text))
    nose = changed.stages[0].pieces[0]
    assert (nose.mass_kg, nose.station_m) == (0.5, pytest.approx(0.1, rel=1e-12))
    assert changed.stages[0].pieces[1:] == plain.stages[0].pieces[1:]
    booster = changed.stages[1].pieces[1:]
    total = sum(p.mass_kg for p in booster)
    assert total == pytest.approx(0.5, rel=1e-12)
    centre = orkkit.NOSE_m + orkkit.TUBE_m + orkkit.CONE_m + 0.1
    assert sum(p.mass_kg * p.station_m for p in booster) / total == pytest.approx(centre, rel=1e-12)


@pytest.mark.parametrize("packed", [str.encode, lambda text: gzip.compress(text.encode())])
def test_designs_of_old_versions_are_read(tmp_path: Path, packed: Callable[[str], bytes]) -> None:
    design = orkkit.write_design(tmp_path, orkkit.xml())
    design.write_bytes(
        packed(orkkit.xml().replace("axialoffset method", "position type").replace("axialoffset", "position"))
    )
    mass = sum(p.mass_kg for stage in read_openrocket(design).stages for p in stage.pieces)
    assert mass == pytest.approx(sum(kg for _, kg, _ in orkkit.closed_forms()), rel=1e-9)


_POD = "<podset><name>pods</name></podset>"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"PK\x05\x06" + bytes(18), "cannot be unpacked (the archive holds no rocket.ork)"),
        (b"PK\x03\x04 no archive", "cannot be unpacked (File is not a zip file)"),
        (b"", "line 1: is not XML (no element found)"),
        (b'<!DOCTYPE a [<!ENTITY b "c">]><openrocket>&b;</openrocket>', "line 1: has a document type"),
        (b"<openrocket>" + b"<a>" * 300, "is nested more than 200 deep"),
        (b"<rocksim/>", "holds <rocksim>, not a rocket"),
        (b"<openrocket><rocket/></openrocket>", "has no stage"),
        (orkkit.xml(upper="<rotor/>").encode(), "rotor: is not a known component; allowed: trapezoidfinset"),
        (orkkit.xml(lower=_POD).encode(), "podset 'pods': pods are not imported"),
        (
            orkkit.xml().replace("<length>0.6", "<length>-0.6").encode(),
            "bodytube 'tube', length: is -0.6; allowed: a number above 0",
        ),
        (
            orkkit.xml().replace("<length>0.6", "<length>1e300").encode(),
            "length: is 1e300; allowed: a number above 0, up",
        ),
        (orkkit.xml().replace("<instancecount>2", "<instancecount>1e6").encode(), "instancecount: is 1000000"),
        (
            orkkit.xml().replace("<shape>c", "<shapeparameter>2</shapeparameter><shape>c").encode(),
            "shapeparameter: is 2",
        ),
        (orkkit.xml().replace("<mass>0.4", "<mass>nan").encode(), "masscomponent 'payload', mass: is nan"),
        (orkkit.xml().replace("<shape>conical", "<shape>bulb", 1).encode(), "nosecone 'nose', shape: is bulb; allowed"),
        (orkkit.xml().replace("M38-P", "X1").encode(), "stage 'Upper stage': there is no thrust curve of its motor X1"),
        (orkkit.xml().replace('motor configid="one"', 'motor configid="two"', 1).encode(), "has no mount with a motor"),
        (orkkit.xml().replace("<thickness>0.003</thickness>", "<thickness>thin</thickness>").encode(), "is thin"),
    ],
)
def test_wrong_designs_are_one_line(tmp_path: Path, content: bytes, said: str) -> None:
    design = orkkit.write_design(tmp_path, orkkit.xml())
    design.write_bytes(content)
    with pytest.raises(ScenarioError) as error:
        read_openrocket(design)
    assert said in str(error.value)


def test_no_more_is_unpacked_than_the_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A bomb of 3 MiB with the limit at 1 MiB instead of 64 MiB."""
    design = orkkit.write_design(tmp_path, orkkit.xml())
    for module in (openrocket, xml_tree):
        monkeypatch.setattr(module, "MOST_BYTES", 1024**2)
    bomb = "<openrocket><rocket/></openrocket>" + " " * (3 * 1024**2)
    for content in (orkkit.zipped(bomb), gzip.compress(bomb.encode()), bomb.encode()):
        design.write_bytes(content)
        with pytest.raises(ScenarioError, match="holds more than 1 MiB of XML"):
            read_openrocket(design)


def test_motors_are_those_given(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    design, other = orkkit.write_design(tmp_path, orkkit.xml(), []), tmp_path / "motors"
    other.mkdir()
    rse = '<engine-database><engine-list><engine code="N38" dia="38" len="200" initWt="350" propWt="200"><data>'
    rse += '<eng-data t="0.1" f="100"/><eng-data t="1.0" f="0"/></data></engine></engine-list></engine-database>'
    (other / "n.rse").write_text(rse)
    (other / "m.eng").write_text(orkkit.MOTOR.format(name="M38", propellant=0.2, total=0.1, peak=9.0))
    given = [f"N38={other / 'n.rse'}", f"M38-P={other / 'n.rse'}"]
    lower = read_openrocket(design, given).stages[1].motor
    assert (lower.propellant_kg, lower.case_kg) == (pytest.approx(0.2, rel=1e-12), pytest.approx(0.15, rel=1e-12))
    assert lower.thrust_N.tolist() == [0.0, 100.0, 0.0]
    assert simvehicle.main(["import", str(design), "--motor", f"N38={other / 'm.eng'}"]) == 2
    assert "motor M38 has 0.2 kg of propellant in 0.1 kg" in capsys.readouterr().err
    assert simvehicle.main(["import", str(tmp_path / "none.ork")]) == 2
    assert "none.ork: cannot be read: no such file or directory" in capsys.readouterr().err
    curve = "".join(
        f"<thrustcurvepoint>{row}</thrustcurvepoint>" for row in ("0,0,0.1,0.35", "0.1,50,0.1,0.3", "1,0,0.1,0.2")
    )
    text = orkkit.xml().replace("</designation>", f"</designation>{curve}")
    inside = read_openrocket(orkkit.write_design(tmp_path, text, [])).stages[0].motor
    assert (inside.propellant_kg, inside.case_kg) == (pytest.approx(0.15, rel=1e-12), 0.2)


@pytest.mark.parametrize(
    ("shape", "parameter", "volume"),
    [
        ("conical", 0.0, math.pi / 3.0),
        ("ellipsoid", 0.0, 2.0 * math.pi / 3.0),
        ("power", 0.5, math.pi / 2.0),
        ("parabolic", 1.0, 8.0 * math.pi / 15.0),
        ("haack", 1.0 / 3.0, math.pi * 9.0 / 16.0),
        ("haack", 0.0, math.pi / 2.0),
    ],
)
def test_shapes_of_noses_have_the_volumes_of_the_literature(shape: str, parameter: float, volume: float) -> None:
    """Volumes in units of radius^2 and length, by integration by hand; Haack's LV has 9/16, von Karman's 1/2."""
    wall, full, side, _ = revolved(lambda x: SHAPES[shape](x, 0.1, 0.4, parameter), 0.4, 0.001)
    assert full.volume_m3 == pytest.approx(volume * 0.1**2 * 0.4, rel=1e-9)
    assert 0.0 < wall.volume_m3 < full.volume_m3
    assert 0.04 * (1.0 - 1e-9) <= side < 0.08  # between a cone and a cylinder


def test_a_tangent_ogive_has_its_closed_form() -> None:
    rho = (0.4**2 + 0.1**2) / 0.2
    volume = math.pi * (0.4 * rho**2 - 0.4**3 / 3.0 - (rho - 0.1) * rho**2 * math.asin(0.4 / rho))
    _, full, _, _ = revolved(lambda x: SHAPES["ogive"](x, 0.1, 0.4, 1.0), 0.4, None)
    assert full.volume_m3 == pytest.approx(volume, rel=1e-9)


def test_an_elliptical_fin_becomes_a_trapezoid_with_its_mean_chord() -> None:
    """Half an ellipse: area pi c s / 4, mean aerodynamic chord 8 c / (3 pi), symmetric about its middle."""
    y = 0.08 * np.sin(np.linspace(0.0, 0.5 * math.pi, 4001))
    chord = 0.1 * np.sqrt(np.maximum(1.0 - (y / 0.08) ** 2, 0.0))
    root, tip, sweep, shift = equivalent_trapezoid(y, 0.5 * (0.1 - chord), chord)
    assert 0.5 * (root + tip) * 0.08 == pytest.approx(math.pi * 0.1 * 0.08 / 4.0, rel=1e-6)
    mean = 2.0 / 3.0 * (root + tip - root * tip / (root + tip))
    assert mean == pytest.approx(8.0 * 0.1 / (3.0 * math.pi), rel=1e-5)
    assert sweep == pytest.approx(0.5 * (root - tip), abs=1e-9)
    assert shift + sweep / 3.0 * (root + 2.0 * tip) / (root + tip) + 0.5 * mean == pytest.approx(0.05, abs=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[rail]\nlength_m = 2.5\nelevation_deg = 85.0\n", "", "rail: an unguided vehicle needs a rail"),
        ('gimbal = "fixed"\n', 'gimbal = "both"\n', "stage.0.engine.mass_kg = 0.0: a gimballed engine has mass"),
        ('gimbal = "fixed"\n', "mass_kg = 1.0\n", 'engine.gimbal = "fixed": other stages have gimbals'),
        ('gimbal = "fixed"\n', 'gimbal = "fixed"\nangle_limit_deg = 5.0\n', "has no meaning here"),
        ("[control]\n", "[trajectory]\norbit_altitude_m = 2e5\n\n[control]\n", "an unguided vehicle does not steer"),
    ],
)
def test_layouts_are_unguided_in_every_stage_or_in_none(tmp_path: Path, old: str, new: str, said: str) -> None:
    design = orkkit.write_design(tmp_path, orkkit.xml())
    path = write_layout(read_openrocket(design), tmp_path)
    text = path.read_text()
    assert old in text
    text = text.replace(old, new, 1)
    if new == "mass_kg = 1.0\n":
        text = text.replace("mass_kg = 0.0\n", "", 1)
    path.write_text(text)
    with pytest.raises(ScenarioError) as error:
        read_layout(path)
    assert said in str(error.value)


def test_a_rocket_with_small_fins_is_unusual(tmp_path: Path) -> None:
    """The upper stage with fins of 1 mm has its centre of pressure near that of its nose, ahead of the CG."""
    design = orkkit.write_design(tmp_path, orkkit.xml().replace("<height>0.06</height>", "<height>0.001</height>"))
    built = build(read_layout(write_layout(read_openrocket(design), tmp_path)))
    lines = [line for line in warnings(built) if line.startswith("upper_stage: static margin -")]
    assert len(lines) == 1
    assert lines[0].endswith("usual are 1 and more")
    rows = next(table.rows for table in tables(built) if table.heading == "Static stability")
    margin = float(rows[-1][rows[0].index("static margin")])
    centre, cg = (float(rows[-1][rows[0].index(name)]) for name in ("CP, m", "CG, m"))
    assert margin == pytest.approx((centre - cg) / 0.1, abs=0.02)
    assert centre == pytest.approx(0.2, abs=0.03)  # two thirds of the nose


def test_the_drag_is_that_of_the_stored_simulation(tmp_path: Path) -> None:
    """The coefficients are 0.5 + 0.1 M under thrust and 0.6 + 0.1 M in the coast; those of the fall do not count."""
    machs = np.linspace(0.05, 0.85, 17)
    rise = [(0.1 * k, 10.0 * k, m, 250.0, 0.5 + 0.1 * m) for k, m in enumerate(machs)]
    coast = [(2.0 + 0.1 * k, 200.0 + 10.0 * k, m, 0.0, 0.6 + 0.1 * m) for k, m in enumerate(machs[::-1])]
    fall = [(5.0, 100.0, 0.3, 0.0, 9.0), (5.1, 90.0, 0.31, 0.0, math.nan)]
    points = "".join(f"<datapoint>{','.join(map(str, row))}</datapoint>" for row in (*rise, *coast, *fall))
    types = "Time,Altitude,Mach number,Thrust,Axial drag coefficient"
    text = orkkit.xml()
    text = text[: text.index("<stage><name>Lower")] + text[text.index("</subcomponents></rocket>") :]
    data = f'<flightdata><databranch types="{types}">{points}</databranch></flightdata></simulation>'
    airframe = read_openrocket(orkkit.write_design(tmp_path, text.replace("</simulation>", data)))
    assert airframe.axial is not None
    mach, powered, coasting = airframe.axial
    assert np.interp(0.45, mach, powered) == pytest.approx(0.545, abs=1e-9)
    assert np.interp(0.45, mach, coasting) == pytest.approx(0.645, abs=1e-9)
    assert ("taken", "drag", "axial force coefficient of the stored simulation first") in airframe.remarks
