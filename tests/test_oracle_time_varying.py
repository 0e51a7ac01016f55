"""The linear loop along the ascent equals the difference of two nonlinear flights with and without an excitation."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from maxq.design import operating_points
from maxq.design.certificate.excitation import gimbal_injection
from maxq.design.certificate.held_flight import fast_rows
from maxq.design.certificate.in_flight import variation_share
from maxq.design.certificate.time_varying import output_along
from maxq.design.loop.loop import loops
from maxq.sim.packing.flight import pack_flight
from maxq.sim.run.fly import FlightRun
from maxq.sim.scenario.loader import load_scenario

BEGIN_S, END_S, SAMPLE_S = 6.0, 44.0, 0.01
LOADED = load_scenario(
    "scenarios/nominal.toml", [f"run.duration_s={END_S + 1}", f"log.fast_hz={1 / SAMPLE_S}", "switches.converter=ideal"]
)
SINES = gimbal_injection("pitch", "multisine", 2e-4, frequencies_hz=(0.6, 1.1, 1.7, 5.0, 9.0), start_s=5.0)


def flown(*signals: object) -> tuple[np.ndarray, np.ndarray]:
    """Return the law's output and the command in pitch, deg, per sample."""
    scenario = LOADED.scenario.model_copy(update={"injection": signals})
    run = FlightRun(dataclasses.replace(LOADED, scenario=scenario), pack_flight(scenario))
    rows = fast_rows(run)
    return tuple(rows[:, run.table.index(name)] for name in ("filtered_pitch_deg", "gimbal_pitch_command_deg"))


@pytest.mark.slow
def test_the_loop_along_the_ascent_gives_the_flown_response() -> None:
    """Over 15 s the responses agree; the loop frozen at their middle, or advanced for too short a time, is far off."""
    design = LOADED.design
    assert design is not None
    (quiet, quiet_command), (law, command) = flown(), flown(SINES)
    sent = (command - quiet_command)[1:]
    back = (law - quiet)[: len(sent)]
    at_s = np.linspace(BEGIN_S, END_S, 77)
    along = loops(operating_points.nodes(LOADED, at_s.tolist(), plane="pitch"), design)
    found = output_along(along, at_s, sent - back, round(BEGIN_S / SAMPLE_S))
    assert found is not None
    part = slice(2900, 4400)
    size = np.std(back[part])

    def error(advanced: np.ndarray | None) -> float:
        assert advanced is not None
        return float(np.std((advanced - back)[part]) / size)

    assert error(found) < 0.001
    assert found[part.stop - 1] == pytest.approx(back[part.stop - 1], abs=0.003 * size)
    assert error(output_along([along[60]] * 2, at_s[[0, -1]], sent - back, round(BEGIN_S / SAMPLE_S))) > 0.1
    assert error(output_along(along, at_s, sent - back, 2800)) > 0.03


def test_loops_of_other_states_or_filters_are_not_joined() -> None:
    design = LOADED.design
    assert design is not None
    nodes = operating_points.nodes(LOADED, [20.0, 30.0], plane="pitch")
    first, second = loops(nodes, design)
    at_s, nothing = np.array([20.0, 30.0]), np.zeros(2500)
    assert np.array_equal(output_along([first, second], at_s, nothing, 2000), nothing)
    quadratic = tuple(q.model_copy(update={"zero_hz": 1.01 * q.zero_hz}) for q in design.filter.quadratic)
    other = design.model_copy(update={"filter": design.filter.model_copy(update={"quadratic": quadratic})})
    assert output_along([first, *loops(nodes[1:], other)], at_s, nothing, 2000) is None
    ideal = load_scenario("scenarios/nominal.toml", ["switches.slosh=false"])
    assert (
        output_along([first, *loops(operating_points.nodes(ideal, [30.0], plane="pitch"), design)], at_s, nothing, 2000)
        is None
    )


def test_only_lines_that_agree_along_the_ascent_are_explained() -> None:
    reasons = ("", "unexplained", "unexplained", "unexplained", "unexplained", "converter noise")
    ratios = np.array(
        [
            2.0,
            10.0 ** (0.49 / 20),
            10.0 ** (-0.51 / 20),
            np.exp(1j * np.radians(3.9)),
            np.exp(-1j * np.radians(4.1)),
            1.0,
        ]
    )
    assert variation_share(reasons, ratios) == (
        "",
        "time variation",
        "unexplained",
        "time variation",
        "unexplained",
        "converter noise",
    )
