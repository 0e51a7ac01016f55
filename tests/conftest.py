"""What holds for all tests.

Hypothesis chooses the same examples in every run, or new ones with MAXQ_EXAMPLES=random. Ctrl-C reaches the commands
under test also where the tests were started in the background: a shell has it ignored there, by all children, too.
"""

from __future__ import annotations

import os
import signal

from hypothesis import settings

# A change lands or not by what it does, not by luck; a busy machine is no reason to fail either.
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("random", derandomize=False, deadline=None, print_blob=True)  # its own default in CI is True
settings.load_profile(os.environ.get("MAXQ_EXAMPLES") or "same")

os.environ.pop("COLUMNS", None)  # workers of pytest-xdist are told 80, as if they wrote to a terminal

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
