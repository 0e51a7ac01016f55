"""A law of the user (`plug_in`) against python-control, SciPy and the built-in law, and the errors of its file."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import control
import numpy as np
import pytest
from flight_code import COMPILER, needs_compiler
from scipy import signal

from maxq import Flight, ScenarioError
from maxq.design.case.schema import read_case
from maxq.design.certificate.certificate import certify_node
from maxq.design.laws.design_file import design_of, design_text, load_design
from maxq.design.laws.registry import designed_law
from maxq.design.model.node import nodes_along
from maxq.design.optimise.at_nodes import make_problem
from maxq.design.optimise.solve import nominal_plants
from maxq.sim.packing.own_law import check_step, own_code
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.design.export import export_c
from maxq.tools.design.report import design_table

EXAMPLE = Path(__file__).parents[1] / "examples" / "own_law"
SHORT = ["run.duration_s=8", "requirement=[]"]
T = 0.01  # sample period of KSR-III, s

PD = """
import numpy as np

class Pd:
    variables = {"k_p": (1.0, 0.1, 9.0), "k_d_s": (0.5, 0.1, 9.0)}

    @staticmethod
    def matrices(v, sample_s):
        return np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0)), np.array([[-v[0], -v[1]]])

    @staticmethod
    def step(v, memory, error_rad, rate_radps, sample_s):
        return -v[0] * error_rad - v[1] * rate_radps
"""
PD_C = """
int step(const double *v, double *memory, double *sample)
{
    (void)memory;
    sample[3] = -v[0] * sample[0] - v[1] * sample[1];
    return 0;
}
"""


def flown(design: Path) -> Flight:
    return fly(load_scenario("nominal", [f'design="{design}"', *SHORT]))


@pytest.fixture(scope="module")
def lead(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, object, object]:
    """Return the file of a design of the example at its first start, and its case and problem."""
    folder = tmp_path_factory.mktemp("lead")
    for file in EXAMPLE.iterdir():
        if file.is_file():
            shutil.copy(file, folder)
    loaded = read_case(folder / "lead.toml", ["nodes_s=[5.0,35.0]"])
    problem = make_problem(loaded.case, nominal_plants(loaded))
    law = problem.law.designed(problem.law.starts(1, 1)[0])
    design = design_of(name="lead", description="", vehicle="", law=law)
    file = folder / "design.toml"
    file.write_text(design_text(design))
    return file, loaded, problem


@pytest.fixture(scope="module")
def lead_flight(lead: tuple[Path, object, object]) -> Flight:
    return flown(lead[0])


def compensator(zero_hz: float, pole_hz: float) -> control.TransferFunction:
    z, p = 2.0 * np.pi * zero_hz, 2.0 * np.pi * pole_hz
    return control.sample_system(control.tf([1.0 / z, 1.0], [1.0 / p, 1.0]), T, "bilinear")


def test_the_linear_law_is_that_of_python_control(lead: tuple[Path, object, object]) -> None:
    law = designed_law(load_design(lead[0])).at(20.0, "pitch", T)
    hz = np.array([0.1, 1.0, 5.0, 20.0, 45.0])
    v = law.gains
    own = compensator(v["own_lead_zero_hz"], v["own_lead_pole_hz"])
    expected = own(np.exp(2j * np.pi * hz * T)) * law.filter_response(hz)
    found = law.response(hz)
    assert found[:, 0] == pytest.approx(v["own_k_p"] * expected, rel=1e-12)
    assert found[:, 1] == pytest.approx(v["own_k_d_s"] * expected, rel=1e-12)
    matrices = law.state_space()
    z = control.ss(matrices.a, matrices.b, matrices.c, matrices.d, T)(np.exp(2j * np.pi * hz * T))
    of_control = z[0].T
    assert of_control == pytest.approx(found, rel=1e-9)
    slow = designed_law(load_design(lead[0])).continuous_at(20.0, "pitch", T)
    s, (zero_hz, pole_hz) = 2j * np.pi * hz, (v["own_lead_zero_hz"], v["own_lead_pole_hz"])
    analogue = (1.0 + s / (2.0 * np.pi * zero_hz)) / (1.0 + s / (2.0 * np.pi * pole_hz)) * slow.filter_response(hz)
    assert slow.response(hz)[:, 0] == pytest.approx(v["own_k_p"] * analogue, rel=1e-9)
    assert slow.state_space().response(hz)[:, 0, :] == pytest.approx(slow.response(hz), rel=1e-9)
    assert law.static_gain("angle_rad") == pytest.approx(v["own_k_p"], rel=1e-12)


def test_gradients_are_differences(lead: tuple[Path, object, object]) -> None:
    law = lead[2].law
    u, step = law.starts(2, 1)[1] + 0.05, 1e-6
    own, x = law.own(u), np.log([2.0, 30.0])
    direction = np.random.default_rng(1).standard_normal(own.shape)
    ends = [law.log_response(own + s * step * direction, law.axis(x)) for s in (1.0, -1.0)]
    weights = np.array([[0.3, -0.2], [1.0, 2.0]], complex)
    moved = (ends[0].common[0] - ends[1].common[0]) + ((ends[0].gains[0] - ends[1].gains[0]) * weights).sum(1)
    found = (law.gradient(own, law.axis(x), weights) * direction).sum(1)
    assert found == pytest.approx(moved / (2.0 * step), rel=1e-6)
    here, after, before = (law.log_response(own, law.axis(x + d)) for d in (0.0, step, -step))
    for k in range(2):
        slope = (after.gains[k] - before.gains[k]) / (2.0 * step)
        assert here.gains[k + 1] == pytest.approx(slope, rel=1e-5, abs=1e-6 * np.abs(slope).max())
    v = np.random.default_rng(2).standard_normal(len(u))
    assert law.jacobian(u) @ v == pytest.approx((law.own(u + step * v) - law.own(u - step * v)) / (2 * step), abs=1e-7)
    three = (law.limit_values(own + s * step * direction) for s in (0.0, 1.0, -1.0))
    for values, up, down in zip(*three, strict=True):
        assert (values.gradient * direction[values.plant]).sum(1) == pytest.approx(
            (up.excess_db - down.excess_db) / (2.0 * step), rel=1e-5, abs=1e-6
        )


def test_the_flown_law_is_the_linear_law(lead: tuple[Path, object, object], lead_flight: Flight) -> None:
    """The logged output of the law equals that of SciPy's filter for the logged error and rate."""
    f, design = lead_flight, load_design(lead[0])
    held = slice(5, None, 10)  # a row of every sample; rows are a millisecond apart
    time_s, table = np.floor(f.time_s("law_pitch_deg")[held] / T) * T, design.gains.table
    k_p, k_d, zero_hz, pole_hz = (np.interp(time_s, table["time_s"], table[name]) for name in design.gain_names)
    count_rad = f.scenario.vehicle.computer.count_rad
    rate_degps = f["counts_pitch"][held] * np.degrees(count_rad) / T
    tf = compensator(zero_hz[0], pole_hz[0])
    law_deg = -k_p * f["error_pitch_deg"][held] - k_d * rate_degps
    expected = signal.lfilter(tf.num[0][0], tf.den[0][0], law_deg)
    assert np.ptp(expected) > 0.1
    assert f["law_pitch_deg"][held] == pytest.approx(expected, abs=1e-9)


