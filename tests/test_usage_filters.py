"""The checks of filters: their errors name key, value and allowed values."""

from __future__ import annotations

import math
import re
from dataclasses import asdict

import numpy as np
import pytest
from pydantic import ValidationError

from maxq.control.filters import BendingFilter, DiscreteFilter, FirstOrderSection, QuadraticSection
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.schema_design import FilterSection

GOOD = QuadraticSection(9.0, 0.3, 7.0, 0.7)
SAMPLE_S = 0.01


@pytest.mark.parametrize(
    ("section", "words"),
    [
        (QuadraticSection(9.0, 0.3, 7.0, -0.1), r"quadratic\[0\].pole_zeta = -0.1: allowed is .* above 0"),
        (QuadraticSection(9.0, 0.3, 7.0, 0.0), r"quadratic\[0\].pole_zeta = 0.0: allowed"),
        (QuadraticSection(9.0, 0.3, -7.0, 0.7), r"quadratic\[0\].pole_hz = -7.0: allowed"),
        (QuadraticSection(0.0, 0.3, 7.0, 0.7), r"quadratic\[0\].zero_hz = 0.0: allowed"),
        (QuadraticSection(math.inf, 0.3, 7.0, 0.7), r"quadratic\[0\].zero_hz = inf: allowed"),
        (QuadraticSection(9.0, math.nan, 7.0, 0.7), r"quadratic\[0\].zero_zeta = nan: allowed"),
    ],
)
def test_bad_quadratic_section(section: QuadraticSection, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        BendingFilter((section,))


@pytest.mark.parametrize(
    ("section", "words"),
    [
        (FirstOrderSection(30.0, -5.0), r"first_order\[0\].pole_hz = -5.0: allowed"),
        (FirstOrderSection(0.0, 5.0), r"first_order\[0\].zero_hz = 0.0: allowed"),
        (FirstOrderSection(math.nan, 5.0), r"first_order\[0\].zero_hz = nan: allowed"),
        (FirstOrderSection(30.0, math.inf), r"first_order\[0\].pole_hz = inf: allowed"),
    ],
)
def test_bad_first_order_section(section: FirstOrderSection, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        BendingFilter((), (section,))


def test_too_many_sections() -> None:
    with pytest.raises(ValueError, match="number of filter sections = 9: allowed is at most 8"):
        BendingFilter((GOOD,) * 9)


@pytest.mark.parametrize("prewarp_hz", [50.0, 60.0, 0.0, -1.0, math.nan, None])
def test_prewarp_outside_the_band(prewarp_hz: float | None) -> None:
    with pytest.raises(ValueError, match=rf"prewarp_hz = {prewarp_hz}: allowed .* Nyquist frequency 50 Hz"):
        BendingFilter((GOOD,)).discretize(SAMPLE_S, "prewarped", prewarp_hz)


@pytest.mark.parametrize("sample_s", [0.0, -0.01, math.nan, math.inf])
def test_bad_sample_period(sample_s: float) -> None:
    with pytest.raises(ValueError, match=r"sample_s = .*: allowed"):
        BendingFilter((GOOD,)).discretize(sample_s, "bilinear")


def test_unknown_method() -> None:
    with pytest.raises(ValueError, match="discretization = 'euler': allowed is prewarped, bilinear, matched, zoh"):
        BendingFilter((GOOD,)).discretize(SAMPLE_S, "euler")


@pytest.mark.parametrize("named", ["zero", "pole"])
def test_matched_refuses_what_would_alias(named: str) -> None:
    lightly_damped = (60.0, 0.01, 7.0, 0.7) if named == "zero" else (9.0, 0.3, 60.0, 0.01)
    with pytest.raises(ValueError, match=rf"a {named} at 59\.9.* Hz: allowed .* Nyquist frequency 50 Hz"):
        BendingFilter((QuadraticSection(*lightly_damped),)).discretize(SAMPLE_S, "matched")


@pytest.mark.parametrize(
    ("structure", "quadratic", "first_order", "words"),
    [
        ("F4", 1, 0, "1 sections do not make F4.*2 sections.*quadratic"),
        ("F3", 1, 0, "0 sections do not make F3.*1 sections.*first_order"),
        ("none", 1, 0, "1 sections do not make none.*0 sections.*quadratic"),
        ("F7", 1, 0, "'none', 'F2', 'F3', 'F4', 'F5', 'F6' or 'sections'"),
        ("sections", 0, 0, "has 0 sections.*1 .. 8 sections"),
        ("sections", 5, 4, "has 9 sections.*1 .. 8 sections"),
    ],
)
def test_structure_fixes_the_sections(structure: str, quadratic: int, first_order: int, words: str) -> None:
    first = {"zero_hz": 30.0, "pole_hz": 5.0}
    given = {"quadratic": (asdict(GOOD),) * quadratic, "first_order": (first,) * first_order, "prewarp_hz": 9.0}
    with pytest.raises(ValidationError) as refused:
        FilterSection.model_validate({"structure": structure, **given})
    assert re.search(words, str(refused.value.errors()))


def test_no_more_sections_than_the_computer_holds() -> None:
    with pytest.raises(ValueError, match="number of filter sections = 9: allowed is at most 8"):
        BendingFilter((GOOD,) * 5, (FirstOrderSection(30.0, 5.0),) * 4)


@pytest.mark.parametrize("a", [(0.0, 1.0), (-2.1, 1.05), (2.0, 0.9), (math.nan, 0.0)])
def test_unstable_discrete_section(a: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"sections\[0\] = .* stable poles"):
        DiscreteFilter(np.array([[1.0, 0.0, 0.0, *a]]), SAMPLE_S)


def test_any_number_of_sections_flies() -> None:
    """Sections equal to 1 change only rounding; the default F4 with six of them flies."""
    short = ["run.duration_s=20", "run.step_s=0.001"]
    plain = load_scenario("nominal", short)
    assert plain.design is not None
    sections = [
        {key: getattr(q, key) for key in ("zero_hz", "zero_zeta", "pole_hz", "pole_zeta")}
        for q in plain.design.filter.quadratic
    ]
    sections += [{"zero_hz": 20.0 + k, "zero_zeta": 0.5, "pole_hz": 20.0 + k, "pole_zeta": 0.5} for k in range(6)]
    text = ", ".join("{" + ", ".join(f"{key} = {value}" for key, value in each.items()) + "}" for each in sections)
    longer = load_scenario("nominal", [*short, "design.filter.structure=sections", f"design.filter.quadratic=[{text}]"])
    a, b = fly(plain), fly(longer)
    for channel in ("gimbal_pitch_angle_deg", "gimbal_yaw_angle_deg"):
        # the DAC rounds to 0.001 deg: a few commands may fall on its other side
        np.testing.assert_allclose(a[channel], b[channel], rtol=0, atol=0.005)
