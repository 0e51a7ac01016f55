"""The system calls that are permitted to flight code in a sandbox (Linux on x86-64, seccomp).

The code can compute, allocate memory, read files and the clock, and write to its open connections. Any other call fails
with EPERM: opening a file for writing, sockets, processes, threads, signals and changes of the system.
"""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import struct
import sys

_ALLOWED = (
    *(0, 1, 3, 5, 7, 8),  # read, write, close, fstat, poll, lseek
    *(9, 10, 11, 12, 25, 28),  # mmap, mprotect, munmap, brk, mremap, madvise
    *(13, 14, 15, 131),  # rt_sigaction, rt_sigprocmask, rt_sigreturn, sigaltstack
    *(17, 19, 20, 21, 79, 89, 217, 262, 267, 269, 332),  # pread64, readv, writev, access, getcwd, readlink, stat
    *(24, 35, 39, 60, 63, 96, 99, 102, 104, 107, 108, 186, 202, 204, 228, 229, 230, 231),  # time, own ids, futex, exit
    *(273, 318, 334),  # set_robust_list, getrandom, rseq
)
_OPEN, _OPENAT = 2, 257
_MAY_WRITE = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_X86_64 = 0xC000003E  # AUDIT_ARCH_X86_64
_LOAD, _EQUAL, _ANY_BIT, _RETURN = 0x20, 0x15, 0x45, 0x06  # instructions of the Berkeley Packet Filter
_ALLOW, _REFUSE, _KILL = 0x7FFF0000, 0x00050000 | errno.EPERM, 0x80000000
_NUMBER, _ARCHITECTURE, _ARGUMENTS = 0, 4, 16  # offsets in struct seccomp_data
_NO_NEW_PRIVILEGES, _SET_SECCOMP, _FILTER = 38, 22, 2  # of prctl


def sandbox_problem() -> str:
    """Return the reason for which this platform has no sandbox, or an empty string."""
    if sys.platform == "linux" and platform.machine() == "x86_64":
        return ""
    return f"there is no sandbox on {platform.system()} ({platform.machine()}), only on Linux (x86_64)"


def _program() -> bytes:
    """Return the filter: instructions of 8 bytes, with the numbers of instructions to skip if true and if false."""
    made = [(_LOAD, 0, 0, _ARCHITECTURE), (_EQUAL, 1, 0, _X86_64), (_RETURN, 0, 0, _KILL), (_LOAD, 0, 0, _NUMBER)]
    for number, argument in ((_OPEN, 1), (_OPENAT, 2)):
        made += [
            (_EQUAL, 0, 4, number),
            (_LOAD, 0, 0, _ARGUMENTS + 8 * argument),
            (_ANY_BIT, 0, 1, _MAY_WRITE),
            (_RETURN, 0, 0, _REFUSE),
            (_RETURN, 0, 0, _ALLOW),
        ]
    for number in _ALLOWED:
        made += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, _ALLOW)]
    return b"".join(struct.pack("=HBBI", *one) for one in [*made, (_RETURN, 0, 0, _REFUSE)])


def confine() -> None:
    """Limit this process, permanently, to the permitted system calls. Raises OSError."""
    program = ctypes.create_string_buffer(_program())
    head = struct.pack("=H6xQ", (len(program) - 1) // 8, ctypes.addressof(program))  # struct sock_fprog
    prctl = ctypes.CDLL(None, use_errno=True).prctl
    prctl.argtypes = [ctypes.c_int, *[ctypes.c_ulong] * 4]
    filtered = ctypes.create_string_buffer(head)
    if prctl(_NO_NEW_PRIVILEGES, 1, 0, 0, 0) or prctl(_SET_SECCOMP, _FILTER, ctypes.addressof(filtered), 0, 0):
        number = ctypes.get_errno()
        raise OSError(number, f"no sandbox: {os.strerror(number)}")
