"""`simdesign errata`: what each erratum of the paper does to peaks and margins at every node."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from maxq.sim.files import FileError, write_whole
from maxq.sim.scenario.errors import ScenarioError
from maxq.tools.cli.terminal import Progress, aligned, printable
from maxq.tools.design.analyse import default_times_s, find_nodes, load

if TYPE_CHECKING:
    from maxq.design.api import Plant
    from maxq.design.loop.errata_effects import Effect
    from maxq.design.loop.fixed_path import Cut
    from maxq.design.model.node import Node
    from maxq.sim.scenario.schema_design import Design

_DONE, _BAD_INPUT = 0, 2
DEFAULT_DESIGN = "ksr3-default"
_UNSTABLE = "unstable"
QUANTITIES = {
    "peak 1": "peak of mode 1, dB",
    "peak 2": "peak of mode 2, dB",
    "peak 3": "peak of mode 3, dB",
    "gain": "gain margin (least of up and down), dB",
    "phase": "phase margin, deg",
    "slosh": "highest peak of slosh, dB",
}


@dataclass(frozen=True)
class Order:
    """What the command line asks for."""

    design: str = DEFAULT_DESIGN
    scenario: str = "nominal"
    vehicle: str | None = None
    times_s: tuple[float, ...] = ()
    plant: Plant = "flown"
    out: str | None = None


def execute(order: Order) -> int:
    """Do it; returns the exit code."""
    try:
        scenario, design = load(order.scenario, order.vehicle, order.design)
        with Progress() as progress:
            nodes = find_nodes(scenario, order.times_s or default_times_s(design), "pitch", plant=order.plant)
            found: list[Effect] = []
            for n, node in enumerate(nodes):
                found += effects([node], design)
                progress.show("switching errata", n + 1, len(nodes))
        text = report(found, order)
        if order.out is not None:
            write_whole(Path(order.out), text + "\n")
    except (ScenarioError, FileError) as error:
        print(f"simdesign: {printable(str(error))}", file=sys.stderr)
        return _BAD_INPUT
    print(text)
    return _DONE


def effects(nodes: Sequence[Node], design: Design) -> list[Effect]:
    """Of every erratum at every node, on the design's loop with the paper's Pade approximants."""
    from maxq.design.loop.errata_effects import errata_effects  # noqa: PLC0415  # lazy

    return errata_effects(nodes, lambda node, cut: _measure(node, cut, design))


def _measure(node: Node, cut: Cut, design: Design) -> Mapping[str, float]:
    """Peaks, and margins where the loop is one: 1 in `unstable` where it is not stable."""
    from maxq.design import api  # noqa: PLC0415  # lazy
    from maxq.design.loop.errata_effects import peaks_db  # noqa: PLC0415  # lazy
    from maxq.design.loop.fixed_path import fixed_path  # noqa: PLC0415  # lazy
    from maxq.design.margins.measure import margins  # noqa: PLC0415  # lazy

    loop = api.close(fixed_path(node, "pade", cut), design)
    peaks = peaks_db(loop)
    out = {f"peak {i}": peaks[f"bending {i}"] for i in (1, 2, 3) if f"bending {i}" in peaks}
    slosh = [db for name, db in peaks.items() if name.startswith("slosh")]
    if slosh:
        out["slosh"] = max(slosh)
    if cut == "gimbal_command":
        m = margins(loop, resonances=loop.fixed.resonances(), zones=())
        out |= {"gain": min(m.gain_up_db.value, m.gain_down_db.value), "phase": m.phase_deg.value}
        out[_UNSTABLE] = float(not m.stable)
    return out


def report(found: Sequence[Effect], order: Order) -> str:
    """A table of every quantity: a row an erratum, a column a node; printed less corrected."""
    times = list(dict.fromkeys(e.node.time_s for e in found))
    names = list(dict.fromkeys(e.erratum for e in found))
    by_place = {(e.erratum, e.node.time_s): e for e in found}
    about = {e.erratum: e.about for e in found}
    head = [
        "errata of Lee, Ahn & Roh: what each does, left in alone, to the open loop (cut at the gimbal command,",
        f"paper's Pade approximants) of {order.design} along {order.scenario}; plant: {order.plant}",
    ]
    rows = [("nr", "switch", "equations", "as printed", "corrected")]
    rows += [(a.number, name, a.equations, a.printed, a.corrected) for name, a in about.items()]
    parts = [head, aligned(rows)]
    for key, title in QUANTITIES.items():
        if any(key in e.corrected for e in found):
            parts.append([f"{title}: as printed less corrected", *_matrix(key, names, times, by_place)])
    legend = "unst.: the loop as printed is unstable and has no margin; -: the loop has none of it, or cannot be made"
    errors = dict.fromkeys(f"{e.erratum}: {e.error}" for e in found if e.error)
    parts.append([legend, *errors])
    return "\n\n".join("\n".join(part) for part in parts)


def _matrix(key: str, names: list[str], times: list[float], found: Mapping[tuple[str, float], Effect]) -> list[str]:
    rows = [("time, s", *(f"{t:g}" for t in times))]
    rows.append(("corrected", *(_cell(found[names[0], t].corrected.get(key, math.nan)) for t in times)))
    for name in names:
        rows.append((name, *(_change(found[name, t], key) for t in times)))
    return aligned(rows, "  ", right=tuple(range(1, 1 + len(times))))


def _change(effect: Effect, key: str) -> str:
    if key in ("gain", "phase") and effect.printed.get(_UNSTABLE, 0.0) > 0.0:
        return "unst."
    return _cell(effect.change(key), sign="+")


def _cell(value: float, sign: str = "") -> str:
    return "-" if math.isnan(value) else "inf" if math.isinf(value) else f"{value:{sign}.2f}"
