"""A case over the paper's filters and gain schedules: its Fig. 9, and the designs of Figs 7, 8, 11 to 14."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from pathlib import Path

from maxq.design.case.design_file import DESIGN_NAME, design_text
from maxq.design.case.read import LoadedCase, read_case
from maxq.design.optimise.plants import Plants
from maxq.design.optimise.solution import Solution
from maxq.design.optimise.solve import solve
from maxq.design.verify.outcome import make_design
from maxq.sim.files import write_whole
from maxq.sim.scenario.schema_design import Design
from maxq.tools.cli.terminal import aligned
from maxq.tools.design import album, pictures_design

STRUCTURES = ("F2", "F3", "F4", "F5", "F6")
SCHEDULES = {"two-phase": "two-phase", "linear": "Subcase 1", "free": "Subcase 2"}
Found = Mapping[tuple[str, str], tuple[LoadedCase, Solution]]
"""By structure and schedule."""


def solve_orders(name: str, overrides: tuple[str, ...], plants: Plants, tell: Callable[[int, int], None]) -> Found:
    """Fifteen problems; each starts from those that it contains, too, so that more freedom never ends worse.

    Raises KeyboardInterrupt when one is interrupted.
    """
    out: dict[tuple[str, str], tuple[LoadedCase, Solution]] = {}
    for structure in STRUCTURES:
        for schedule in SCHEDULES:
            tell(len(out), len(STRUCTURES) * len(SCHEDULES))
            loaded = read_case(name, [*overrides, f"filter.structure={structure}", f"gains.schedule={schedule}"])
            solution = solve(loaded, plants, list(_contained(out, structure, schedule)))
            if solution.status == "interrupted":
                raise KeyboardInterrupt
            out[structure, schedule] = loaded, solution
    return out


def _contained(found: Found, structure: str, schedule: str) -> Iterator[Solution]:
    schedules = tuple(SCHEDULES)
    k, s = STRUCTURES.index(structure), schedules.index(schedule)
    if k > 0:
        yield found[STRUCTURES[k - 1], schedule][1]
    if s > 0:
        yield found[structure, schedules[s - 1]][1]


def orders_table(found: Found) -> list[str]:
    """The objective of each, in dB."""
    rows = [("filter", *SCHEDULES.values(), "gained", "further")]
    for structure in STRUCTURES:
        peaks = [_peak(found[structure, schedule][1]) for schedule in SCHEDULES]
        cells = [_cell(x) for x in (*peaks, peaks[0] - peaks[1], peaks[1] - peaks[2])]
        rows.append((structure, *cells))
    return ["over the filter's order, dB", *aligned(rows, "  ", right=(1, 2, 3, 4, 5))]


def orders_record(found: Found) -> list[dict[str, object]]:
    """For design.json."""
    return [
        {"structure": structure, "schedule": schedule, "status": s.status, "objective_db": s.objective_db,
         "violation_db": s.violation_db, "near_best": s.certificate.near_best, "starts": s.certificate.starts,
         "gains": {"time_s": s.nodes_s.tolist(), "k_p": s.k_p.tolist(), "k_d_s": s.k_d_s.tolist()},
         "filter": asdict(s.filter)}
        for (structure, schedule), (_, s) in found.items()
    ]  # fmt: skip


def order_folder(folder: Path, structure: str, schedule: str) -> Path:
    """Where the design of a filter and a schedule is written."""
    return folder / f"{structure}-{schedule}"


def write_orders(found: Found, folder: Path) -> list[Path]:
    """A design file for each that meets its limits."""
    return [
        write_whole(
            order_folder(folder, structure, schedule) / DESIGN_NAME,
            design_text(make_design(loaded, solution), [f"{structure} with {schedule} gains, of --orders"]),
        )
        for (structure, schedule), (loaded, solution) in found.items()
        if solution.feasible
    ]


def draw_orders(found: Found, plants: Plants, folder: Path) -> list[Path]:
    """Peaks over order; gains and filters of all orders, a picture for each schedule."""
    nodes = [plant.node for plant in plants.each]
    bands, sample_s = album.mode_bands_hz(nodes), nodes[0].instruments.sample_s
    series = {name: {f: _peak(found[f, schedule][1]) for f in STRUCTURES} for schedule, name in SCHEDULES.items()}
    files = pictures_design.peaks_over_order(series, folder / "orders-peaks")
    for schedule in SCHEDULES:
        designs: dict[str, Design] = {f: make_design(*found[f, schedule]) for f in STRUCTURES}
        files += pictures_design.gains(designs, folder / f"orders-gains-{schedule}")
        files += pictures_design.filters(designs, folder / f"orders-filters-{schedule}", sample_s, bands)
    return files


def _peak(solution: Solution) -> float:
    return solution.objective_db if solution.feasible else math.nan


def _cell(value: float) -> str:
    return "infeasible" if math.isnan(value) else f"{value:.2f}"
