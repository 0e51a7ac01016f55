"""What becomes of a loop that grows: a limit cycle with an amplitude, or the loss of the vehicle.

A growing ringing meets the limits of actuator and computer and the nonlinearity of large angles. Growth then ends in
a cycle of fixed amplitude or the vehicle tumbles; which of both, only a flight tells. Slosh that is unstable by the
linear loop is judged by this amplitude, not by a margin.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.certificate.held_flight import Change, HeldFlight
from maxq.design.certificate.loudness import burst_rad
from maxq.sim.flight.telemetry import FAST
from maxq.sim.run.fly import KeptRows
from maxq.sim.scenario.schema_injection import Injection

WATCHED_S = 240.0
STEADY = 0.01  # the last two quarters' amplitudes differ by less than this share


@dataclass(frozen=True)
class LimitCycle:
    """`kind`: "decays", "limit cycle", "grows" (not settled when the watch ended), "lost".

    `gimbal_deg` and `slosh_deg` (largest of all tanks) are amplitudes at the end, `frequency_hz` that of the command.
    """

    kind: str
    frequency_hz: float
    gimbal_deg: float
    slosh_deg: float
    after_s: float

    @property
    def text(self) -> str:
        if self.kind == "limit cycle":
            return (
                f"limit cycle at {self.frequency_hz:.3g} Hz: gimbal {self.gimbal_deg:.2g} deg, "
                f"slosh {self.slosh_deg:.2g} deg"
            )
        return {"decays": "decays", "grows": f"still grows after {self.after_s:g} s"}.get(
            self.kind, f"lost after {self.after_s:.0f} s"
        )


def limit_cycle(
    held: HeldFlight, frequency_hz: float, change: Change | None = None, watched_s: float = WATCHED_S
) -> LimitCycle:  # fmt: skip
    """Kick the held flight at a frequency and see where the ringing ends; `change` makes it one that grows."""
    turn = 1.0 / max(frequency_hz, 0.05)
    burst = Injection.model_validate(
        {
            "at": "gimbal_command", "axis": held.plane, "kind": "sine", "frequency_hz": max(frequency_hz, 0.05),
            "amplitude_deg": math.degrees(burst_rad(held, frequency_hz)), "stop_s": round(3.0 * turn, 6),
        }
    )  # fmt: skip
    run = held.run(watched_s, (burst,)) if change is None else held.run(watched_s, (burst,), change)
    kept = KeptRows()
    while not run.finished:
        kept.add(run.fly_segment())
    _, rows = kept.rows()[FAST]
    command = rows[:, run.table.index(f"gimbal_{held.plane}_command_deg")]
    names = [c.name for c in run.table.columns(FAST)]
    slosh = [names.index(n) for n in names if n.startswith("slosh") and n.endswith(f"{held.plane}_deg")]
    quarter = len(command) // 4
    before, after = command[2 * quarter : 3 * quarter], command[3 * quarter :]
    flown_s = run.now_s
    if flown_s < watched_s - 1.0 or quarter < 8:
        return LimitCycle("lost", frequency_hz, _amplitude(command), _largest(rows, slosh, 0), flown_s)
    level, earlier = _amplitude(after), _amplitude(before)
    swing = _largest(rows, slosh, 3 * quarter)
    at_start = _amplitude(command[:quarter])
    if level < 0.5 * earlier or level < 0.05 * at_start:
        kind = "decays"
    elif abs(level / earlier - 1.0) < STEADY:
        kind = "limit cycle"
    else:
        kind = "grows" if level > earlier else "decays"
    return LimitCycle(kind, _frequency(after, held.sample_s), level, swing, flown_s)


def _amplitude(samples: Array) -> float:
    """Half of what lies between the extremes, deg."""
    return float(0.5 * np.ptp(samples)) if len(samples) else 0.0


def _largest(rows: Array, columns: list[int], first: int) -> float:
    return max((_amplitude(rows[first:, c]) for c in columns), default=0.0)


def _frequency(samples: Array, sample_s: float) -> float:
    """Of the strongest line, Hz."""
    spectrum = np.abs(np.fft.rfft((samples - samples.mean()) * np.hanning(len(samples))))
    return float(np.argmax(spectrum) / (len(samples) * sample_s))
