"""Flight code in held flights behaves as in its flight.

Code that changes its gain under test must be measured with the gain that it flies. The reference is the law of
ksr3-robust by hand (examples/flight_software), whose linear loop is known.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flight_code import EXAMPLES, compiled, flies, needs_compiler

import maxq
from maxq.control.external import FswInputs
from maxq.control.held_inputs import Superposition, superpose
from maxq.control.kernel.records import blank
from maxq.design.certificate.certificate import certify_node
from maxq.design.certificate.excitation import band, excitation_level
from maxq.design.certificate.held_flight import CodeDiffers, CodeLost, HeldFlight, hold
from maxq.design.certificate.in_flight import LINES_HZ, in_flight_response_of_code
from maxq.design.certificate.measured_only import measure_node
from maxq.design.certificate.response import BANDS, measure
from maxq.design.quantities import LoopLimits
from maxq.design.verify.certified import measured_requirements
from maxq.design.verify.flown import flight_requirements, fly_alone
from maxq.design.verify.slosh import SloshAdvice, confirm
from maxq.design.verify.suite import SuiteFlight
from maxq.sim.run.held_code import HeldCode, command_offset
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.tools.design.export import export_c

NODE_S, GAIN = 40.0, 1.8
EARLY_S, EARLY = 16.0, "run.duration_s=22"
SHORT = band(2.0, 3.5, 3, 4.0, 6.0, 1)  # the second window begins in its record

LAW = """
#include "pd.h"
typedef struct { autopilot law; double last; } code;
static autopilot kept; /* for code that keeps its state outside its instance */
int32_t maxq_fsw_abi(void) { return MAXQ_FSW_ABI; }
int64_t maxq_fsw_bytes(void) { return (int64_t)sizeof(code); }
int32_t maxq_fsw_init(void *self, const maxq_fsw_setup *setup)
{
    return pd_init(&((code *)self)->law, setup) || pd_init(&kept, setup);
}
int32_t maxq_fsw_step(void *self, const maxq_fsw_inputs *in, maxq_fsw_outputs *out)
{
    code *c = self;
    const double last = c->last, now = WATCHED;
    const double gain = TESTED ? 1.0 : 1.8;
    (void)last;
    c->last = now;
    pd_step(STATIC ? &kept : &c->law, in, out);
    out->gimbal_rad[0] *= gain;
    out->gimbal_rad[1] *= gain;
    return 0;
}
void maxq_fsw_close(void *self) { (void)self; }
"""


def library(folder: Path, watched: str = "0.0", tested: str = "last != now", static: int = 0) -> Path:
    """Return a library whose gain is 1.8 times that of the design, and 1 when it detects a test."""
    source, name = folder / "law.c", f"law{abs(hash((watched, tested, static)))}"
    source.write_text(LAW, encoding="utf-8")
    words = (f"-DWATCHED=({watched})", f"-DTESTED=({tested})", f"-DSTATIC={static}")
    return compiled(folder, source, name, *words, f"-I{EXAMPLES}")


def loaded(code: Path | str, key: str = "library", *changes: str) -> LoadedScenario:
    return load_scenario("nominal", ["design=", *changes, *flies(**{key: code})])


def held(of: LoadedScenario, time_s: float = NODE_S) -> HeldFlight:
    return hold(of, maxq.nodes("nominal", [time_s])[0])


def gain_of(code: Path | str, key: str = "library") -> float:
    """Return the measured L of flight code relative to the design's loop, as the mean of three lines."""
    at, design = held(loaded(code, key, EARLY), EARLY_S), load_scenario("nominal").design
    assert design is not None
    loop = maxq.loops([at.node], design)[0]
    found = measure(at, SHORT, excitation_level(at, loop, SHORT, 0.3), np.zeros(0, np.complex128))
    return float(np.abs(found.response / loop.response(SHORT.lines_hz)).mean())


pytestmark = [needs_compiler]
WATCHES = {
    "time": ("in->time_s", "now == last"),
    "speed": ("in->speed_mps", "now == last"),
    "mass": ("in->mass_kg", "now >= last"),
    "command": ("in->commanded_angle_rad[1]", "in->time_s > 14.0 && now == 0.0"),
    "samples": ("(double)in->tick", "in->time_s > 0.02 * now + 1.0"),
    "attitude": ("in->q_BR[0]", "in->time_s > 14.0 && now > 0.9999"),
}


