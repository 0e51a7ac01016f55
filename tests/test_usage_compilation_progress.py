"""The progress of a compilation is a fraction of its cost, estimated from the bytecode of its kernels."""

from __future__ import annotations

import os

import pytest

from maxq.control.kernel import progress
from maxq.control.kernel.jit import kernel, routine, routine_beside
from maxq.control.kernel.progress import Compilation
from maxq.sim.flight.loop import advance

compiled = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="nothing is compiled")


@kernel
def small(x: float) -> float:
    return x + 1.0


@routine
def shared(x: float) -> float:
    return small(x) * small(x + 1.0)


@routine_beside
def apart(x: float) -> None:
    shared(small(x))


def whole(x: float) -> float:
    apart(x)
    return shared(x)


@compiled
def test_an_estimate_knows_the_kernels_of_a_flight() -> None:
    """The estimate contains kernels of other modules, and separate parts for routines of other processes."""
    parts = Compilation("nominal", [advance.py_func])._parts
    assert {function.__name__ for function in parts} == {"advance", "derivative", "log", "sample_computer"}
    own = {function.__name__ for function in parts[advance.py_func].left}
    assert {"fly_step", "runge_kutta", "transfer_state", "take_over", "track_sections"} < own
    assert "_derivative" not in own


@compiled
def test_the_share_is_that_of_the_cost_and_never_falls() -> None:
    made = Compilation("nominal", [whole])
    part, other = made._parts[whole], made._parts[apart.py_func]
    sizes = dict(part.left)
    assert set(sizes) == {whole, shared.py_func, small.py_func}
    in_each_body = sizes[whole] + sizes[shared.py_func] + 2 * sizes[small.py_func]  # shared is a body of its own
    assert part.translation == sum(sizes.values())
    assert part.cost == pytest.approx(part.translation + progress._OPTIMISED * in_each_body)
    shares = [made.share]
    with made.part(whole):
        made.translated(shared.py_func)
        assert made.share == pytest.approx(sizes[shared.py_func] / (part.cost + other.cost))
        with made.part(apart.py_func):
            made.translated(small.py_func)
            shares.append(made.share)
        shares.append(made.share)
        made.translated()
        shares.append(made.share)
        assert made.share == pytest.approx((part.translation + other.cost) / (part.cost + other.cost))
    with made.part(apart.py_func):  # again, because the other process was killed at its end
        made.translated(small.py_func)
        shares.append(made.share)
    assert shares == sorted(shares)
    assert shares[0] == 0.0
    assert shares[-1] == pytest.approx(1.0)


def test_a_compilation_tells_its_name_until_it_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    told = list[tuple[str, float]]()
    monkeypatch.setattr(progress, "watchers", [lambda *seen: told.append(seen)])
    with progress.compilation("ksr3", whole), progress.compilation("another", whole):
        progress.current().report(0.25)
    with progress.compilation("nothing to compile", whole):
        pass
    assert told == [("ksr3", 0.25), ("ksr3", 1.0)]
