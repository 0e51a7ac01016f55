"""The figures of the pages as data, which tools/pages/plots.js draws in the browser of the reader.

A figure therefore fits the width of the page, is readable in dark mode, shows its values, and can be exported.

    figure = Plot("margins", "Margins over the flight", [Panel("phase margin", [line(t, y)], x="time, s", y="deg")])
    as_json([figure])          # for the page
    as_csv(figure)             # a row for each point: panel, series, x, y, y2, run

A colour is a name of the page's style sheet: blue, orange, green, purple, red, sky, ink, grey, pale, limit.
"""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

COLOURS = ("blue", "orange", "green", "purple", "red", "sky", "ink")
DASHES = ("", "6 3", "2 2", "8 3 2 3", "1 3", "10 4", "4 2")
Series = dict[str, Any]


@dataclass
class Panel:
    """A panel of a figure.

    `x` and `y` are labels with units. An end of a range that is None is that of the data. If `rows` is True, the panel
    contains horizontal bars, one below the other.
    """

    title: str
    series: list[Series]
    x: str = ""
    y: str = ""
    x_range: tuple[float | None, float | None] | None = None
    y_range: tuple[float | None, float | None] | None = None
    log_x: bool = False
    log_y: bool = False
    down: bool = False  # y grows downwards
    plane: Literal["", "gain", "phase", "distance", "nichols", "nyquist", "critical"] = (
        ""  # in which series of kind "loop" are drawn; critical: the Nyquist plane near -1, to scale
    )
    height: int = 0  # in pixels; 0: that of the figure
    equal: bool = False  # to scale: a unit has the same length along x and y
    rows: bool = False
    unit: str = ""  # unit of the bars


@dataclass
class Plot:
    """A figure with one or several panels. `command` flies the run whose number replaces {}.

    `loops` are open loops. A slider selects the loop that is drawn in the panels with a `plane`.
    """

    name: str  # letters, digits, hyphens
    title: str
    panels: list[Panel]
    caption: str = ""
    columns: int = 2
    height: int = 190  # height of a panel, in pixels
    command: str = field(default="", kw_only=True)
    loops: list[Series] = field(default_factory=list, kw_only=True)
    split: int = field(default=0, kw_only=True)  # panels of the first column, if ordered in columns; 0: in rows


def look(number: int) -> Series:
    """Return the colour and dashes of curve `number`."""
    return {"colour": COLOURS[number % len(COLOURS)], "dash": DASHES[number % len(DASHES)]}


def line(x: Any, y: Any, name: str = "", **more: Any) -> Series:
    """Return a curve, with gaps at values that are not finite.

    `mark` is "o", "x" or "+" at each point. The values of a `faint` curve are not shown. `who` is the text under the
    pointer, by default the name.
    """
    return {"kind": "line", "colour": "blue", "name": name, "x": x, "y": y} | more


def points(x: Any, y: Any, name: str = "", **more: Any) -> Series:
    """Return marks without a curve. `runs` contains the run of each mark, and `labels` the texts next to them."""
    return {"kind": "points", "colour": "blue", "name": name, "x": x, "y": y} | more


def band(x: Any, low: Any, high: Any, name: str = "", **more: Any) -> Series:
    return {"kind": "band", "colour": "blue", "name": name, "x": x, "y": low, "y2": high} | more


def limit(value: float, name: str = "limit", **more: Any) -> Series:
    """Return a horizontal level. `note` is written on it. If `seen` is True, the axis extends to it."""
    return {"kind": "limit", "colour": "limit", "name": name, "value": value, "seen": True} | more


def at(value: float, name: str = "", **more: Any) -> Series:
    """Return a vertical line."""
    return {"kind": "at", "colour": "limit", "name": name, "value": value} | more


def loop(hz: Any, level_db: Any, phase_deg: Any, name: str, marks: Sequence[Series] = (), **more: Any) -> Series:
    """Return an open loop L over frequency (Hz), with its level (dB) and unwrapped phase (deg).

    It is drawn in the `plane` of its panel. `marks` are points with `x`, `y`, `y2` like those of the loop, `what`
    ("lobe", "gain", "phase", "least") and `name`. A loop among a figure's `loops` also has `group` and `at`, by which a
    reader selects it, its `text`, and `limits`, which are series by plane.
    """
    return {"kind": "loop", "name": name, "x": hz, "y": level_db, "y2": phase_deg, "marks": list(marks)} | more


