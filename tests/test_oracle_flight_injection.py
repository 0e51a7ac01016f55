"""Injected signals equal their textbook forms, and flights beyond the limits end as diverged."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import scipy.signal

from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import Array, pack
from maxq.control.kernel.tables import NO_TABLE, Pool, fit
from maxq.sim.flight import injection
from maxq.sim.flight.injection import MAX_INJECTIONS, MAX_TONES, Injections
from maxq.sim.packing.flight import Packed, pack_flight
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.state import CAUSES, FINITE, N_FIXED, Q_BI, R_I, V_I, W_BI_B, divergence_cause

SIGNAL, TOTAL, SWITCH = (
    from_python(kernel) for kernel in (injection.signal, injection.total_signal, injection.next_switch)
)
REPLACED, DIVERGENCE_CAUSE = from_python(injection.replaced), from_python(divergence_cause)
START_NS, STOP_NS = 2_000_000_000, 6_000_000_000
TONES_HZ, PHASES = np.array([0.5, 1.25, 3.0]), np.array([0.1, -1.0, 2.0])
TABLE_S, TABLE = np.array([2.0, 3.5, 5.0, 6.0]), np.array([[0.0, 1.0], [4.0, 2.0], [-1.0, 5.0], [0.0, 3.0]])


def injected(form: int, *, replaces: int = 0, table=NO_TABLE) -> Any:
    """Return two signals of one form: 3 on the pitch command, -1 on the yaw command."""
    whole, real = np.zeros(MAX_INJECTIONS, np.int64), np.zeros(MAX_INJECTIONS)
    tones = np.zeros((2, MAX_INJECTIONS, MAX_TONES))
    tones[0, :, :3], tones[1, :, :3] = TONES_HZ, PHASES
    axis, amplitude = whole.copy(), real.copy()
    axis[:2], amplitude[:2] = (1, 2), (3.0, -1.0)
    signals = Injections(
        count=2,
        where=whole + injection.RATE_COMMAND,
        axis=axis,
        form=whole + form,
        replaces=whole + replaces,
        start_ns=whole + START_NS,
        stop_ns=whole + STOP_NS,
        amplitude=amplitude,
        frequency_hz=real + 0.75,
        stop_frequency_hz=real + 2.5,
        tones=whole + 3,
        tone_hz=tones[0],
        tone_phase=tones[1],
        column=whole + 1,
        table=table,
    )
    return pack([signals])[0]


def expected(form: int, since: Array) -> Array:
    """Return a signal of amplitude 1 at the time `since` its start."""
    length = 1e-9 * (STOP_NS - START_NS)
    if form == injection.SINE:
        return np.sin(2.0 * np.pi * 0.75 * since)
    if form == injection.CHIRP:
        return np.asarray(scipy.signal.chirp(since, 0.75, length, 2.5, phi=-90.0))
    if form == injection.MULTISINE:
        return np.asarray(np.sin(np.outer(since, 2.0 * np.pi * TONES_HZ) + PHASES).sum(axis=1))
    if form == injection.TABLE:
        return np.interp(since + 1e-9 * START_NS, TABLE_S, TABLE[:, 1])
    return np.where(since < 0.5 * length, 1.0, -1.0 if form == injection.DOUBLET else 1.0)


@pytest.mark.parametrize(
    "form", [injection.STEP, injection.DOUBLET, injection.SINE, injection.CHIRP, injection.MULTISINE, injection.TABLE]
)
def test_a_signal_has_its_form_while_it_is_on_and_is_zero_else(form: int) -> None:
    pool = Pool()
    table = pool.add(fit(TABLE_S, TABLE, "linear"))
    signals, numbers = injected(form, table=table), pool.array()
    step_ns, within_s = 50_000_000, 0.02
    for begin in range(START_NS, STOP_NS, step_ns):
        want = float(expected(form, np.array([1e-9 * (begin - START_NS) + within_s]))[0])
        assert SIGNAL(signals, numbers, 0, begin, within_s) == pytest.approx(3.0 * want, abs=1e-12)
        assert TOTAL(signals, numbers, injection.RATE_COMMAND, 2, begin, within_s) == pytest.approx(-want, abs=1e-12)
    for off in (0, START_NS - 1, STOP_NS):
        assert SIGNAL(signals, numbers, 0, off, 0.0) == 0.0
    assert TOTAL(signals, numbers, injection.RATE_COMMAND, 0, START_NS, 0.0) == 0.0
    assert TOTAL(signals, numbers, injection.BODY_TORQUE, 1, START_NS, 0.0) == 0.0


@pytest.mark.parametrize("replaces", [0, 1])
def test_a_signal_replaces_only_where_and_while_it_says_so(replaces: int) -> None:
    signals = injected(injection.STEP, replaces=replaces)
    for now, on in ((START_NS - 1, 0), (START_NS, 1), (STOP_NS - 1, 1), (STOP_NS, 0)):
        assert REPLACED(signals, injection.RATE_COMMAND, 1, now) == on * replaces
        assert REPLACED(signals, injection.RATE_COMMAND, 0, now) == 0
        assert REPLACED(signals, injection.GIMBAL_COMMAND, 1, now) == 0


@pytest.mark.parametrize("form", [injection.STEP, injection.TABLE])
def test_steps_end_at_every_kink(form: int) -> None:
    pool = Pool()
    signals, numbers = injected(form, table=pool.add(fit(TABLE_S, TABLE, "linear"))), pool.array()
    found, now, latest = [], 0, 10_000_000_000
    while (now := int(SWITCH(signals, numbers, now, latest))) < latest:
        found.append(1e-9 * now)
    kinks = {2.0, 4.0, 6.0} | (set(TABLE_S) if form == injection.TABLE else set())
    assert found == pytest.approx(sorted(kinks), abs=1e-9)


@pytest.fixture(scope="module")
def packed() -> Packed:
    return pack_flight(load_scenario("nominal").scenario)


@pytest.mark.parametrize(
    ("index", "value", "cause"),
    [
        (Q_BI, math.nan, "a state is not finite"),
        (R_I + 2, math.inf, "a state is not finite"),
        (N_FIXED, math.nan, "a state is not finite"),
        (W_BI_B + 1, -1001.0, "the vehicle turns faster than 1000 rad/s"),
        (N_FIXED, 10.5, "a bending mode exceeds 10 m"),
        (
            N_FIXED + 6,
            -10.5,
            "a bending mode exceeds 10 m",
        ),  # the first mode of the yaw plane, after three and their rates
        (R_I, 1.1e9, "the position is more than 1e9 m away or the speed above 1e5 m/s"),
        (V_I + 1, -1.1e5, "the position is more than 1e9 m away or the speed above 1e5 m/s"),
        (W_BI_B, 999.0, ""),
        (N_FIXED, 9.9, ""),
        (N_FIXED + 3, 1e6, ""),  # a rate of bending
    ],
)
def test_divergence_of_a_state_is_detected_and_named(packed: Packed, index: int, value: float, cause: str) -> None:
    state = packed.state.copy()
    sizes = packed.parameters[0].vehicle.sizes
    assert DIVERGENCE_CAUSE(sizes, state) == FINITE
    state[index] = value
    assert CAUSES[DIVERGENCE_CAUSE(sizes, state)] == cause
