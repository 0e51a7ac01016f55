"""Slosh: where it harms, and how much damping it needs.

A liquid that swings between the vehicle's CG and its centre of percussion (as far forward of the CG as I / (m l_c),
l_c from the CG to the gimbal) takes energy from the control loop, in front and behind it gives some away (Bauer, NASA
TR R-187; SP-8031). Whether that matters in *this* loop is told by the loop: damping of the tank is lowered until the
closed loop rings for ever, and that is the damping it needs. Slosh that needs more than the walls give grows until
baffles give it, and that wave is the limit cycle's (slosh_cycle.py): it is predicted with the ring just under the
surface and with the surface midway between rings a radius apart. The worst tank is flown: a kick with just the damping
that is needed neither grows nor decays, and with the midway ring's law the swing ends where it is predicted.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from maxq.design import api
from maxq.design.certificate.breaking import DEAD, LOST, build_up, kicked_growth, watch_at
from maxq.design.certificate.held_flight import hold
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop
from maxq.design.model.dispersion import Dispersion, disperse
from maxq.design.model.node import Node
from maxq.design.verify.slosh_cycle import Baffle, fly_cycle
from maxq.sim.packing.flight import Packed
from maxq.sim.scenario.loader import LoadedScenario
from maxq.sim.scenario.schema_design import Design

NEAR, MIDWAY = Baffle(0.1, 0.25), Baffle(0.5, 0.25)
"""Rings an eighth of the radius wide to reckon with: just below the surface, and where it is midway between two."""
_HALVINGS = 12


@dataclass(frozen=True)
class SloshAdvice:
    """One tank at one time. Stations in m aft of the nose; dampings are ratios of the pendulum.

    `needed` is the damping at which the closed loop just does not grow, 0 where none is needed; `wave_m` and
    `midway_wave_m` the heights of the waves at which the baffles give it, `midway_deg` the latter as the swing of the
    pendulum: the limit cycle's. `flown_growth_1ps`: how a kick grows in flight with just the damping that is needed;
    `flown_deg`: where the swing ends in flight with the midway ring's damping (NaN: not flown, or not settled).
    """

    time_s: float
    tank: int
    bob_station_m: float
    cg_station_m: float
    percussion_station_m: float
    damping: float
    needed: float
    wave_m: float
    midway_wave_m: float
    midway_deg: float
    flown_growth_1ps: float = math.nan
    flown_deg: float = math.nan

    @property
    def in_band(self) -> bool:
        """Between centre of percussion and CG."""
        return self.percussion_station_m < self.bob_station_m < self.cg_station_m


def percussion_station_m(node: Node) -> float:
    """Where the vehicle does not move at first when its engine pushes sideways."""
    v = node.vehicle
    cg = v.total_cg_station_m
    return cg - v.total_inertia_kgm2 / (v.body.total_mass_kg * (v.engine.gimbal_station_m - cg))


def advise(nodes: Sequence[Node], design: Design) -> list[SloshAdvice]:
    """Every tank at every node; tanks without liquid are left out."""
    out = []
    for node in nodes:
        bobs = node.vehicle.pendulums
        for k in range(len(bobs.mass_kg)):
            if bobs.mass_kg[k] <= 0.0:
                continue
            needed = _needed(node, design, k)
            radius = float(node.liquids.radius_m[k]) if node.liquids is not None else math.nan
            out.append(
                SloshAdvice(
                    node.time_s, k, float(bobs.bob_station_m[k]), node.vehicle.total_cg_station_m,
                    percussion_station_m(node), float(bobs.damping_ratio[k]), needed, NEAR.wave_m(needed, radius),
                    MIDWAY.wave_m(needed, radius), MIDWAY.swing_deg(needed),
                )
            )  # fmt: skip
    return out


def _needed(node: Node, design: Design, tank: int) -> float:
    """Damping ratio of one tank below which the closed loop grows; 0 if it never does."""
    have = float(node.vehicle.pendulums.damping_ratio[tank])
    if have <= 0.0:
        return math.nan
    if _growth(node, design, tank, 0.0) < 0.0:
        return 0.0
    low, high = 0.0, 1.0
    while _growth(node, design, tank, high) >= 0.0:
        low, high = high, 2.0 * high
        if high > 64.0:
            return math.inf
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _growth(node, design, tank, middle) >= 0.0 else (low, middle)
    return have * high


def _growth(node: Node, design: Design, tank: int, factor: float) -> float:
    """Greatest real part (1/s) of the loop's oscillating poles below 5 Hz with a tank's damping times `factor`."""
    factors = [1.0] * len(node.vehicle.pendulums.mass_kg)
    factors[tank] = factor
    weak = disperse(node, Dispersion(slosh_damping=tuple(factors)))
    k_p, k_d = api.gains_at(design, node.time_s, node.plane)
    loop = Loop(fixed_path(weak), k_p, k_d, api.filter_of(design, node.instruments.sample_s))
    poles = loop.closed_poles()
    ringing = poles[(np.abs(poles.imag) > 0.5) & (np.abs(poles.imag) < 31.0)]
    return float(ringing.real.max(initial=-math.inf))


def confirm(loaded: LoadedScenario, node: Node, advice: SloshAdvice) -> SloshAdvice:
    """Kick the held vehicle at the slosh frequency, with just the needed damping, and with the midway ring's."""
    if not 0.0 < advice.needed < math.inf:
        return advice

    def fault(packed: Packed) -> None:
        packed.parameters[0].vehicle.slosh.damping_ratio[advice.tank] = advice.needed

    held = hold(loaded, node, fault)
    assert loaded.design is not None
    loop = api.loops([held.node], loaded.design)[0]
    bobs = held.node.vehicle.pendulums
    weak = tuple(advice.needed / z if k == advice.tank else 1.0 for k, z in enumerate(bobs.damping_ratio))
    edge = api.loops([disperse(held.node, Dispersion(slosh_damping=weak))], loaded.design)[0]
    poles = edge.closed_poles()
    ringing = poles[(poles.imag > 0.5) & (poles.imag < 31.0)]
    pole = ringing[int(np.argmax(ringing.real))]
    hz = float(pole.imag) / (2.0 * math.pi)
    growth = kicked_growth(held, loop, watch_at(hz, build_up(edge, hz)), lambda packed: None)
    known = growth not in (LOST, DEAD)
    cycle = fly_cycle(hold(loaded, node), advice.tank, MIDWAY, hz)
    return dataclasses.replace(
        advice,
        flown_growth_1ps=growth if known else math.copysign(9.99, growth),
        flown_deg=cycle.swing_deg if cycle.settled else math.nan,
    )
