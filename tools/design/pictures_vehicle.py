"""Pictures of the vehicle that is designed for, over time: the paper's Figs 4 to 6."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from maxq.design.model.node import Node
from maxq.design.model.plant import axial_load_mps2
from maxq.design.model.vehicle_at import stability_derivatives
from maxq.tools.plots.palette import BLUE, GREY
from maxq.tools.plots.style import curve, label, save, sheet

_DERIVATIVES = {
    "z_alpha_1ps": r"$Z_\alpha$, 1/s",
    "m_alpha_1ps2": r"$M_\alpha$, 1/s$^2$",
    "z_delta_1ps": r"$Z_\delta$, 1/s",
    "m_delta_1ps2": r"$M_\delta$, 1/s$^2$",
    "m_q_1ps": r"$M_q$, 1/s",
}


def derivatives(
    nodes: Sequence[Node], stem: Path, ranges: Mapping[str, tuple[float, float]] | None = None
) -> list[Path]:
    """Fig. 4: stability derivatives (eqs 4 to 8). `ranges`: of other data, drawn as a band."""
    time_s = [node.time_s for node in nodes]
    values = [stability_derivatives(node.vehicle, node.condition) for node in nodes]
    figure, places = sheet(2, 3, height_in=2.0)
    for place, (key, name) in zip(places, _DERIVATIVES.items(), strict=False):
        if ranges and key in ranges:
            low, high = ranges[key]
            for end in (low, high):
                place.axhline(end, color=GREY, linewidth=0.8, linestyle=":")
        place.plot(time_s, [getattr(v, key) for v in values], color=BLUE)
        label(place, "time, s", name)
    places[-1].axis("off")
    if ranges:
        places[-1].text(0.0, 0.6, "dotted: ends of the ranges\nin Table 2 of the paper", fontsize=8, color=GREY)
    return save(figure, stem)


def bending_frequencies(nodes: Sequence[Node], stem: Path) -> list[Path]:
    """Fig. 5: frequencies of the free-free modes, uncoupled."""
    time_s = [node.time_s for node in nodes]
    most = max(len(node.vehicle.modes.omega_radps) for node in nodes)
    figure, (place,) = sheet(1, 1, height_in=2.8)
    for i in range(most):
        hz = [_entry(node.vehicle.modes.omega_radps, i) / (2.0 * np.pi) for node in nodes]
        place.plot(time_s, hz, **curve(i), label=f"mode {i + 1}")
    sampled_hz = 0.5 / nodes[0].instruments.sample_s
    if most and np.nanmax(np.concatenate([n.vehicle.modes.omega_radps for n in nodes])) / (2 * np.pi) > sampled_hz / 2:
        place.axhline(sampled_hz, color=GREY, linewidth=0.8, linestyle=":", label="half the sample rate")
    place.set_ylim(bottom=0.0)
    label(place, "time, s", "frequency, Hz")
    if most:
        place.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return save(figure, stem)


def slosh_frequencies(nodes: Sequence[Node], tanks: Sequence[str], stem: Path) -> list[Path]:
    """Fig. 6: frequencies of the liquids' pendulums on a vehicle that does not move."""
    time_s = [node.time_s for node in nodes]
    figure, places = sheet(1, 2, height_in=2.6)
    for k, name in enumerate(tanks):
        hz, share = [], []
        for node in nodes:
            bobs = node.vehicle.pendulums
            load = axial_load_mps2(node.vehicle, node.condition)
            hz.append(np.sqrt(max(load, 0.0) / _entry(bobs.length_m, k)) / (2.0 * np.pi))
            share.append(100.0 * _entry(bobs.mass_kg, k) / node.vehicle.body.total_mass_kg)
        places[0].plot(time_s, hz, **curve(k), label=name)
        places[1].plot(time_s, share, **curve(k), label=name)
    for place in places:
        place.set_ylim(bottom=0.0)
    label(places[0], "time, s", "frequency, Hz")
    label(places[1], "time, s", "sloshing mass, % of the vehicle")
    if tanks:
        places[0].legend()
    return save(figure, stem)


def _entry(values: np.ndarray, i: int) -> float:
    """One of a vehicle's modes or tanks; NaN, which is not drawn, where it has fewer."""
    return float(values[i]) if i < len(values) else float("nan")
