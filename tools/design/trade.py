"""The trade-off of --pareto as `simdesign` prints, writes and draws it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from maxq.design.laws.design_file import DESIGN_NAME, design_text
from maxq.design.optimise.pareto import Aim, TradePoint
from maxq.design.optimise.solution import Solution
from maxq.design.verify.outcome import make_design
from maxq.sim.files import write_whole
from maxq.sim.run.quantities import number_text
from maxq.tools.cli.terminal import aligned
from maxq.tools.design.report import SCHEMA, write_record

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from maxq.design.case.schema import LoadedCase

PICTURE = "pareto"


@dataclass(frozen=True)
class StageTrade:
    """The curve of a stage: the design of each point has the solutions `others` of the other stages.

    `stage` is counted from 1. It is None for a case with one stage.
    """

    points: tuple[TradePoint, ...]
    aims: tuple[Aim, Aim]
    stage: int | None = None
    others: tuple[Solution, ...] = ()

    @property
    def suffix(self) -> str:
        """Return the suffix of the names of files."""
        return "" if self.stage is None else f"-stage-{self.stage}"

    def folder_name(self, number: int) -> str:
        """Return the name of the folder of a point, counted from 1."""
        return f"pareto{self.suffix}-{number:02d}"


def trade_table(trade: StageTrade) -> list[str]:
    """Return a row for each point: both objectives, the slope, and the folder of the design."""
    rows = [("design", *(aim.about for aim in trade.aims), "costs dB per dB", "starts near it")]
    for n, point in enumerate(trade.points, 1):
        values = (number_text(aim.shown(db), 5) for aim, db in zip(trade.aims, point.values_db, strict=True))
        slope = "-" if math.isnan(point.slope) else f"{-point.slope:.3f}"
        rows.append((trade.folder_name(n), *values, slope, point.solution.certificate.statement().split(" starts")[0]))
    where = "" if trade.stage is None else f" of stage {trade.stage}"
    return [f"trade-off{where}", *aligned(rows, "  ", right=(1, 2, 3))]


def write_trade(folder: Path, loaded: LoadedCase, trade: StageTrade) -> list[Path]:
    """Write the design of each point and the table as JSON. Return the paths. Raises FileError."""
    aims = trade.aims
    files, names = list[Path](), [aim.about for aim in aims]
    for n, point in enumerate(trade.points, 1):
        said = ", ".join(
            f"{name} {number_text(aim.shown(db), 5)}"
            for name, aim, db in zip(names, aims, point.values_db, strict=True)
        )
        where = "" if trade.stage is None else f" of stage {trade.stage}"
        text = design_text(
            make_design(loaded, point.solution, *trade.others), [f"Point {n} of a trade-off{where}: {said}."]
        )
        files.append(write_whole(folder / trade.folder_name(n) / DESIGN_NAME, text))
    record: dict[str, Any] = {
        "schema": SCHEMA,
        "name": loaded.name,
        **({} if trade.stage is None else {"stage": trade.stage}),
        "objectives": [{"key": aim.key, "about": aim.about} for aim in aims],
        "points": [
            {
                "design": f"{trade.folder_name(n)}/{DESIGN_NAME}",
                "values_db": list(point.values_db),
                "values": [aim.shown(db) for aim, db in zip(aims, point.values_db, strict=True)],
                "slope_db_per_db": point.slope,
                "kkt_residual": point.solution.certificate.kkt_residual,
            }
            for n, point in enumerate(trade.points, 1)
        ],
    }
    return [*files, write_record(folder / f"{PICTURE}{trade.suffix}.json", record)]


def trade_sheets(trade: StageTrade, title: str) -> list[tuple[str, Callable[[], Figure]]]:
    """Return the sheet of the curve."""
    about = title if trade.stage is None else f"{title}, stage {trade.stage}"
    return [(PICTURE + trade.suffix, lambda: trade_figure(trade.points, trade.aims, about))]


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
