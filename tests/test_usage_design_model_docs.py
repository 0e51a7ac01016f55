"""The claims of docs/design.md and docs/flights/nominal-departure.md equal the results of the code."""

from __future__ import annotations

import functools
import re
from pathlib import Path

import numpy as np
from design_nodes import design, flown, node_at

import maxq
from maxq.tools.dev.documents import departure_table
from maxq.tools.dev.documents.departure_table import table_text
from maxq.tools.dev.documents.derivatives_table import table_text as derivatives_text

compare = functools.cache(departure_table.compare)
DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGE = DOCS / "flights" / "nominal-departure.md"


def test_example_runs() -> None:
    text = (DOCS / "design.md").read_text(encoding="utf-8")
    code = re.search(r"```python\n(.*?)```", text, re.S)
    assert code is not None
    names: dict[str, object] = {"frequencies_hz": np.array([1.0, 2.0])}
    exec(code[1], names)  # the page's own example
    assert isinstance(names["loop"], maxq.Loop)


def test_departure_page_is_up_to_date() -> None:
    """Numbers on the page agree to their last digit; flights on different machines differ by rounding."""
    ours, page = (re.findall(r"-?\d+\.\d+", text) for text in (table_text(*compare()), PAGE.read_text("utf-8")))
    assert len(ours) == len(page)
    np.testing.assert_allclose(np.array(ours, float), np.array(page, float), atol=0.11)


def test_table_of_derivatives_has_units_and_places() -> None:
    times_s, values = np.arange(5.0, 56.0, 0.5), np.tile([-0.3, -20.0, 0.2, 12.0, -0.5], (102, 1))
    values[7, 0], values[90, 0] = -0.55, -0.0951
    text = derivatives_text(times_s, values)
    row = "| Z_alpha | 1/s | normal acceleration by angle of attack, over airspeed | -0.550 to -0.0951 | 8.5 and 50 | "
    assert f"{row}-0.55 to -0.1 |\n" in text
    assert "| M_q | 1/s | pitch acceleration by pitch rate | -0.500 to -0.500 | 5 and 5 | not given |\n" in text
    assert "| time, s | Z_alpha, 1/s | M_alpha, 1/s2 | Z_delta, 1/s | M_delta, 1/s2 | M_q, 1/s |\n" in text
    assert "\n| 55 | -0.3000 | -20.00 | 0.2000 | 12.00 | -0.5000 |\n" in text


def test_figures_of_section_2_and_3() -> None:
    loop = maxq.loop(node_at(55.0).with_(bending_frequency=1.05), design())
    third = next(r for r in loop.fixed.resonances() if r.label == "bending 3")
    np.testing.assert_allclose(third.frequency_hz, 48.2, atol=0.1)
    found, measured = compare()
    for sampled, pade in measured:
        for name in ("aero_gain_db", "rigid_gain_db"):
            assert abs(getattr(sampled, name).value - getattr(pade, name).value) < 0.155
        assert abs(sampled.rigid_phase_deg.value - pade.rigid_phase_deg.value) < 0.4
    for d in found:
        below = d.frequency_hz < (16.0 if d.node.time_s >= 45.0 else 30.0)
        assert np.abs(d.db["pade"] + d.db["aliasing"])[below].max() < 0.1
        assert np.abs(d.deg["pade"] + d.deg["aliasing"])[below].max() < 1.0
    assert len(found) == len(flown())
