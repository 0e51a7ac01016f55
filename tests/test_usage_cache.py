"""The folder of compiled kernels has safe permissions, and damaged files in it are replaced."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from maxq.control.kernel import jit, kept_code

CALL = """
from maxq.control.kernel.jit import from_python
from maxq.control.kernel.vectors import cross
print(from_python(cross)((1.0, 2.0, 3.0), (4.0, 5.0, 7.0)))
"""
ANSWER = "(-1.0, 5.0, -3.0)"


def call(cache: Path, *words: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"MAXQ_CACHE": str(cache)}
    command = [sys.executable, *(words or ("-c", CALL))]
    return subprocess.run(command, check=False, env=environment, capture_output=True, text=True, timeout=120)


@pytest.mark.slow
def test_damaged_machine_code_is_compiled_again(tmp_path: Path) -> None:
    cache = tmp_path / "cache"
    assert call(cache).stdout.strip() == ANSWER
    assert cache.stat().st_mode & 0o077 == 0
    (code,), (index,) = cache.rglob("*.nbc"), cache.rglob("*.nbi")
    whole = {path: path.read_bytes() for path in (code, index)}
    loaded = call(cache, "-c", f"{CALL}import sys; print('scipy.linalg' in sys.modules)")  # Numba's compiler needs it
    assert loaded.stdout.split("\n") == [ANSWER, "False", ""]
    assert code.read_bytes() == whole[code]
    for path, content in whole.items():
        assert kept_code._whole_content(path)
        flipped = bytearray(content)
        flipped[len(content) // 2] ^= 1
        for damaged in (b"", content[: len(content) // 2], bytes(flipped)):
            path.write_bytes(damaged)
            assert kept_code._whole_content(path) == b""
        again = call(cache)
        assert (again.stdout.strip(), again.stderr) == (ANSWER, "")
        assert path.read_bytes() != damaged


@pytest.mark.slow
def test_a_kernel_that_python_calls_is_compiled_once(tmp_path: Path) -> None:
    """Without `from_python`, the second process does not load Numba's compiler."""
    program = (
        "import sys\nfrom maxq.control.kernel.vectors import sine_cosine\n"
        "print(sine_cosine(0.0), 'scipy.linalg' in sys.modules)"
    )
    printed = [call(tmp_path, "-c", program).stdout for _ in range(2)]
    assert printed == ["(0.0, 1.0) True\n", "(0.0, 1.0) False\n"]


@pytest.mark.slow
def test_like_sources_elsewhere_are_compiled_once(tmp_path: Path) -> None:
    """Another checkout or an installed wheel loads the compiled code, unless a source differs."""
    cache, here = tmp_path / "cache", Path(jit.__file__).parents[2]
    assert call(cache).stdout.strip() == ANSWER
    for layer in ("control", "sim", "design"):
        shutil.copytree(here / layer, tmp_path / "maxq" / layer, ignore=lambda _, names: {"__pycache__"} & set(names))
    elsewhere = (
        f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\n{CALL}print(sys.modules[cross.__module__].__file__)"
    )
    for compiled in (1, 2):
        found = call(cache, "-c", elsewhere)
        assert (found.stdout.split("\n"), found.stderr) == (
            [ANSWER, str(tmp_path / "maxq/control/kernel/vectors.py"), ""],
            "",
        )
        assert len(list(cache.rglob("*.nbc"))) == compiled
        (tmp_path / "maxq/control/kernel/vectors.py").open("a").write("# another\n")


COUNTED = f"""
import time
from maxq.control.kernel import compilers

DONE, compiled = [], compilers.EntryCompiler._compile_core
def counted(self):
    DONE.append(self)
    if {{fails}}:
        raise RuntimeError("no code")
    time.sleep(1.0)  # the others come meanwhile
    return compiled(self)
compilers.EntryCompiler._compile_core = counted
try:
{"".join(f"    {line}" for line in CALL.splitlines(keepends=True)[1:])}finally:
    print(len(DONE))
"""


@pytest.mark.slow
def test_workers_that_begin_together_compile_once(tmp_path: Path) -> None:
    """A single worker compiles; if it fails, another one does."""
    environment = os.environ | {"MAXQ_CACHE": str(tmp_path / "cache")}
    scripts = [COUNTED.format(fails=fails) for fails in (True, False, False, False)]
    workers = [
        subprocess.Popen([sys.executable, "-c", script], env=environment, stdout=subprocess.PIPE, text=True)
        for script in scripts
    ]
    failed, *done = [worker.communicate(timeout=120)[0].split("\n") for worker in workers]
    assert failed in (["1", ""], [ANSWER, "0", ""])
    assert sorted(done) == [[ANSWER, "0", ""], [ANSWER, "0", ""], [ANSWER, "1", ""]]