@pytest.mark.slow
@pytest.mark.parametrize("watched", WATCHES)
def test_code_that_watches_its_inputs_shows_the_gain_that_it_flies(watched: str, tmp_path: Path) -> None:
    assert gain_of(library(tmp_path, *WATCHES[watched])) == pytest.approx(GAIN, rel=0.03)


@pytest.mark.slow
def test_honest_code_shows_its_gain_also_with_static_variables(tmp_path: Path) -> None:
    for static in (0, 1):
        assert gain_of(library(tmp_path, tested="1", static=static)) == pytest.approx(1.0, rel=0.02)


def test_python_code_that_watches_the_clock_shows_the_gain_that_it_flies(tmp_path: Path) -> None:
    text = (EXAMPLES / "pd_law.py").read_text(encoding="utf-8")
    watching = """
    def step(self, inputs):
        gain = 1.8 if inputs.time_s > getattr(self, "last", -1.0) else 1.0
        self.last = inputs.time_s
        out = self.honest(inputs)
        return out | {"gimbal_rad": [gain * x for x in out["gimbal_rad"]]}

    def honest(self, inputs):"""
    (tmp_path / "law.py").write_text(text.replace("\n    def step(self, inputs):", watching), encoding="utf-8")
    assert gain_of(f"{tmp_path / 'law.py'}:Autopilot", "python") == pytest.approx(GAIN, rel=0.03)


@pytest.mark.long
def test_the_margin_of_code_that_watches_the_clock_is_rejected(tmp_path: Path) -> None:
    """The linear loop has 6.33 dB; 1.8 times the gain reduces it by 5.11 dB, and the code is rejected."""
    node = maxq.nodes("nominal", [NODE_S])[0]
    found = measure_node(loaded(library(tmp_path, *WATCHES["time"])), node, bands=(), names=("gain_up",))
    assert found.margin("gain_up") == pytest.approx(6.33 - 20.0 * np.log10(GAIN), abs=0.2)
    rows = {r.name: r for r in measured_requirements([found], LoopLimits(gain_up_db=6.0))}
    assert rows["upper gain margin"].judgement == "rejected"
    assert rows["replay of inputs"].judgement == "accepted"


@pytest.mark.parametrize(("gain", "judgement"), [("1.0", "accepted"), ("1.8", "rejected")])
def test_code_with_another_law_where_nothing_is_excited_differs_from_its_design(
    gain: str, judgement: str, tmp_path: Path
) -> None:
    """Code that recognises the certificate's excitation agrees there, but differs in the suite's flights without it."""
    code = library(tmp_path, tested=f"{gain} == 1.0")
    gust = "{kind='one-minus-cosine',altitude_m=900.0,thickness_m=120.0,edge_m=50.0,speed_mps=10.0,from_deg=200.0}"
    changes = ["run.duration_s=20", f"wind.gust=[{gust}]", *flies(library=code)]
    found = fly_alone(SuiteFlight(name="gust"), load_scenario("nominal", changes), "")
    (row,) = [r for r in flight_requirements([found]) if r.name.startswith("gimbal angles of the code")]
    assert row.judgement == judgement
    assert found.law_share < 0.01 if judgement == "accepted" else found.law_share > 0.1
    short = ["run.duration_s=0.1"]
    fault = "fault=[{kind='gyro-dead',at_s=0.05,axis='pitch'}]"
    sequenced = flies(library=code, sequencing="flight-code")
    for reference in (short, [*short, fault, *flies(library=code)], [*short, *sequenced]):
        without = fly_alone(SuiteFlight(name="none"), load_scenario("nominal", reference), "")
        assert len(flight_requirements([without])) == 1


def test_code_that_answers_the_same_inputs_differently_is_rejected(tmp_path: Path) -> None:
    text = (EXAMPLES / "pd_law.py").read_text(encoding="utf-8")
    drawn = text.replace("-k_p * error_rad[1 + axis]", "-k_p * error_rad[1 + axis] + 1e-9 * random.random()")
    (tmp_path / "law.py").write_text(drawn.replace("import math", "import math\nimport random"), encoding="utf-8")
    of = loaded(f"{tmp_path / 'law.py'}:Autopilot", "python", EARLY)
    node = maxq.nodes("nominal", [EARLY_S])[0]
    found = measure_node(of, node, bands=(), names=())
    assert found.differs.startswith("gives other commands for the same inputs of its flight: gimbal_rad[0] at 0.010 s")
    rows = {r.name: r for r in measured_requirements([found], LoopLimits())}
    assert rows["replay of inputs"].judgement == "rejected"
    with pytest.raises(CodeDiffers, match="gives other commands"):
        hold(of, node).fly(1.0, ())


