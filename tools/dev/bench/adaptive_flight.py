"""A reference flight: the equations of maxq, integrated from instant to instant by SciPy's DOP853 with error control.

An instant is a computer sample, a command, a breakpoint of a schedule or another event; nothing switches between two
instants. There, the adaptive method of order eight (Hairer, Norsett & Wanner, section II.5) integrates the derivative
of the kernels, and starts again after each instant. The kernels of the flight process the instants themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import DOP853

from maxq.control.kernel.jit import bare_pointer, entry
from maxq.control.kernel.records import Array, Records, blank
from maxq.sim.flight.events import process_due_events, step_length
from maxq.sim.flight.parameters import NEVER
from maxq.sim.flight.step import evaluate, read_schedule
from maxq.sim.run.evaluate import Space
from maxq.sim.run.fly import FlightRun
from maxq.sim.vehicle.state import MAX_STATE, R_I, V_I, state_size
from maxq.sim.vehicle.workspace import Evaluation


@entry
def rates(P: Array, pool: Array, state: Array, y: Array, elapsed_s: float, dy: Array, scratch: Records) -> None:
    """Write the derivative at `elapsed_s` after the flight's present instant into `dy`."""
    p, memory = P[0], state[0]
    pool, y, dy = bare_pointer(pool), bare_pointer(y), bare_pointer(dy)
    props, work, aux = scratch[0].properties, scratch[0].work, scratch[0].aux
    now = memory.clock.now_ns
    read_schedule(p, pool, memory, now, elapsed_s, props)
    evaluate(p, pool, memory, now, elapsed_s, Evaluation(props, y, dy, aux), work)


@entry
def next_instant(P: Array, pool: Array, state: Array, y: Array, scratch: Records) -> int:
    """Process all events that are due now. Return the time until the next event, ns."""
    p, memory = P[0], state[0]
    pool, y, props = bare_pointer(pool), bare_pointer(y), scratch[0].properties
    process_due_events(p, pool, memory, y, scratch[0].aux, props)
    return step_length(p, pool, memory, NEVER)


@dataclass
class AdaptiveFlight:
    """A flight that continues a run from its present state. The run must be in flight, with one stage and no
    turbulence.
    """

    run: FlightRun
    relative: float  # relative tolerance
    evaluations: int = 0
    _scratch: Records = field(default_factory=lambda: blank(Space))
    _full: Array = field(default_factory=lambda: np.zeros(MAX_STATE))
    _dy: Array = field(default_factory=lambda: np.zeros(MAX_STATE))

    def __post_init__(self) -> None:
        packed = self.run.packed
        self._n = int(state_size(packed.parameters[0].vehicle.sizes))
        packed.parameters[0].timeline.step_ns = NEVER // 4  # no grid besides the instants
        # position and speed are thousands of times their changes in a step; the other states begin near zero
        tolerance = np.full(self._n, self.relative)
        tolerance[R_I : R_I + 3], tolerance[V_I : V_I + 3] = 1e-3 * self.relative, 1e-2 * self.relative
        self._relative = np.maximum(tolerance, 3e-14)  # SciPy rejects less than 100 eps
        self._absolute = 1e-3 * self.relative

    def _rates(self, elapsed_s: float, y: Array) -> Array:
        packed = self.run.packed
        self._full[: self._n] = y
        rates(packed.parameters, packed.pool, packed.memory, self._full, elapsed_s, self._dy, self._scratch)
        self.evaluations += 1
        return self._dy[: self._n].copy()

    def until(self, end_ns: int, every_ns: int) -> Iterator[tuple[int, Array]]:
        """Yield the time (ns) and the state at every multiple of `every_ns` up to `end_ns`. These times must be
        instants.

        Raises RuntimeError if the integration fails.
        """
        packed, clock = self.run.packed, self.run.memory.clock
        arguments = (packed.parameters, packed.pool, packed.memory, packed.state, self._scratch)
        while int(clock.now_ns) < end_ns:
            length_ns = min(int(next_instant(*arguments)), end_ns - int(clock.now_ns))
            length_s = 1e-9 * length_ns
            y = packed.state[: self._n]
            solver = DOP853(
                self._rates, 0.0, y.copy(), length_s, rtol=self._relative, atol=self._absolute, first_step=length_s
            )
            while solver.status == "running":
                solver.step()
            if solver.status == "failed":
                raise RuntimeError(f"DOP853 fails at {self.run.now_s:.3f} s")
            y[:] = solver.y
            clock.now_ns += length_ns
            clock.steps += 1
            if int(clock.now_ns) % every_ns == 0:
                yield int(clock.now_ns), packed.state.copy()