BESIDE = """
import math, os, sys
import numpy as np
from maxq.control.kernel import compilers, jit, kept_code, progress

DONE, SHARES, AS = [], [], compilers.BesideCompiler
progress.watchers.append(lambda name, share: SHARES.append(share))
HOW = sys.argv[1]
if HOW == "killed":
    AS.compile_and_leave = lambda self, name, write: os.kill(os.getpid(), 9)
elif HOW == "not allowed":
    AS.allowed = False
elif HOW == "not to be had":
    def refused():
        raise BlockingIOError("no more processes")
    AS.allowed, os.fork = True, refused
elif HOW in ("interrupted", "resumed"):
    AS.allowed, kept_code._SOURCES = True, frozenset({os.path.realpath(__file__)})  # of which maxq keeps routines
    if HOW == "interrupted":
        compilers.load_objects = lambda *_: os._exit(3)  # once the other process has ended
    else:
        os.fork = None
else:
    AS.allowed = hasattr(os, "fork")
here = AS.here
AS.here = lambda self: (DONE.append(self), here(self))[1]

@jit.kernel
def half(x):
    return 0.5 * x

@jit.routine
def shared(x, out, unread, at):  # too long for LLVM to inline it; what is not read need not be passed in one of them
    total = 0.0
    for i in range(at, at + 3):
        for factor in (1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0):
            total += math.sin(i * factor * x) * math.cos(i - factor * x) * math.exp(-factor * x)
            if total > 1e3:
                total = math.sqrt(total) + math.log(factor + total)
    out[at] = half(x) + 0.0 * total

@jit.routine_beside
def fill(x, out) -> None:
    for at in range(1, 3):
        shared(half(x), out, at, at)
        shared(x, out, at, at)
    out[0] = half(x) + 3.0

def both(x, out):
    out = jit.bare_pointer(out)
    fill(x, out)
    for at in range(1, 3):
        shared(x + out[at], out, at, at)
        shared(x + out[at], out, at, at)

out = np.zeros(3)
jit.from_python(both)(8.0, out)
print(*out, len(DONE), len(SHARES) > 4 and SHARES[0] < 0.5, SHARES == sorted(SHARES), *SHARES[-1:])
"""


@pytest.mark.slow
@pytest.mark.parametrize(("how", "here"), [("beside", 0), ("killed", 1), ("not allowed", 1), ("not to be had", 1)])
def test_a_routine_compiled_by_another_process(tmp_path: Path, how: str, here: int) -> None:
    """The result is the same if the other process is killed or cannot start, and if the code is in the cache.

    The completed fraction never falls and ends at 1, whichever process compiles.
    """
    script = tmp_path / "beside.py"  # Numba keeps code of functions in files only
    script.write_text(BESIDE)
    for compiled, made in ((here, "new"), (0, "kept"))[: 2 if how in ("beside", "killed") else 1]:
        done = call(tmp_path / "cache", str(script), how)
        progress = "True True 1.0" if compiled or made == "new" else "False True"  # of loaded code there is none
        assert (done.stdout, done.stderr) == (f"7.0 7.0 7.0 {compiled} {progress}\n", "")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="other processes compile on Linux only")
def test_a_killed_compilation_keeps_what_was_finished(tmp_path: Path) -> None:
    """The next process compiles only a damaged routine, and loads the others without another process."""
    script, cache = tmp_path / "beside.py", tmp_path / "cache"
    script.write_text(BESIDE)
    assert call(cache, str(script), "interrupted").returncode == 3
    (kept,) = cache.rglob("*.o")
    assert list(cache.rglob("*.nbc")) == []
    whole = kept.read_bytes()
    kept.write_bytes(whole[:-1])
    assert "NoneType" in call(cache, str(script), "resumed").stderr
    kept.write_bytes(whole)
    done = call(cache, str(script), "resumed")
    assert (done.stdout, done.stderr) == ("7.0 7.0 7.0 0 True True 1.0\n", "")


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="no owners of files on this system")
@pytest.mark.parametrize("part", ["", "verified", "verified/below"])
def test_cache_to_which_others_may_write_is_refused(tmp_path: Path, part: str) -> None:
    cache = tmp_path / "cache"
    (cache / part).mkdir(parents=True)
    (cache / part).chmod(0o777)
    code = "from maxq.control.kernel.machine import own_cache; own_cache('verified/below')"
    refused = call(cache, "-c", code)
    assert refused.returncode == 1
    assert "other users may write to this cache" in refused.stderr


def test_command_refuses_such_a_cache_in_one_line(tmp_path: Path) -> None:
    tmp_path.chmod(0o777)
    refused = call(tmp_path, "-m", "maxq.tools.simrun", "nominal", "--no-log")
    assert refused.returncode == 2
    assert refused.stderr.strip() == (
        f"simrun: {tmp_path}: other users may write to this cache; "
        "give a cache folder of your own to which no one else may write (chmod go-w)"
    )