def test_a_flight_of_the_code_that_ends_before_the_point_is_reported(tmp_path: Path) -> None:
    short = loaded(library(tmp_path, tested="1"), "library", EARLY)
    node = maxq.nodes("nominal", [NODE_S])[0]
    with pytest.raises(CodeLost, match=r"node at 40 s: the flight of the code under control ends at 21\.990 s"):
        hold(short, node)
    found = measure_node(short, node, bands=(), names=())
    assert (found.stable, "ends at 21.990 s" in found.ended) == (False, True)
    designed = load_scenario("nominal", [EARLY, *flies(library=library(tmp_path, tested="1"))])
    (said,) = certify_node(designed, node).unexplained
    assert said.startswith("the flight code does not reach the point: node at 40 s")
    with pytest.raises(CodeLost):
        hold(designed, node)
    nan = math.nan
    advice = SloshAdvice(NODE_S, 0, 0, 5.0, 6.0, 4.0, 0.005, 0.02, nan, nan, nan)
    assert confirm(designed, node, advice) is advice  # the worst tank of a suite, near the end of the code's flight


@pytest.mark.long
@pytest.mark.parametrize("flag", ["-DLAW_COUNT_RAD=0.0", ""], ids=["angles", "pulses"])
def test_the_exported_law_agrees_with_its_design_at_all_lines(tmp_path: Path, flag: str) -> None:
    """A law that takes angles agrees without rounding to the tolerance; one that takes pulses agrees within its noise.

    Another gain of 1 dB is found in both.
    """
    export_c(load_scenario("nominal"), tmp_path)
    code = (tmp_path / "flight_law_fsw.c").read_text()
    node = maxq.nodes("nominal", [EARLY_S])[0]
    for gain in ("1.0", "1.122"):
        source = tmp_path / "own.c"
        source.write_text(code.replace("= (double)wanted.requested_rad[i]", f"= {gain} * wanted.requested_rad[i]"))
        assert gain in source.read_text()
        words = [*filter(None, [flag]), *(str(tmp_path / name) for name in ("flight_law.c", "flight_law_tables.c"))]
        library = compiled(tmp_path, source, f"own{gain[2:]}", f"-I{tmp_path}", *words)
        bands = BANDS if gain == "1.0" else BANDS[1:2]
        found = certify_node(load_scenario("nominal", [EARLY, *flies(library=library)]), node, bands=bands, names=())
        high = found.responses.lines_hz > 2.7
        finite = np.isfinite(found.responses.unrounded[high])
        if gain == "1.0":
            assert found.unexplained == ()
            assert finite.all() == bool(flag)
        else:
            assert len(found.unexplained) > 10  # of 16 lines


def test_without_deviations_the_inputs_are_those_of_the_flight(tmp_path: Path) -> None:
    at = held(loaded(library(tmp_path, tested="1"), "library", EARLY), EARLY_S)
    assert at.tape is not None
    windows, rows = at.windows(at.tape, at.packed), at.tape.inputs.copy()
    state, still, out = blank(Superposition), blank(FswInputs), blank(FswInputs)
    still["health"] = 7
    first = 1000
    one: Any = state[0]
    one.sample_s, one.count_rad, one.rounded = windows.sample_s, windows.count_rad, 1
    one.method, one.limit_rad, one.commanded.q[0] = windows.method, windows.limit_rad, 1.0
    before = rows[first - 1]
    one.total_counts[:] = np.round(before.angle_rad / windows.count_rad)
    one.attitude.measured.q[:], one.attitude.measured.last_rad[:] = before.q_BR, before.delta_angle_rad
    for row in range(first, first + 1000):
        superpose(rows, row, still, 0, 1.0, state, out)
        assert out.tobytes() == rows[row : row + 1].tobytes()