@pytest.mark.long
def test_the_margin_in_a_held_flight_is_that_of_the_linear_law(lead: tuple[Path, object, object]) -> None:
    """The upper gain margin is measured in the simulator at 35 s, where the compensator is frozen with the gains."""
    flown = load_scenario("nominal", [f'design="{lead[0]}"'])
    (node,) = nodes_along(flown, [35.0])
    found = certify_node(flown, node, bands=(), names=("gain_up",))
    assert found.stable
    assert found.unexplained == ()
    assert abs(found.margins[0].difference) < 0.2


@pytest.mark.parametrize("language", ["python", pytest.param("c", marks=needs_compiler)])
def test_pd_of_a_file_flies_the_bits_of_the_built_in_law(language: str, tmp_path: Path) -> None:
    text, built_in = PD, load_design("designs/ksr3-robust.toml")
    if language == "c":
        (tmp_path / "pd.c").write_text(PD_C)
        words = [str(COMPILER), "-O2", "-ffp-contract=off", "-shared", "-fPIC", "-o", str(tmp_path / "pd.so")]
        subprocess.run([*words, str(tmp_path / "pd.c")], check=True)
        head, _, _ = PD.partition("    @staticmethod\n    def step")
        text = f"import ctypes, pathlib\n{head}    step = ctypes.CDLL(pathlib.Path(__file__).with_name('pd.so')).step\n"
    (tmp_path / "pd.py").write_text(text)
    kept = design_text(built_in).replace('law = "pd"', 'law = "own"\nplug_in = "pd.py:Pd"')
    (tmp_path / "own.toml").write_text(kept.replace("k_p =", "own_k_p =").replace("k_d_s =", "own_k_d_s ="))
    own, usual = flown(tmp_path / "own.toml"), flown(Path("designs/ksr3-robust.toml"))
    assert np.ptp(usual["law_pitch_deg"]) > 0.1
    for channel in ("law_pitch_deg", "filtered_yaw_deg", "gimbal_pitch_angle_deg"):
        assert own[channel].tobytes() == usual[channel].tobytes()


