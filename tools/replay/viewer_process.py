"""Child processes that end when their parent does, however it ends.

A viewer without a window that outlives its command would hold memory and a port, and nobody would see it. `finally`
ends it as a rule, but not after SIGKILL. There Linux helps: the kernel kills the child. On other systems a parent that
is killed outright leaves its child.
"""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence

_SET_PARENT_DEATH_SIGNAL = 1  # PR_SET_PDEATHSIG of <linux/prctl.h>
_PATIENCE_S = 5.0


def bound_process(command: Sequence[str], env: dict[str, str]) -> subprocess.Popen[bytes]:
    """Start a program that is killed once the calling thread or its process has ended; stderr can be read.

    Raises OSError where it cannot be started.
    """
    return subprocess.Popen(
        command,
        env=env,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        preexec_fn=_bind_to(os.getpid()),  # noqa: PLW1509  # it calls C only and takes no lock
    )


def run_bound(command: Sequence[str], env: dict[str, str]) -> int:
    """Run such a program to its end; returns its exit code. What it says goes where ours goes."""
    bind = _bind_to(os.getpid())
    with subprocess.Popen(command, env=env, preexec_fn=bind) as process:  # noqa: PLW1509  # as above
        return process.wait()


def end(process: subprocess.Popen[bytes]) -> None:
    """Ask it to end, and make it if it does not."""
    process.terminate()
    try:
        process.wait(timeout=_PATIENCE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stderr is not None:
        process.stderr.close()


def _bind_to(parent: int) -> Callable[[], None] | None:
    """What a child does between fork and exec; prctl is looked up before, since little is safe there."""
    if not sys.platform.startswith("linux"):
        return None
    prctl = ctypes.CDLL(None, use_errno=True).prctl

    def bind() -> None:
        prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
        if os.getppid() != parent:  # it has died in between
            os._exit(1)

    return bind
