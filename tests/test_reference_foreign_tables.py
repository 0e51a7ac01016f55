"""A layout reads files of other programs as tables: RASP motors, Missile DATCOM's for006, NASTRAN modes.

The samples follow the descriptions of the formats (thrustcurve.org, "RASP file format"; W. B. Blake, Missile DATCOM
user's manual, AFRL-VA-WP-TR-1998-3009); their numbers are invented.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import tomli_w
from pydantic_core import PydanticCustomError

from maxq import ScenarioError
from maxq.sim.input.foreign import read_datcom, read_drag_curve, read_rasp, read_rse
from maxq.sim.scenario.loader import load_scenario
from maxq.tools import simvehicle
from maxq.tools.vehicle.build import build, burning, m_alpha_1ps2
from maxq.tools.vehicle.layout import read_layout

NASTRAN = Path(__file__).parent / "data" / "nastran"
MOTOR = """\
; a made-up motor
;
M2500 98 800 P 400.0 520.0 Maker
   0.05 60000.0
   2.0 50000.0
   18.0 44000.0
   20.0 0.0
;
"""
PAGE = """\
1         ***** THE USAF AUTOMATED MISSILE DATCOM * REV 03/11 *****     AERODYNAMIC METHODS FOR MISSILE CONFIGURATIONS
 CASE    1                                                                                            PAGE    {page}
                         STATIC AERODYNAMICS FOR {what}

       ******* FLIGHT CONDITIONS AND REFERENCE QUANTITIES *******
        MACH NO    =   {mach:9.2f}        REYNOLDS NO =  3.000E+06 /M
        ALTITUDE   =        0.0 M      DYNAMIC PRESSURE =  25332.75 N/M**2
        SIDESLIP   =       {sideslip:.2f} DEG    ROLL            =       0.00 DEG
        REF AREA   =      0.283 M**2   MOMENT CENTER   =      7.000 M
        REF LENGTH =       0.60 M      LAT REF LENGTH  =       0.60 M

                 -----  LONGITUDINAL  -----     -----  LATERAL DIRECTIONAL  -----
      ALPHA      CN       CM       CA         CY       CLN      CLL

{rows}

      ALPHA      CL       CD     CL/CD    X-C.P.

       0.00    0.000    0.350    0.000   -1.200