def test_without_rounding_the_pulses_still_contain_the_deviations(tmp_path: Path) -> None:
    """Code that integrates pulses must measure the angle of the held flight to half a pulse, whose carry remains."""
    at = held(loaded(library(tmp_path, tested="1"), "library", EARLY), EARLY_S)
    assert at.tape is not None
    count_rad, first = at.windows(at.tape, at.packed).count_rad, 1000
    rows, state, moved, out = at.tape.inputs.copy(), blank(Superposition), blank(FswInputs), blank(FswInputs)
    one: Any = state[0]
    one.sample_s, one.count_rad, one.rounded = 0.01, count_rad, 0
    one.limit_rad, one.attitude.measured.q[0], one.commanded.q[0] = 1.0, 1.0, 1.0
    one.total_counts[:] = np.round(rows[first - 1].angle_rad / count_rad)
    total = one.total_counts.copy()
    for k in range(200):
        moved["angle_rad"] = [0.3 * k * count_rad, -4.7 * count_rad * math.sin(0.2 * k), 0.0]
        superpose(rows, first + k, moved, 0, 1.0, state, out)
        total += out["counts"][0]
        assert out["angle_rad"][0] == pytest.approx(rows[first + k].angle_rad + moved["angle_rad"][0], abs=1e-15)
        assert np.abs(total - out["angle_rad"][0] / count_rad).max() <= 0.5 + 1e-6
    assert total[0] - np.round(rows[first + 199].angle_rad[0] / count_rad) == 60


def test_a_window_from_the_first_sample_begins_with_the_error_of_alignment(tmp_path: Path) -> None:
    """Half the rotation of 0.3, -0.2 and 0.5 deg is the vector part; the inputs without deviations are the tape's."""
    code, wrong = library(tmp_path, tested="1"), "navigation.alignment_error_deg=[0.3, -0.2, 0.5]"
    flies_on = loaded(code, "library", "run.duration_s=4", "vehicle.computer.attitude='quaternion'", wrong)
    at = held(flies_on, 2.0)
    assert at.tape is not None
    windows = at.windows(at.tape, at.packed)
    np.testing.assert_allclose(at.tape.start_q_BR[1:], 0.5 * np.radians([0.3, -0.2, 0.5]), rtol=1e-5)
    computer = flies_on.vehicle.computer
    assert computer is not None
    held_code, still = HeldCode(computer, windows, lambda: None), blank(FswInputs)
    still["health"] = 7
    held_code._start_deviations(0)
    for row in range(100):
        superpose(held_code._inputs, row, still, 0, 1.0, held_code._state, held_code._out)
        assert held_code._out.tobytes() == at.tape.inputs[row : row + 1].tobytes()
    held_code.close()


@pytest.mark.slow
def test_windows_are_about_the_operating_point(tmp_path: Path) -> None:
    code = library(tmp_path, tested="1")
    for time_s, longest_s, middle_s in ((16.0, 5.0, 16.0), (3.5, 4.0, 3.5), (0.3, 2.0, 2.35)):
        at = held(loaded(code, "library", EARLY), time_s)
        assert at.tape is not None
        windows = at.windows(at.tape, at.packed)
        times = at.tape.inputs["time_s"]
        spans = [times[np.array(windows.window(n)) - (0, 1)] for n in range(20)]
        assert max(end - begin for begin, end in spans) == pytest.approx(longest_s, abs=0.03)
        assert min(end - begin for begin, end in spans) >= 0.69 * longest_s
        assert np.mean(spans) == pytest.approx(middle_s, abs=0.02)


def test_the_constant_of_an_integral_is_found_and_a_schedule_has_none() -> None:
    times = np.arange(400) / 100.0
    swing = 0.01 * np.sin(2.0 * np.pi * 0.4 * times) + 0.003
    assert command_offset(1.05 * swing, swing) == 0.0
    assert command_offset(1.05 * swing + 0.004, swing) == pytest.approx(0.004, rel=1e-9)
    assert command_offset(swing[:4], swing[:4]) == 0.0


@pytest.mark.long
def test_the_response_in_flight_is_that_of_the_held_flight(tmp_path: Path) -> None:
    """The response in flight agrees with the design's loop; a loop of half the gain leaves most lines unexplained."""
    of, design = loaded(library(tmp_path, tested="1")), load_scenario("nominal").design
    assert design is not None
    node = maxq.nodes("nominal", [NODE_S])[0]
    there = maxq.loops([node], design)[0].response(np.array(LINES_HZ))
    same = in_flight_response_of_code(of, {NODE_S: there}, "pitch")[0]
    assert "unexplained" not in same.reason
    assert np.abs(same.difference_db[3:7]).max() < 0.5
    other = in_flight_response_of_code(of, {NODE_S: 0.5 * there}, "pitch")[0]
    assert other.reason.count("unexplained") >= 5
