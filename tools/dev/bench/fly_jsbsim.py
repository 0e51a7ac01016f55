"""Worker: JSBSim flies its own rigid launch vehicle (script J2461.xml of its wheel) for 60 s at 1 kHz,
output off.
"""

from __future__ import annotations

from collections.abc import Callable

import jsbsim  # type: ignore[import-not-found]  # in .venv-bench only, which holds the programs compared with

from maxq.tools.dev.bench.serve import serve

STEPS = 60_000
STEP_S = 0.001


def prepare() -> Callable[[], int]:
    executive = jsbsim.FGFDMExec(jsbsim.get_default_root_dir(), None)
    executive.set_debug_level(0)
    executive.load_script("scripts/J2461.xml", STEP_S, "")
    executive.disable_output()
    executive.run_ic()

    def fly() -> int:
        run = executive.run
        for step in range(STEPS):
            if not run():
                raise RuntimeError(f"JSBSim's script ended after {step} steps")
        return STEPS

    return fly


def main() -> None:
    serve({"program": "JSBSim", "version": jsbsim.__version__, "flown_s": STEPS * STEP_S}, prepare)


if __name__ == "__main__":
    main()
