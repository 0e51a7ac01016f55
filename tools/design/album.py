"""Which pictures there are of a design: names of files, and what draws each."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from maxq.design.margins.distances import Zone
from maxq.design.model.node import Node
from maxq.design.verify.judging import Judged, Wanted
from maxq.sim.scenario.schema_design import Design
from maxq.tools.design.pictures_design import filters, gains
from maxq.tools.design.pictures_loop import draw_loop, picture_of
from maxq.tools.design.pictures_margins import lobes_over_time, margins_over_time
from maxq.tools.design.pictures_vehicle import bending_frequencies, derivatives, slosh_frequencies

Sheet = tuple[str, Callable[[Path], list[Path]]]
"""Name of the files without suffix, and what draws them there."""


def loop_sheets(judged: Sequence[Judged], title: str, wanted: Wanted) -> list[Sheet]:
    """Bode, Nichols and Nyquist at every node."""
    zones = (wanted.zone,) if wanted.zone is not None else tuple(c.zone for c in judged[0].margins.clearances)
    return [(f"loop-{_stamp(j.time_s)}", partial(_loop, j, f"{title}, {j.time_s:g} s", zones)) for j in judged]


def margin_sheets(designs: Mapping[str, Sequence[Judged]], wanted: Wanted) -> list[Sheet]:
    """Margins over time of one design or several, and the lobes of the first."""
    first = next(iter(designs.values()))
    if len(first) < 2:
        return []
    return [
        ("margins", lambda stem: margins_over_time(designs, wanted, stem)),
        ("lobes", lambda stem: lobes_over_time(first, wanted, stem)),
    ]


def design_sheets(designs: Mapping[str, Design], nodes: Sequence[Node], until_s: float | None = None) -> list[Sheet]:
    """Gains over time and filters (the paper's Figs 7, 8, 11 to 14)."""
    sample_s, bands = nodes[0].instruments.sample_s, mode_bands_hz(nodes)
    return [
        ("gains", lambda stem: gains(designs, stem, until_s)),
        ("filter", lambda stem: filters(designs, stem, sample_s, bands)),
    ]


def vehicle_sheets(
    nodes: Sequence[Node], tanks: Sequence[str], ranges: Mapping[str, tuple[float, float]] | None = None
) -> list[Sheet]:
    """Stability derivatives, bending and slosh frequencies (the paper's Figs 4 to 6)."""
    sheets: list[Sheet] = [("vehicle-derivatives", lambda stem: derivatives(nodes, stem, ranges))]
    if any(len(node.vehicle.modes.omega_radps) for node in nodes):
        sheets.append(("vehicle-bending", lambda stem: bending_frequencies(nodes, stem)))
    if tanks:
        sheets.append(("vehicle-slosh", lambda stem: slosh_frequencies(nodes, tanks, stem)))
    return sheets


def mode_bands_hz(nodes: Sequence[Node]) -> dict[str, tuple[float, float]]:
    """Lowest and highest frequency of every bending mode over the nodes."""
    most = max(len(node.vehicle.modes.omega_radps) for node in nodes)
    out = {}
    for i in range(most):
        hz = [n.vehicle.modes.omega_radps[i] / (2 * np.pi) for n in nodes if len(n.vehicle.modes.omega_radps) > i]
        out[f"mode {i + 1}"] = (float(min(hz)), float(max(hz)))
    return out


def _loop(judged: Judged, title: str, zones: Sequence[Zone], stem: Path) -> list[Path]:
    return draw_loop(picture_of(judged, title, zones), stem)


def _stamp(time_s: float) -> str:
    """A time in a file's name: 005.0s sorts before 040.0s."""
    return f"{time_s:05.1f}s" if round(time_s, 1) == round(time_s, 9) else f"{time_s:08.4f}s"