def test_the_design_names_the_file_and_its_hash(lead: tuple[Path, object, object]) -> None:
    design, code = load_design(lead[0]), lead[0].with_name("lead_law.py")
    assert Path(design.plug_in.file) == code
    assert design.plug_in.member == "Lead"
    before = code.read_text()
    code.write_text(before + "\n")
    try:
        own_code.__globals__["_own_code"].cache_clear()
        with pytest.raises(
            ScenarioError, match=r"lead_law.py:Lead: plug_in: is not the law of the design; allowed: .*"
        ):
            own_code(design.plug_in)
    finally:
        code.write_text(before)


def test_tables_name_the_variables_and_the_export_to_c_is_refused(lead: tuple[Path, object, object]) -> None:
    loaded = load_scenario("nominal", [f'design="{lead[0]}"'])
    lines = design_table(loaded.design)
    head, first = lines[:2] if "k_p" in lines[0] else lines[1:3]
    assert head.split() == ["time,", "s", "k_p", "k_d_s", "lead_zero_hz", "lead_pole_hz"]
    assert [float(x) for x in first.split()] == [5.0, 1.0, 0.6, 5.0, 20.0]
    with pytest.raises(ScenarioError, match=r'design.law = "own": cannot be exported as C; allowed: pd, pid, .*'):
        export_c(loaded, lead[0].parent / "c")


WRONG = {
    "raises": ("import numpy as np", "1 / 0", r"plug_in: ZeroDivisionError: .* \(law.py, line 2\)"),
    "no class": ("class Pd", "class Other", "plug_in: defines no Pd"),
    "no step": ("def step", "def steps", "step: is missing; allowed: a function"),
    "bounds": ("(1.0, 0.1, 9.0)", "(0.0, 0.1, 9.0)", r"variables.k_p: is \(0.0, 0.1, 9.0\); allowed: .*"),
    "shape": ("[[-v[0], -v[1]]]", "[[-v[0]]]", r"matrices: D has the shape \(1, 1\); allowed: \(1, 2\)"),
    "three": ("np.zeros((1, 0)), ", "", "matrices: returns another form .*; allowed: four arrays A, B, C, D"),
    "pole": (
        "np.zeros((0, 0)), np.zeros((0, 2)), np.zeros((1, 0))",
        "np.eye(1), np.ones((1, 2)), np.ones((1, 1))",
        "matrices: the law has a pole of magnitude 1; allowed: poles below 1",
    ),
    "real": (
        "-v[0], -v[1]",
        "-float(v[0]), -v[1]",
        "matrices: the derivative with respect to k_p is lost in a complex step; allowed: .*",
    ),
    "differs": ("return -v[0] * error_rad", "return v[0] * error_rad", "step: differs from matrices at sample 0: .*"),
}


def check_plug_in(file) -> None:
    code = own_code(file)
    code.check_slopes(T)
    check_step(file, tuple(code.start), T)


@pytest.mark.parametrize("fault", WRONG)
@pytest.mark.filterwarnings("ignore:Casting complex values")
def test_a_wrong_file_is_a_one_line_error(fault: str, tmp_path: Path) -> None:
    old, new, said = WRONG[fault]
    assert old in PD
    (tmp_path / "law.py").write_text(PD.replace(old, new, 1))
    text = (EXAMPLE / "lead.toml").read_text().replace("lead_law.py:Lead", "law.py:Pd")
    (tmp_path / "case.toml").write_text(text)
    loaded = read_case(tmp_path / "case.toml", ["nodes_s=[20.0]"])
    with pytest.raises(ScenarioError, match=f"law.py:Pd: {said}") as caught:
        check_plug_in(loaded.case.plug_in)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("plug_in", "'none.py:Pd'", "plug_in = .*none.py.*: no such file"),
        ("plug_in", "'lead_law.py'", "plug_in = .*: names no class"),
        ("law", "'pd'", "plug_in.*has no meaning here; allowed: this key with law = 'own' only"),
        ("loop", "'pade'", "loop = .*: has no continuous form of the law own; allowed: sampled"),
    ],
)
def test_a_wrong_case_is_a_one_line_error(key: str, value: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=said):
        read_case(EXAMPLE / "lead.toml", [f"{key}={value}"])
