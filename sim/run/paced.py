"""A flight at the pace of the host's clock: each sample of the flight computer is processed at its time or later.

The flight is flown from sample to sample, with a wait in between. Its state and log equal those of a flight without a
pace, bit for bit, because a flight may be continued at every sample.
"""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.packing.flight import Packed
from maxq.sim.run.flight import Event, LoggedRows, copied, joined
from maxq.sim.run.fly import OVERRUN_NAME, FlightRun
from maxq.sim.scenario.loader import LoadedScenario

_LONGEST_SLEEP_S = 0.1  # between two looks for an interruption


@dataclass(frozen=True)
class Lateness:
    """The lateness of the cycles of a paced flight: of their beginnings, against their times on the host's clock.

    - `cycles`: number of cycles.
    - `late_mean_s`, `late_99_s`, `late_max_s`, `late_max_at_s`: mean, 99 % quantile, largest value and its time of
      flight.
    - `overruns`: number of cycles that were due before the preceding one had been computed.
    - `overrun_max_s`: largest lateness of these.
    """

    cycles: int
    late_mean_s: float
    late_99_s: float
    late_max_s: float
    late_max_at_s: float
    overruns: int
    overrun_max_s: float


class PacedRun(FlightRun):
    """A flight whose samples are processed at their times on the host's clock, or later.

    `factor` is the ratio of flight time to real time. The clock starts with the first segment. A cycle that is due
    before the preceding one has been computed begins at once; the times of later cycles do not change, so that the
    flight catches up. If a cycle begins more than `limit_s` late, the flight ends with the outcome "overrun". `stop` is
    called during waits, and ends them.
    """

    def __init__(
        self,
        loaded: LoadedScenario,
        packed: Packed | None = None,
        log: bool = True,
        *,
        factor: float = 1.0,
        limit_s: float = math.inf,
        stop: Callable[[], bool] = lambda: False,
    ) -> None:
        super().__init__(loaded, packed, log)
        self.stop, self.factor, self.limit_s = stop, factor, limit_s
        self._begun_s, self._begun_ns = math.nan, self._now_ns
        self._times_s, self._late_s, self._overran = array("d"), array("d"), array("b")
        self._overrun: Event | None = None

    @property
    def finished(self) -> bool:
        return self._overrun is not None or super().finished

    @property
    def outcome(self) -> str:
        return super().outcome if self._overrun is None else OVERRUN_NAME

    @property
    def events(self) -> tuple[Event, ...]:
        return super().events if self._overrun is None else (*super().events, self._overrun)

    def fly_segment(self, length_ns: int | None = None) -> LoggedRows:
        """Fly from sample to sample, up to the first one at or after the end of the segment."""
        length_ns = length_ns or self.segment_ns
        end_ns = (self._now_ns // length_ns + 1) * length_ns
        if math.isnan(self._begun_s):
            self._begun_s = time.monotonic()
        parts: list[LoggedRows] = []
        while not parts or (not self.finished and self._now_ns < end_ns):
            now_ns, clock = self._now_ns, self.packed.memory["clock"]
            next_ns = int(clock["next_sample_ns"][0])
            if next_ns <= now_ns:  # a sample that is processed when the flight continues
                self._await(now_ns)
                next_ns = now_ns + int(self.packed.parameters[int(clock["stage"][0])].computer.sample_ns)
            parts.append(copied(self.fly_until(next_ns)))
            if self.stop():
                break
        return joined(parts)

    def _await(self, now_ns: int) -> None:
        """Wait for the time of a sample, and record the lateness of its cycle."""
        due_s = self._begun_s + 1e-9 * (now_ns - self._begun_ns) / self.factor
        overran = time.monotonic() > due_s
        while (left_s := due_s - time.monotonic()) > 0.0 and not self.stop():
            time.sleep(min(left_s, _LONGEST_SLEEP_S))
        late_s = max(time.monotonic() - due_s, 0.0)
        self._times_s.append(1e-9 * now_ns)
        self._late_s.append(late_s)
        self._overran.append(overran)
        if late_s > self.limit_s:
            detail = f"a cycle began {1e3 * late_s:.3g} ms late, at most {1e3 * self.limit_s:.3g} ms are allowed"
            self._overrun = Event(OVERRUN_NAME, now_ns, detail=detail)

    @property
    def cycles(self) -> Array:
        """Return a row for each cycle (n, 3): time, s, lateness, s, and 1 for an overrun."""
        return np.column_stack([self._times_s, self._late_s, self._overran])

    def lateness(self) -> Lateness:
        """Return the lateness of all cycles so far; nan without any."""
        if not self._late_s:
            return Lateness(0, *(4 * (math.nan,)), 0, 0.0)
        times_s, late_s, overran = self.cycles.T
        worst = int(np.argmax(late_s))
        of_overruns = late_s[overran > 0.0]
        return Lateness(
            len(late_s),
            float(late_s.mean()),
            float(np.quantile(late_s, 0.99)),
            float(late_s[worst]),
            float(times_s[worst]),
            len(of_overruns),
            float(of_overruns.max(initial=0.0)),
        )
