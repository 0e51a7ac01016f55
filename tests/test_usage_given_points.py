"""Operating points from published derivatives and from matrices work in files, commands and Python."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

import maxq
from maxq import ScenarioError
from maxq.design.case.schema import read_case
from maxq.tools import simdesign

SMALL = """
schema = 1
name = "two rows"
coefficients = [
    {time_s = 0.0, V_mps = 0.0, A6_1ps2 = 0.0, K1_1ps2 = 4.0, a1_1ps = 0.0, a3_mps2 = 15.0, a4_mps2 = -14.0},
    {time_s = 10.0, V_mps = 100.0, A6_1ps2 = 1.0, K1_1ps2 = 5.0, a1_1ps = -0.01, a3_mps2 = 20.0, a4_mps2 = -16.0},
    {time_s = 20.0, V_mps = 300.0, A6_1ps2 = 2.0, K1_1ps2 = 6.0, a1_1ps = -0.02, a3_mps2 = 25.0, a4_mps2 = -18.0},
]
[computer]
sample_s = 0.01
delay_s = 0.035
"""
PD = """
schema = 2
law = "pd"
[gains]
table = [{time_s = 0.0, k_p = 1.0, k_d_s = 0.6}]
"""


@pytest.fixture
def small(tmp_path: Path) -> Path:
    (tmp_path / "small.toml").write_text(SMALL)
    (tmp_path / "pd.toml").write_text(PD)
    return tmp_path


def refused(text: str, of: Path, old: str = "", new: str = "") -> str:
    (of / "bad.toml").write_text(text.replace(old, new) if old else text)
    with pytest.raises(ScenarioError) as caught:
        maxq.given_points(of / "bad.toml")
    return str(caught.value)


def test_values_are_linear_between_the_rows_and_rest_is_left_out(small: Path) -> None:
    points = maxq.given_points(small / "small.toml")
    assert [p.time_s for p in points] == [10.0, 20.0]
    (middle,) = maxq.given_points(small / "small.toml", [15.0])
    assert middle.plant.b[1, 0] == 5.5
    assert middle.axial_load_mps2 == 17.0
    assert middle.derivatives.m_alpha_1ps2 == 1.5
    assert middle.instruments.delay_s > 3.0 * middle.instruments.sample_s
    for time_s, said in ((25.0, "node at 25 s: two rows holds 0 s to 20 s"), (0.0, "V_mps = 0: the coefficients")):
        with pytest.raises(ValueError, match=said):
            maxq.given_points(small / "small.toml", [time_s])


def test_a_wrong_file_is_one_line(small: Path) -> None:
    assert "bad.toml: coefficients" in refused(SMALL, small, "K1_1ps2 = 5.0, ")
    said = refused(
        SMALL
        + "[[mode]]\ntable = [{time_s=0.0, omega_radps=9.0, phi_gimbal_1pkg=1e-5, phi_gyro=1.0, slope_gyro_1pm=0.1}]\n",
        small,
    )
    assert "a mode needs the thrust that excites it; allowed: a column control_thrust_N" in said
    assert "actuator.zeta = [0.7]: has 1 numbers" in refused(
        SMALL + "[actuator]\nomega_radps = [70.0, 300.0]\nzeta = [0.7]\n", small
    )
    with pytest.raises(ScenarioError, match=r"grensite: .*did you mean greensite"):
        maxq.given_points("grensite")


def test_analyse_judges_a_design_by_its_own_points(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert simdesign.main(["analyse", "greensite-hm3", "--out", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert "at the points of Greensite's launcher, pitch; loop opened at the gimbal command; without aliasing" in said
    assert "judged by the design's own basis: 1 operating point, 2 limits" in said
    assert "       72  stable     7.56  6.00   30.0  165.2  0.513     0.00  6.00   7.56   30.0  0.505" in said
    assert said.splitlines()[-1] == "PASSED: stable, all 2 limits met"
    (node,) = json.loads((tmp_path / "analysis.json").read_text())["nodes"]
    assert node["k_zd_radspm"] == 0.001
    assert node["gain_down"]["db"] == pytest.approx(6.0, abs=1e-4)


def test_analyse_of_other_points_and_at_other_times(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    design, points = str(small / "pd.toml"), str(small / "small.toml")
    assert simdesign.main(["analyse", design, "--points", points]) == 0
    said = capsys.readouterr().out
    assert "sampled, as it flies" in said
    assert "the design states no basis: judged at 2 operating points, without limits" in said
    assert simdesign.main(["analyse", design, "--points", points, "--at", "25"]) == 2
    assert "node at 25 s: two rows holds 0 s to 20 s" in capsys.readouterr().err
    assert simdesign.main(["analyse", design, "--points", "greensite", "--kind", "sampled"]) == 2
    assert "the computer of the points does not sample: allowed is --kind exact or pade" in capsys.readouterr().err
    assert simdesign.main(["analyse", design, "--points", "nothing"]) == 2
    assert "nothing: neither a file nor a built-in file of derivatives" in capsys.readouterr().err
    assert simdesign.main(["analyse", design, "--points", points, "--plant", "table2"]) == 2
    assert "--plant has no meaning with points: they are given, not flown" in capsys.readouterr().err


def test_the_shipped_design_is_what_its_case_asks_for() -> None:
    """The load is a tenth below that of HM3's design, with two fifths of its drift (docs/howto/derivatives.md)."""
    from maxq.sim.scenario.loader import read_design  # noqa: PLC0415  # with the program below
    from maxq.tools.dev.greensite import measured  # noqa: PLC0415  # the program of the table

    for name, load, drift, gain_db, lower_db in (
        ("greensite", 3126.6, 0.0500, 6.0, 6.5045),
        ("greensite-hm3", 3485.2, 0.1292, 6.0, 6.0),
        ("greensite-zavoli", 3390.2, 0.08466, 6.6496, 6.6496),
    ):
        loop, wind = measured(read_design(name))
        assert loop.margins.stable
        assert loop.margins.gain_db == pytest.approx(gain_db, abs=2e-3)
        assert loop.margins.gain_down_db.value == pytest.approx(lower_db, abs=2e-3)
        assert [float(one.rms[0]) for one in wind] == pytest.approx([load, drift], rel=1e-3)


