"""The JSBSim worker: its rigid launch vehicle (script J2461.xml of its wheel) for 60 s, without output.

Its control system runs at every step.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

import jsbsim  # type: ignore[import-not-found]  # in .venv-bench only, which contains the compared programs

from maxq.tools.dev.bench.serve import State, serve

STEP_S = float(sys.argv[1]) if len(sys.argv) > 1 else 0.001
STEPS = round(60.0 / STEP_S)
M_PER_FT = 0.3048


def prepare() -> Callable[[], tuple[int, State]]:
    executive = jsbsim.FGFDMExec(jsbsim.get_default_root_dir(), None)
    executive.set_debug_level(0)
    executive.load_script("scripts/J2461.xml", STEP_S, "")
    executive.disable_output()
    executive.run_ic()

    def fly() -> tuple[int, State]:
        run = executive.run
        for step in range(STEPS):
            if not run():
                raise RuntimeError(f"JSBSim's script ended after {step} steps")
        return STEPS, _state(executive.get_property_value)

    return fly


def _state(read: Callable[[str], float]) -> State:
    """Return the position in the Earth-fixed frame, m, and the attitude quaternion in the local frame."""
    half = [0.5 * read(f"attitude/{name}-rad") for name in ("phi", "theta", "psi")]
    (cr, cp, cy), (sr, sp, sy) = ([f(a) for a in half] for f in (math.cos, math.sin))
    position_m = [M_PER_FT * read(f"position/ecef-{axis}-ft") for axis in "xyz"]
    return [
        *position_m,
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    ]


def main() -> None:
    serve({"program": "JSBSim", "version": jsbsim.__version__, "flown_s": STEPS * STEP_S}, prepare)


if __name__ == "__main__":
    main()
