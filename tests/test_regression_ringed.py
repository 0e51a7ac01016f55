"""The changes of `ksr3-ringed` to KSR-III remove failures of the suite `standard` in gusts in a limit wind.

| flight, 60 and 300 m of gust before the largest dynamic pressure | ksr3-robust, November | ksr3-ringed, September |
|---|---|---|
| slosh angle, of 17 deg | missed | met |
| gimbal rate, of 27 deg/s; lateral load, of 0.5 g | missed at 60 m | met |

They also meet limits that the earlier design missed slightly: attitude error in one flight of 1,200, and the lower gain
margin at 37 s.
"""

from __future__ import annotations

import numpy as np
import pytest

import maxq
from maxq import margins
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

LIMITS = {
    "max_slosh_deg": 17.0,
    "max_gimbal_rate_degps": 27.0,
    "max_lateral_load_g": 0.5,
    "max_attitude_error_deg": 5.0,
}
GUST = (
    "wind.gust=[{{kind='one-minus-cosine',altitude_m=4100.0,thickness_m={0},edge_m={1},speed_mps=7.65,from_deg=270.0}}]"
)


@pytest.mark.parametrize(
    ("scenario", "wind", "missed_at_60_m", "missed_at_300_m"),
    [
        (
            "nominal",
            "winds/anheung-november.csv",
            {"max_slosh_deg", "max_gimbal_rate_degps", "max_lateral_load_g"},
            {"max_slosh_deg"},
        ),
        ("ksr3-ringed", "winds/anheung-september-limit.csv", set(), set()),
    ],
)
def test_gusts_are_borne_by_the_vehicle_with_rings_alone(
    scenario: str, wind: str, missed_at_60_m: set[str], missed_at_300_m: set[str]
) -> None:
    for thickness, missed in ((60.0, missed_at_60_m), (300.0, missed_at_300_m)):
        gust = GUST.format(thickness, 0.5 * thickness)
        found = fly(load_scenario(scenario, [f"wind.profile='{wind}'", gust, "run.stop_at=['burnout']"]), log=False)
        assert {name for name, limit in LIMITS.items() if not found.metrics[name] <= limit} == missed, thickness


def test_the_gentle_programme_turns_as_far_and_ends_as_fast() -> None:
    plain, gentle = (
        fly(
            load_scenario("ksr3-ringed", [f"guidance.programme='vehicles/ksr3/{name}.csv'", "run.stop_at=['burnout']"]),
            log=False,
        )
        for name in ("pitch_programme", "pitch_programme_gentle")
    )
    for name, room in (("final_speed_mps", 2.0), ("final_altitude_m", 100.0)):
        assert gentle.metrics[name] == pytest.approx(plain.metrics[name], abs=room), name
    assert gentle.metrics["max_q_alpha_Padeg"] < 0.75 * plain.metrics["max_q_alpha_Padeg"]
    assert np.isfinite(gentle.metrics["max_wave_share"])


def test_design_has_gain_for_the_turn_and_for_the_least_stable_instant() -> None:
    flight = fly(maxq.load("campaigns/ksr3-ringed").scenario_of(900), log=False)
    assert 4.0 < flight.metrics["max_attitude_error_deg"] <= LIMITS["max_attitude_error_deg"]
    ringed = load_scenario("ksr3-ringed")
    assert ringed.design is not None
    for loop in maxq.loops(maxq.nodes(ringed, (0.3, 37.0, 47.0)), ringed.design):
        found = margins(loop)
        assert min(found.gain_up_db.value, found.gain_down_db.value) >= 6.0
