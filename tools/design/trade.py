"""The trade-off of --pareto as `simdesign` prints, writes and draws it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maxq.design.laws.design_file import DESIGN_NAME, design_text
from maxq.design.optimise.pareto import Aim, TradePoint
from maxq.design.verify.outcome import make_design
from maxq.sim.files import write_whole
from maxq.sim.run.quantities import number_text
from maxq.tools.cli.terminal import aligned
from maxq.tools.design.report import SCHEMA, write_record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from maxq.design.case.schema import LoadedCase

RECORD_NAME, PICTURE = "pareto.json", "pareto"


def trade_table(points: Sequence[TradePoint], aims: tuple[Aim, Aim]) -> list[str]:
    """Return a row for each point: both objectives, the slope, and the folder of the design."""
    rows = [("design", *(aim.about for aim in aims), "costs dB per dB", "starts near it")]
    for n, point in enumerate(points, 1):
        values = (number_text(aim.shown(db), 5) for aim, db in zip(aims, point.values_db, strict=True))
        slope = "-" if math.isnan(point.slope) else f"{-point.slope:.3f}"
        rows.append((folder_name(n), *values, slope, point.solution.certificate.statement().split(" starts")[0]))
    return ["trade-off", *aligned(rows, "  ", right=(1, 2, 3))]


def folder_name(number: int) -> str:
    """Return the name of the folder of a point, counted from 1."""
    return f"pareto-{number:02d}"


def write_trade(folder: Path, loaded: LoadedCase, points: Sequence[TradePoint], aims: tuple[Aim, Aim]) -> list[Path]:
    """Write the design of each point and the table as JSON. Return the paths. Raises FileError."""
    files, names = list[Path](), [aim.about for aim in aims]
    for n, point in enumerate(points, 1):
        said = ", ".join(
            f"{name} {number_text(aim.shown(db), 5)}"
            for name, aim, db in zip(names, aims, point.values_db, strict=True)
        )
        text = design_text(make_design(loaded, point.solution), [f"Point {n} of a trade-off: {said}."])
        files.append(write_whole(folder / folder_name(n) / DESIGN_NAME, text))
    record: dict[str, Any] = {
        "schema": SCHEMA,
        "name": loaded.name,
        "objectives": [{"key": aim.key, "about": aim.about} for aim in aims],
        "points": [
            {
                "design": f"{folder_name(n)}/{DESIGN_NAME}",
                "values_db": list(point.values_db),
                "values": [aim.shown(db) for aim, db in zip(aims, point.values_db, strict=True)],
                "slope_db_per_db": point.slope,
                "kkt_residual": point.solution.certificate.kkt_residual,
            }
            for n, point in enumerate(points, 1)
        ],
    }
    return [*files, write_record(folder / RECORD_NAME, record)]


def trade_sheets(
    points: Sequence[TradePoint], aims: tuple[Aim, Aim], title: str
) -> list[tuple[str, Callable[[], Figure]]]:
    """Return the sheet of the curve."""
    return [(PICTURE, lambda: trade_figure(points, aims, title))]


def trade_figure(points: Sequence[TradePoint], aims: tuple[Aim, Aim], title: str) -> Figure:
    """Draw the first objective over the second, with the number of each design."""
    from maxq.tools.plots.style import curve, label, sheet  # noqa: PLC0415  # lazy: Matplotlib

    figure, (place,) = sheet(1, 1, height_in=3.4, title=title)
    first, second = ([aim.shown(p.values_db[k]) for p in points] for k, aim in enumerate(aims))
    place.plot(second, first, marker="o", **curve(0))
    for n, (x, y) in enumerate(zip(second, first, strict=True), 1):
        place.annotate(str(n), (x, y), textcoords="offset points", xytext=(5, 5), fontsize=8)
    label(place, aims[1].about, aims[0].about)
    return figure