def test_a_case_has_a_scenario_or_points(tmp_path: Path) -> None:
    for changes, said in (
        (["scenario=nominal"], 'scenario = "nominal": names both a flight and points, or neither'),
        (["robust={}"], "robust = {}: deviates from a vehicle, which points do not have"),
        (["stage=[{robust={}}]"], "stage.0.robust = {}: deviates from a vehicle, which points do not have"),
    ):
        with pytest.raises(ScenarioError, match=said):
            read_case("greensite", changes)
    loaded = read_case("greensite")
    with pytest.raises(ValueError, match="the case has points in place of a scenario"):
        _ = loaded.scenario


def test_matrices_are_a_loop_with_the_computers_delay() -> None:
    a, b, c = [[0.0, 1.0], [2.0, 0.0]], [[0.0], [4.0]], [[0.0, 1.0]]
    states = ("theta_rad", "q_radps")
    point = maxq.point_of_matrices(a, b, c, states=states, sample_s=0.01, delay_s=0.025)
    loop = maxq.loop(point, "ksr3-default")
    hz = np.array([0.1, 0.5, 2.0])
    s = 2j * np.pi * hz
    law = loop.law
    averaged = (1.0 - np.exp(-0.01 * s)) / (0.01 * s)
    rate = 4.0 * s / (s * s - 2.0) * averaged**2 * np.exp(-0.025 * s)
    sums = 0.01 / (1.0 - np.exp(-0.01 * s))
    k_p, k_d = law.gains["k_p"], law.gains["k_d_s"]
    wanted = (k_p * sums + k_d) * rate * law.filter_response(hz)
    np.testing.assert_allclose(loop.response(hz), wanted, rtol=1e-3)
    assert maxq.margins(loop).stable
    with pytest.raises(ValueError, match="no sensors beyond the gyro"):
        maxq.loop(point, "greensite-hm3", kind="exact")
    with pytest.raises(ValueError, match="matrices have no stability derivatives"):
        _ = point.derivatives
    for wrong, said in (({"outputs": ("theta_rad",)}, "outputs = "), ({"inputs": ("gimbal",)}, "inputs = ")):
        with pytest.raises(ValueError, match=said):
            maxq.point_of_matrices(a, b, c, **wrong)  # type: ignore[arg-type]  # wrong names


def test_held_points_have_the_axial_load_as_gravity() -> None:
    flown, held = (maxq.nodes("nominal", [40.0], held=held)[0] for held in (False, True))
    for node, load in ((flown, 9.8), (held, held.axial_load_mps2)):
        lateral = node.plant.a[0, 2]
        assert -lateral == pytest.approx(load * np.sin(node.condition.pitch_rad), rel=2e-3)
    assert held.axial_load_mps2 == pytest.approx(flown.axial_load_mps2, rel=1e-12)
