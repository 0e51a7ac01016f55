"""Margins and closed-loop poles of a design at every node: `python -m maxq.tools.dev.studies.ksr3.check_loop
[design.toml]`.

The sampled loop, opened at the gimbal command, with the actuator as printed; bending frequencies as they are
and 10 % off. Stability is judged twice, by the closed loop's poles and by encirclements, and the two must
agree.
"""

from __future__ import annotations

import argparse
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from maxq.tools.dev.studies.ksr3 import sampled_loop
from maxq.tools.dev.studies.ksr3.build import VEHICLE_FOLDER
from maxq.tools.dev.studies.ksr3.cases import Case, all_cases
from maxq.tools.dev.studies.ksr3.margins import Margins, margins, unstable_closed_loop_poles
from maxq.tools.dev.studies.ksr3.sampled_loop import Quadratic

DESIGN_FILE = VEHICLE_FOLDER.parents[1] / "designs" / "ksr3-default.toml"


@dataclass(frozen=True)
class Verdict:
    """One case judged. `unstable` counts closed-loop poles outside the unit circle; `encircled` says the same
    from L.

    `slowest_per_s` is the decay of the slowest pole, `bending_peak_db` the largest |L| from 7 Hz to 13 Hz,
    `high_peak_db` above that.
    """

    case: Case
    margins: Margins
    unstable: int
    encircled: float
    slowest_per_s: float
    bending_peak_db: float
    high_peak_db: float
    rigid_hz: float
    rigid_zeta: float


class Design:
    """Gains over time and filter of a design file of structure F2 or F4."""

    def __init__(self, path: Path) -> None:
        data: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
        self._rows = np.array([[r["time_s"], r["k_p"], r["k_d_s"]] for r in data["gains"]["table"]])
        if data["filter"].get("first_order"):
            raise ValueError(f"{path}: only quadratic sections are handled here")
        self.sections = [Quadratic(**section) for section in data["filter"]["quadratic"]]
        self.prewarp_hz: float = data["filter"]["prewarp_hz"]

    def gains_at(self, t: float) -> tuple[float, float]:
        k_p, k_d = (float(np.interp(t, self._rows[:, 0], column)) for column in self._rows.T[1:])
        return k_p, k_d


def judge(case: Case, design: Design) -> Verdict:
    k_p, k_d = design.gains_at(case.time_s)
    control = sampled_loop.controller(k_p, k_d, design.sections, case.period_s, design.prewarp_hz)
    loop = case.response * sampled_loop.response(control, case.frequency_hz, case.period_s)
    poles = sampled_loop.closed_loop_poles(case.plant, control)
    peak = 20 * np.log10(np.abs(loop))
    bending = (case.frequency_hz > 7) & (case.frequency_hz < 13)
    m_delta = case.snapshot.m_delta_ps2
    return Verdict(
        case=case,
        margins=margins(loop),
        unstable=int((np.abs(poles) >= 1).sum()),
        encircled=unstable_closed_loop_poles(loop, case.unstable_poles),
        slowest_per_s=float(-np.log(np.abs(poles).max()) / case.period_s),
        bending_peak_db=float(peak[bending].max()),
        high_peak_db=float(peak[case.frequency_hz >= 13].max()),
        rigid_hz=float(np.sqrt(m_delta * k_p) / (2 * np.pi)),
        rigid_zeta=float(k_d / 2 * np.sqrt(m_delta / k_p)),
    )


def print_table(verdicts: list[Verdict]) -> None:
    print("   t  f_b   GM+ dB  GM- dB  PM deg  |1+L|  mode 1 dB  above dB  unstable  encircled     slow  w_RB  z_RB")
    for v in verdicts:
        m = v.margins
        print(
            f"{v.case.time_s:4.0f} x{v.case.bending_factor:.1f} {m.gain_up_db:8.2f} {m.gain_down_db:7.2f}"
            f" {m.phase_deg:7.1f} {m.modulus:6.3f} {v.bending_peak_db:10.2f} {v.high_peak_db:9.2f}"
            f" {v.unstable:9d} {v.encircled:10.3f} {v.slowest_per_s:8.4f} {v.rigid_hz:5.3f}"
            f" {v.rigid_zeta:5.3f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("design", type=Path, nargs="?", default=DESIGN_FILE)
    parser.add_argument("--vehicle", type=Path, default=VEHICLE_FOLDER)
    arguments = parser.parse_args()
    design = Design(arguments.design)
    verdicts = [judge(case, design) for case in all_cases(arguments.vehicle)]
    print_table(verdicts)
    if any(v.unstable or abs(v.encircled) > 0.1 for v in verdicts):
        raise SystemExit("unstable")


if __name__ == "__main__":
    main()
