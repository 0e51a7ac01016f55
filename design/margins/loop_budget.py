"""The margin budget of a design's loop at a node."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.loop.fixed_path import PadeFixedPath
from maxq.design.loop.loop import Loop
from maxq.design.loop.rational import average, converter_pade, delay_pade, hold_pade
from maxq.design.margins.budget import Budget, Response, split
from maxq.design.margins.measure import Margins
from maxq.design.margins.vehicle_stages import vehicle_stages
from maxq.design.model.instruments import actuator, gyro
from maxq.design.model.node import Node
from maxq.design.model.plant import INPUTS
from maxq.design.model.state_space import ComplexArray, Resolvent, StateSpace, channels


def loop_budget(loop: Loop, frequencies_hz: Sequence[float]) -> tuple[Budget, ...]:
    """Shares of law, filter, converter, delay, hold, gyro, actuator and the vehicle's stages at each frequency.

    The computer's parts are those of the loop's kind: the paper's Pade approximants, or their exact factors. Law and
    filter of a sampled loop are the discrete ones, and a last share, `sampling`, is what the images of the sampled
    spectrum add (aliasing): the sampled path over the exact continuous one. Ideal instruments have no share.
    """
    fixed = loop.fixed
    if not fixed.takes_rate:
        raise ValueError(f"a budget needs the loop that is closed, not the cut {fixed.cut!r}")
    series = [
        ("law", lambda f: loop.k_p * fixed.integrator(f) + loop.k_d_s + 0j),
        ("filter", loop.filter_response),
        *_computer(loop),
        *_instruments(fixed.node),
    ]
    stages = [(name, _vehicle(node)) for name, node in vehicle_stages(fixed.node)]
    if loop.sample_s is not None:
        whole_path = [*_computer(loop), *_instruments(fixed.node), stages[-1]]

        def sampling(f: Array) -> ComplexArray:
            return np.asarray(fixed.response(f) / np.prod([part(f) for _, part in whole_path], axis=0))

        # along with the bent vehicle: it telescopes like a stage and has no phase of its own to follow
        bent = stages[-1][1]
        stages.append(("sampling", lambda f: np.asarray(bent(f) * sampling(f))))
    return tuple(split(loop.response, float(f), series, stages) for f in frequencies_hz)


def crossing_budgets(loop: Loop, measured: Margins) -> dict[str, Budget]:
    """Budgets at the rigid crossover and at each frequency that sets a margin of a stable loop, by its name."""
    if not measured.stable:
        return {}
    wanted = {
        "crossover": measured.crossover_hz,
        "phase margin": measured.phase_deg.frequency_hz,
        "delay margin": measured.delay_s.frequency_hz,
        "gain margin up": measured.gain_up_db.frequency_hz,
        "gain margin down": measured.gain_down_db.frequency_hz,
    }
    inside = {name: f for name, f in wanted.items() if 0.0 < f < np.inf}
    return dict(zip(inside, loop_budget(loop, list(inside.values())), strict=True))


def _computer(loop: Loop) -> list[tuple[str, Response]]:
    timing = loop.fixed.node.instruments
    if isinstance(loop.fixed, PadeFixedPath):
        pade = [("V/F", converter_pade(timing.tau_vf_s)), ("hold", hold_pade(timing.tau_dz_s))]
        if timing.tau_d_s > 0.0:
            pade.insert(1, ("delay", delay_pade(timing.tau_d_s)))
        return [(name, _of_s(part.at)) for name, part in pade]
    return [
        ("V/F", _of_s(lambda s: average(s, timing.tau_vf_s))),
        ("delay", _of_s(lambda s: np.exp(-timing.tau_d_s * s))),
        ("hold", _of_s(lambda s: average(s, timing.tau_dz_s))),
    ]


def _instruments(node: Node) -> list[tuple[str, Response]]:
    out = []
    if not node.instruments.gyro.ideal:
        out.append(("gyro", _channel(gyro(node.instruments.gyro))))
    if not node.instruments.actuator.ideal:
        out.append(("actuator", _channel(actuator(node.actuator))))
    return out


def _channel(system: StateSpace) -> Response:
    resolvent = Resolvent(system.a, system.b[:, :1], system.c[:1])
    return _of_s(lambda s: resolvent(s)[..., 0, 0])


def _vehicle(node: Node) -> Response:
    """Engine angle -> local rate at the gyro, the engine's acceleration going with its angle."""
    ideal = bool(node.instruments.actuator.ideal)
    system = channels(node.plant, ("local_rate_radps",), INPUTS[:1] if ideal else INPUTS)
    resolvent = Resolvent(system.a, system.b, system.c)

    def response(s: ComplexArray) -> ComplexArray:
        body = resolvent(s)[..., 0, :]
        return np.asarray(body[..., 0] if ideal else body[..., 0] + s * s * body[..., 1])

    return _of_s(response)


def _of_s(function: Callable[[ComplexArray], ComplexArray]) -> Response:
    return lambda f: np.asarray(function(2j * np.pi * np.asarray(f, float)), np.complex128)