def shape(outline: Any, name: str = "", **more: Any) -> Series:
    """Return a closed outline from its corners, (n, 2)."""
    corners = np.asarray(outline, float)
    return {"kind": "shape", "colour": "ink", "name": name, "x": corners[:, 0], "y": corners[:, 1]} | more


def thinned(x: Any, y: Any, steps: float = 400.0) -> tuple[Any, Any]:
    """Return a curve without its invisible points: those within 1 / `steps` of both ranges from the previous point
    kept.
    """
    px, py = (np.asarray(v, float) for v in (x, y))
    finite = np.isfinite(px) & np.isfinite(py)
    if finite.sum() < 3:
        return px, py
    a = px / max(np.ptp(px[finite]), 1e-300) * steps
    b = py / max(np.ptp(py[finite]), 1e-300) * steps
    keep, last = [0], 0
    for k in range(1, len(px) - 1):
        if not finite[k] or not finite[last] or math.hypot(a[k + 1] - a[last], b[k + 1] - b[last]) > 1.0:
            keep.append(k)
            last = k
    keep.append(len(px) - 1)
    return px[keep], py[keep]


def as_json(plots: Iterable[Plot]) -> str:
    """Return figures as JSON for a script element. No character of the text can end the element."""
    text = json.dumps([plain(vars(p) | {"panels": [vars(panel) for panel in p.panels]}) for p in plots])
    return text.replace("&", "\\u0026").replace("<", "\\u003c").replace(">", "\\u003e")


def plain(value: Any) -> Any:
    """Return a value for JSON: numbers with six digits, and None for numbers that are not finite."""
    if isinstance(value, dict):
        return {key: plain(v) for key, v in value.items()}
    if isinstance(value, np.ndarray) and value.dtype == np.float64 and value.ndim == 1:
        return _rounded(value)
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, float):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return value


def _rounded(values: Any) -> list[float | None]:
    """Return the numbers of an array (n,) as `plain` does, all at once."""
    finite = np.isfinite(values)
    x = np.where(finite, values, 0.0)
    digits = np.clip(5.0 - np.floor(np.log10(np.maximum(np.abs(x), 1e-17))), -22, 22)  # 10**22 is exact
    up, down = 10.0 ** np.maximum(digits, 0.0), 10.0 ** np.maximum(-digits, 0.0)
    out = np.round(x * up / down) / up * down
    return [v if ok else None for v, ok in zip(out.tolist(), finite.tolist(), strict=True)]


def as_csv(plot: Plot) -> str:
    """Return all drawn data as CSV.

    Column y2 is the second edge of a band or, for bars, the number of values that miss the limit.
    """
    out = io.StringIO()
    rows = csv.writer(out)

    def write(cells: Iterable[Any]) -> None:
        rows.writerow([_no_formula(cell) for cell in cells])

    write(("panel", "series", "x", "y", "y2", "run"))
    for panel in plot.panels:
        for s in panel.series:
            if "value" in s:
                write((panel.title, s["name"], *([s["value"], ""] if s["kind"] == "at" else ["", s["value"]]), "", ""))
                continue
            names: Sequence[str] = s.get("names", [s.get("who", s["name"])] * len(s["y"]))
            columns = [_cells(s.get(key), len(s["y"])) for key in ("x", "y", "y2", "runs")]
            for row in zip(names, *columns, strict=True):
                write((panel.title, *row))
    for s in plot.loops:
        for row in zip(*(plain(s[key]) for key in ("x", "y", "y2")), strict=True):
            write((s["name"], "L: x Hz, y dB, y2 deg", *row, ""))
    return out.getvalue()


def _no_formula(cell: Any) -> Any:
    """Return the cell; a text that a spreadsheet would take for a formula gets an apostrophe in front."""
    return f"'{cell}" if isinstance(cell, str) and cell.startswith(("=", "+", "-", "@", "\t", "\r")) else cell


def _cells(values: Any, count: int) -> list[Any]:
    return [""] * count if values is None else ["" if v is None else v for v in plain(values)]
