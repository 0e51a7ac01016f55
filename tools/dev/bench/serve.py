"""The loop of a worker: it reads a line from its standard input, flies, and answers with a line of JSON.

In this way, the flights of several programs alternate in one run, each in a separate process with loaded caches.
"""

from __future__ import annotations

import gc
import json
import os
import sys
import time
from collections.abc import Callable
from typing import Any

State = list[float]
"""The end of a flight: position (m) and attitude quaternion, both in any frame at rest."""
Prepare = Callable[[], Callable[[], tuple[int, State]]]


def serve(about: dict[str, Any], prepare: Prepare) -> None:
    """Answer each line of the standard input with a flight, until the input ends.

    `prepare` sets up a flight and returns a function that flies it. This function returns the number of steps and the
    end of the flight. The two calls are timed separately. All other text on the standard output, also from C, is
    discarded.
    """
    answers = os.fdopen(os.dup(1), "w")
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    print(json.dumps(about), file=answers, flush=True)
    for _ in sys.stdin:
        gc.collect()
        start = time.perf_counter()
        fly = prepare()
        set_up = time.perf_counter() - start
        wall, cpu = time.perf_counter(), time.process_time()
        steps, state = fly()
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
        answer = {"cpu_s": cpu, "wall_s": wall, "set_up_s": set_up, "steps": steps, "state": state}
        print(json.dumps(answer), file=answers, flush=True)