"""


def page(what: str, mach: float, slope_pd: float, centre: float, sideslip: float = 0.0) -> str:
    """Return a page with CN = slope alpha and its centre `centre` reference lengths ahead of the moment centre.

    A negative `centre` is aft of it.
    """
    rows = [(a, slope_pd * a, centre * slope_pd * a, 0.35 + 0.01 * mach, 0.0, 0.0, 0.0) for a in (-4.0, 0.0, 4.0, 8.0)]
    lines = "\n".join("".join(f"{v:9.3f}" for v in row) for row in rows)
    return PAGE.format(page=4, what=what, mach=mach, rows=lines, sideslip=sideslip)


FOR006 = "".join(
    page("BODY ALONE", mach, 0.05, 5.0) + page("BODY-FIN SET 1", mach, slope, -4.0)
    for mach, slope in ((0.5, 0.2), (2.0, 0.25), (5.0, 0.15))
)


def test_a_rasp_motor_is_a_table_of_thrust() -> None:
    table = read_rasp(MOTOR, "motor.eng", "motor.eng")
    assert table["time_s"].tolist() == [0.0, 0.05, 2.0, 18.0, 20.0]
    assert table["thrust_vacuum_N"].tolist() == [0.0, 60000.0, 50000.0, 44000.0, 0.0]
    assert np.trapezoid(table["mass_flow_kgps"], table["time_s"]) == pytest.approx(400.0)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (MOTOR.replace("   20.0 0.0\n", ""), "the thrust does not end at 0"),
        (MOTOR.replace(" 400.0 520.0 Maker", ""), "is not the header of a RASP file"),
        (MOTOR.replace("2.0 50000.0", "2.0 fifty"), "is not a time and a thrust"),
        ("; nothing\n", "the file is empty"),
        (MOTOR.replace("2.0 50000.0", "2.0 1e300"), "holds a number that is not finite, or too large"),
        (MOTOR.replace(" 400.0 520.0", " nan 520.0"), "holds a number that is not finite, or too large"),
    ],
)
def test_broken_motors_are_refused(text: str, says: str) -> None:
    with pytest.raises(PydanticCustomError, match=says):
        read_rasp(text, "motor.eng", "motor.eng")


ROCKSIM = """\
<?xml version="1.0"?>
<engine-database><engine-list>
<engine code="M2500" mfg="Maker" dia="98." len="800." initWt="520000." propWt="400000." Type="single-use">
<comments>a made-up motor</comments>
<data>
<eng-data cg="400." f="0." m="400000." t="0."/>
<eng-data cg="400." f="60000." m="399000." t="0.05"/>
<eng-data cg="400." f="50000." m="280000." t="2."/>
<eng-data cg="400." f="44000." m="1000." t="18."/>
<eng-data cg="400." f="0." m="0." t="20."/>
</data>
</engine>
</engine-list></engine-database>
"""


def test_a_rocksim_motor_is_the_table_of_the_same_rasp_motor() -> None:
    table, rasp = read_rse(ROCKSIM, "motor.rse", "motor.rse"), read_rasp(MOTOR, "motor.eng", "motor.eng")
    for name in ("time_s", "thrust_vacuum_N", "mass_flow_kgps"):
        assert table[name].tolist() == pytest.approx(rasp[name].tolist(), rel=1e-12)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (MOTOR, "is not XML"),
        ("<engine-database/>", "holds no engine"),
        (ROCKSIM.replace('propWt="400000."', ""), "the engine cannot be read"),
        (ROCKSIM.replace('f="50000."', 'f="x"'), "the engine cannot be read"),
        (ROCKSIM.replace('<eng-data cg="400." f="0." m="0." t="20."/>', ""), "the thrust does not end at 0"),
    ],
)
def test_broken_rocksim_motors_are_refused(text: str, says: str) -> None:
    with pytest.raises(PydanticCustomError, match=says):
        read_rse(text, "motor.rse", "motor.rse")


@pytest.mark.parametrize("parting", [",", " ; ", "\t"])
def test_a_drag_curve_needs_no_names_of_columns(parting: str) -> None:
    text = f"# RocketPy\n0.0{parting}0.42\n1.05{parting}.7\n\n3{parting}3.1e-1\n"
    table = read_drag_curve(text, "drag.csv", "drag.csv")
    assert table is not None
    assert list(table.columns) == ["mach", "CD"]
    assert (table["mach"].tolist(), table["CD"].tolist()) == ([0.0, 1.05, 3.0], [0.42, 0.7, 0.31])
    assert read_drag_curve("mach,CD\n0,0.4\n", "drag.csv", "") is None
    assert read_drag_curve("0,0.4,1\n", "drag.csv", "") is None
    with pytest.raises(PydanticCustomError, match="is not two numbers"):
        read_drag_curve(text + "4, x\n", "drag.csv", "")


def test_a_vehicle_reads_a_drag_curve_and_a_rocksim_motor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drag.csv").write_text("0.0,0.42\n2.0,0.5\n")
    (tmp_path / "motor.rse").write_text(ROCKSIM)
    changes = ["vehicle.stage.0.aero.table=drag.csv", "vehicle.stage.0.engine.table=motor.rse"]
    stage = load_scenario("checkcases/two-stage", changes).scenario.vehicle.stage[0]
    assert stage.aero is not None
    assert stage.aero.table["CD"].tolist() == [0.42, 0.5]
    assert stage.own_engines[0].table["time_s"].tolist() == [0.0, 0.05, 2.0, 18.0, 20.0]
    (tmp_path / "drag.csv").write_text("2.0,0.5\n0.0,0.42\n")
    with pytest.raises(ScenarioError, match=r"drag\.csv.*line 2"):
        load_scenario("checkcases/two-stage", changes)


def test_datcom_pages_of_the_whole_configuration_count() -> None:
    table = read_datcom(FOR006, "for006.dat", "for006.dat")
    assert list(table.columns) == ["mach", "total_deg", "CN", "Cm", "CA"]
    assert table["mach"].tolist() == [0.5] * 3 + [2.0] * 3 + [5.0] * 3
    assert table["total_deg"].tolist() == [0.0, 4.0, 8.0] * 3
    assert table["CN"].tolist() == pytest.approx([0.0, 0.8, 1.6, 0.0, 1.0, 2.0, 0.0, 0.6, 1.2])
    assert table["Cm"].tolist() == pytest.approx([-4.0 * cn for cn in table["CN"]])
    assert table["CA"].tolist() == pytest.approx([0.355] * 3 + [0.37] * 3 + [0.4] * 3, abs=6e-4)


def test_datcom_with_lift_at_rest_is_a_table_over_alpha() -> None:
    lifting = FOR006.replace("    0.000   -0.000    0.355", "    0.020    0.001    0.355")
    table = read_datcom(lifting, "for006.dat", "")
    assert list(table.columns)[:3] == ["mach", "alpha_deg", "CN"]
    assert table["alpha_deg"].tolist() == [-4.0, 0.0, 4.0, 8.0] * 3


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("1  STATIC AERODYNAMICS FOR BODY ALONE\n", "holds no coefficients"),
        (page("BODY-FIN SET 1", 0.5, 0.2, -4.0, sideslip=2.0), "has sideslip"),
    ],
)
def test_other_datcom_output_is_refused(text: str, says: str) -> None:
    with pytest.raises(PydanticCustomError, match=says):
        read_datcom(text, "for006.dat", "for006.dat")


@pytest.fixture
def layout(tmp_path: Path) -> Path:
    """Return a sounding rocket of 14 m with all three formats."""
    (tmp_path / "motor.eng").write_text(MOTOR)
    (tmp_path / "for006.dat").write_text(FOR006)
    for file in NASTRAN.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    engine = {"thrust": "motor.eng", "gimbal_station_m": 13.5, "exit_station_m": 14.0, "mass_kg": 40.0}
    stage = {
        "name": "only",
        "front_station_m": 0.0,
        "rear_station_m": 13.5,
        "diameter_m": 0.6,
        "engine": engine,
        "part": [{"name": "all", "mass_kg": 700.0, "front_station_m": 0.2, "rear_station_m": 13.5}],
        "shell": [{"front_station_m": 0.0, "rear_station_m": 13.5, "wall_m": 0.002, "modulus_Pa": 7e10}],
        "grain": [{"mass_kg": 400.0, "front_station_m": 8.0, "rear_station_m": 13.0}],
        "aero": {"moment_reference_m": 7.0, "coefficients": [{"table": "for006.dat"}]},
        "spatial_modes": {"table": "beam.op2", "damping_ratio": [0.005] * 6},
    }
    tree = {
        "schema": 1,
        "nose_length_m": 1.5,
        "stage": [stage],
        "control": {"gyro_station_m": 2.0},
        "site": {"latitude_deg": 60.0, "longitude_deg": 20.0, "azimuth_deg": 0.0},
        "trajectory": {"final_path_angle_deg": 75.0, "pitch_over_start_s": 2.0, "pitch_over_s": 6.0},
    }
    (tmp_path / "rocket.toml").write_text(tomli_w.dumps(tree))
    return tmp_path / "rocket.toml"


def test_a_layout_takes_them_and_writes_a_vehicle(layout: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simvehicle.main([str(layout), "--out", str(layout.parent / "out")]) == 0
    printed = capsys.readouterr().out
    assert "axial force: a curve" not in printed
    assert "9.00" in printed  # NASTRAN's first mode
    loaded = load_scenario(layout.parent / "out" / "scenario.toml")
    stage = loaded.vehicle.stage[0]
    assert stage.engines[0].table["time_s"][-1] == 20.0
    assert stage.mass.table is not None
    assert np.ptp(stage.mass.table["mass_kg"]) == pytest.approx(400.0)
    assert stage.spatial_modes is not None
    assert stage.spatial_modes.modes.frequency_hz[0, 0] == pytest.approx(9.0)
    assert stage.aero is not None
    assert len(stage.aero.coefficients[0].table) == 9


def test_m_alpha_is_datcom_s(layout: Path) -> None:
    built = build(read_layout(layout))
    p = min(burning(built), key=lambda p: abs(p.mach - 2.0))
    props, area = built.stacks[0].mass_properties(p.clock_s), 0.25 * math.pi * 0.6**2
    force = p.dynamic_pressure_Pa * area * math.degrees(np.interp(p.mach, [0.5, 2.0, 5.0], [0.2, 0.25, 0.15]))
    centre = 7.0 + 4.0 * 0.6
    assert m_alpha_1ps2(built, p) == pytest.approx(-force * (centre - props.x_cg_m) / props.pitch_kgm2, rel=1e-2)


def test_propellant_that_does_not_match_the_file_is_said(layout: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = layout.read_text().replace("mass_kg = 400.0", "mass_kg = 300.0")
    layout.write_text(text)
    simvehicle.main([str(layout), "--out", str(layout.parent / "out")])
    assert "its thrust file burns 400 kg, the stage holds 300 kg" in capsys.readouterr().out
    (layout.parent / "motor.eng").write_text("; nothing\n")
    with pytest.raises(ScenarioError, match=r"motor\.eng: the file is empty"):
        read_layout(layout)
