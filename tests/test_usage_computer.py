"""The checks of a computer's set-up: its errors name key, value and allowed values."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from maxq.control.computer import build_computer
from maxq.control.filters import BendingFilter, QuadraticSection
from maxq.control.kernel.records import pack
from maxq.control.kernel.tables import Pool, hermite
from maxq.control.laws.pd import GainSchedule, gains_table

SAMPLE_NS = 10_000_000


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"sample_ns": 0}, "sample_ns = 0: allowed is a whole number above 0"),
        ({"sample_ns": 0.5}, "sample_ns = 0.5: allowed"),
        ({"delay_ns": -1}, "delay_ns = -1: allowed is a whole number from 0"),
        ({"count_rad": -1e-5}, "count_rad = -1e-05: allowed"),
        ({"dac_step_rad": np.nan}, "dac_step_rad = nan: allowed"),
        ({"angle_error_limit_rad": 0.0}, "angle_error_limit_rad = 0.0: allowed is above 0"),
        ({"command_limit_rad": np.nan}, "command_limit_rad = nan: allowed is above 0"),
        ({"gains": hermite(np.arange(2.0), *np.zeros((2, 2, 5)))}, "gains has 5 columns: allowed is 4"),
        ({"programme": gains_table(GainSchedule([0.0], [1.0], [1.0]))}, "programme has 4 columns: allowed is 6"),
        (
            {"pitch_filter": BendingFilter((QuadraticSection(9.0, 0.3, 7.0, 0.7),)).discretize(0.02, "zoh")},
            "filter's sample_s = 0.02: allowed is 0.01, the computer's",
        ),
    ],
)
def test_refused(changed: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        build_computer(Pool(), **{"sample_ns": SAMPLE_NS} | changed)


def test_all_that_is_left_out_is_ideal() -> None:
    computer = pack([build_computer(Pool(), sample_ns=SAMPLE_NS)])[0]
    assert computer.converter.count_rad == computer.dac_step_rad == 0.0
    assert computer.command_limit_rad == computer.angle_error_limit_rad == np.inf
    assert computer.law.pd.gains.n_breaks == computer.programme.n_breaks == 0
    assert computer.roll_on == 0
    assert list(computer.law.pd.n_sections) == [0, 0]
