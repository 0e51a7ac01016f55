"""Turbulence aft of the nose: the frozen field through which the nose has flown (Taylor's hypothesis).

The nose meets the turbulence first. Let s be the integral of the airspeed. For flight along the body axis, the gust met
at the distance s - x is now x metres aft of the nose. The history contains the gusts of the last ticks over the
vehicle's length. Ticks closer together than a sixtieth of this length share an entry. Before the first tick the field
is the first gust everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from maxq.control.kernel.jit import kernel, routine
from maxq.control.kernel.records import Array
from maxq.sim.world.turbulence import TurbulenceState, turbulence_at

N_PLACES = 64
_LONG_AGO_m = -1e30


@dataclass
class GustHistory:
    """The state record of the gust history.

    - `before_m`, `now_m`: travelled distance at the last tick but one and at the last tick.
    - `place_m`, `gust_mps`: ring buffer of travelled distances and gusts.
    """

    last: int  # newest entry of the ring buffer: the last tick but one
    before_m: float
    now_m: float
    place_m: Annotated[Array, (N_PLACES,)]
    gust_mps: Annotated[Array, (N_PLACES, 3)]


@routine
def history_start(history: GustHistory, gusts: TurbulenceState) -> None:
    """Start the history from the state after `turbulence_start`."""
    history.last, history.before_m, history.now_m = 0, 0.0, 0.0
    for i in range(N_PLACES):
        history.place_m[i] = _LONG_AGO_m
        for j in range(3):
            history.gust_mps[i, j] = gusts.now_mps[j]
    history.place_m[0] = 0.0


@routine
def history_tick(history: GustHistory, gusts: TurbulenceState, way_m: float, reach_m: float) -> None:
    """Advance the history after a `turbulence_tick` over `way_m` of travel; it covers `reach_m` aft of the nose."""
    previous = (history.last + N_PLACES - 1) % N_PLACES
    if history.place_m[history.last] - history.place_m[previous] >= reach_m / (N_PLACES - 4):
        history.last = (history.last + 1) % N_PLACES
    history.before_m = history.now_m
    history.now_m += way_m
    history.place_m[history.last] = history.before_m
    for j in range(3):
        history.gust_mps[history.last, j] = gusts.before_mps[j]


@kernel
def gust_behind(
    history: GustHistory, gusts: TurbulenceState, fraction: float, behind_m: float
) -> tuple[float, float, float]:
    """Return the gust of `turbulence_at` at `behind_m` >= 0 metres aft of the nose, m/s."""
    target = history.before_m + fraction * (history.now_m - history.before_m) - behind_m
    if target >= history.before_m:
        return turbulence_at(gusts, fraction - behind_m / max(history.now_m - history.before_m, 1e-12))
    newer = history.last
    for _ in range(N_PLACES - 1):
        older = (newer + N_PLACES - 1) % N_PLACES
        if history.place_m[older] <= target:
            span = history.place_m[newer] - history.place_m[older]
            share = (target - history.place_m[older]) / span
            g = history.gust_mps
            return (
                g[older, 0] + share * (g[newer, 0] - g[older, 0]),
                g[older, 1] + share * (g[newer, 1] - g[older, 1]),
                g[older, 2] + share * (g[newer, 2] - g[older, 2]),
            )
        newer = older
    return history.gust_mps[newer, 0], history.gust_mps[newer, 1], history.gust_mps[newer, 2]
