"""How Hypothesis chooses its examples: the same ones in every run, or new ones with MAXQ_EXAMPLES=random."""

from __future__ import annotations

import os

from hypothesis import settings

# A change lands or not by what it does, not by luck; a busy machine is no reason to fail either.
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("random", derandomize=False, deadline=None, print_blob=True)  # its own default in CI is True
settings.load_profile(os.environ.get("MAXQ_EXAMPLES") or "same")
