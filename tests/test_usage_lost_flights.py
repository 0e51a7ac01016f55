"""A flight that is lost gives no operating points after the loss: for nodes, `simdesign` and measured margins."""

from __future__ import annotations

import layoutkit
import pytest

from maxq.design import api
from maxq.design.model.node import loss_of, loss_text, node_times, nodes_along, powered_flight, spans_of
from maxq.sim.run.flight import Event
from maxq.sim.run.fly import fly


def test_spans_end_at_the_loss_that_the_flight_reports() -> None:
    scenario = layoutkit.lost_scenario()
    flight = fly(scenario, log=False)
    lost_s = flight.event_s("control_lost")
    assert 10.0 < lost_s < flight.event_s("burnout")
    (span,), loss = powered_flight(scenario)
    assert loss is not None
    assert (loss.name, loss.time_s) == ("control_lost", lost_s)
    assert span.end_s == lost_s
    times = node_times(scenario)
    assert len(times) == 11
    assert max(times) < lost_s
    assert loss_text(loss) == f"control lost at {lost_s:.3f} s"


@pytest.mark.parametrize("name", ["control_lost", "tumble", "diverged"])
def test_each_loss_ends_all_spans(name: str) -> None:
    """Of two stages the first is lost while it burns, or the second before it is ignited."""
    flown = [Event("ignition", 0, 1), Event("liftoff", 0), Event("burnout", int(10e9), 1), Event("ignition", int(12e9), 2)]
    for lost_s, ends in ((4.0, [4.0]), (11.0, [10.0]), (15.0, [10.0, 15.0])):
        loss = Event(name, int(lost_s * 1e9))
        assert [span.end_s for span in spans_of([loss, *flown], 2, 30.0)] == ends
        assert loss_of([*flown, loss]) == loss


def test_a_node_after_the_loss_is_refused() -> None:
    scenario = layoutkit.lost_scenario()
    loss = powered_flight(scenario)[1]
    assert loss is not None
    assert nodes_along(scenario, [loss.time_s - 1.0])[0].time_s == pytest.approx(loss.time_s - 1.0, abs=1e-3)
    said = rf"^node at 24 s: the flight is lost before \({loss_text(loss)}\); allowed are times before the loss$"
    for take in (nodes_along, lambda s, t: api.multiloops(s, s.design, t)):
        with pytest.raises(ValueError, match=said):
            take(scenario, [10.0, 24.0])
