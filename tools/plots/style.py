"""The style of all Matplotlib pictures: fonts, sizes, and files that are equal when what they show is equal.

    with drawing():
        figure, places = sheet(1, 2)
        places[0].plot(time_s, values, color=BLUE)
        save(figure, folder / "margins")          # margins.svg and margins.png

Curves differ by dashes as well as by colour (palette.py), so that a print in grey can be read. The font is the one
that comes with Matplotlib and SVG text is drawn as outlines: a picture looks the same everywhere. SVG files carry no
date and no random names.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.mathtext import MathTextParser
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, NullFormatter
from numpy.typing import NDArray

from maxq.sim.files import whole_file
from maxq.tools.plots.palette import ON_LIGHT, PALE

DASHES = ("-", "--", "-.", ":", (0, (3, 1, 1, 1, 1, 1)), (0, (6, 2)), (0, (1, 1)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

STYLE: Any = {  # newer stubs of Matplotlib want its keys as literals, older ones as text
    "figure.dpi": 120,
    "savefig.dpi": "figure",  # hinted text is not as wide at another resolution than that of the layout
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": PALE,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.3,
    "lines.markersize": 4.0,
    "hatch.linewidth": 0.5,
    "legend.fontsize": 7.5,
    "legend.frameon": True,
    "legend.framealpha": 0.85,
    "legend.edgecolor": "none",
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "xtick.direction": "out",
    "ytick.direction": "out",
    "figure.constrained_layout.use": True,
    "figure.facecolor": "white",
    "svg.fonttype": "path",
    "svg.hashsalt": "maxq",
    "path.simplify": True,
    "path.simplify_threshold": 0.1,
}
PAGE_IN = 7.0  # width of a page between its margins
_TITLE_IN = 0.9  # a title, and the names of the axes of the lowest row
FORMATS = ("svg", "png")
_METADATA = {"svg": {"Date": None, "Creator": "maxq"}, "png": {"Software": "maxq"}}
_MATHEMATICS: Any = MathTextParser("path")
_formats: ContextVar[tuple[str, ...]] = ContextVar("formats", default=FORMATS)


@contextmanager
def drawing(formats: Sequence[str] = FORMATS, settings: Mapping[str, Any] | None = None) -> Iterator[None]:
    """What is drawn and saved inside has the style and these formats; a notebook's settings are left as they were.

    `settings` replace or add some of the style's.
    """
    before = _formats.set(tuple(formats))
    style: Any = dict(STYLE) | dict(settings or {})
    try:
        with mpl.rc_context(style):
            yield
    finally:
        _formats.reset(before)


def sheet(
    rows: int = 1, columns: int = 1, height_in: float = 2.6, width_in: float = PAGE_IN, title: str = "", **more: Any
) -> tuple[Figure, Any]:
    """A figure as wide as a page, `height_in` for each row; its axes as an array (rows * columns,).

    `more` goes to `Figure.subplots`. The figure belongs to no window: nothing has to be closed, no display is needed.
    """
    figure = Figure(figsize=(width_in, height_in * rows + (_TITLE_IN if title else 0.0)))
    if title:
        figure.suptitle(title, fontsize=11, fontweight="bold", x=0.01, ha="left")
    places: NDArray[Any] = np.atleast_1d(figure.subplots(rows, columns, squeeze=False, **more)).ravel()
    return figure, places


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write `stem`.svg and `stem`.png, or as `drawing` says.

    Each under a temporary name first, so that there is a whole one or none.
    """
    _take_as_written(figure)
    layout, files = figure.get_layout_engine(), []
    if layout is not None:  # once for all formats: it takes as long as the drawing
        layout.execute(figure)
        figure.set_layout_engine("none")
    for kind in _formats.get():
        path = stem.with_name(f"{stem.name}.{kind}")
        with whole_file(path) as part:
            figure.savefig(part, format=kind, metadata=_METADATA[kind])
        files.append(path)
    return files


def _take_as_written(figure: Figure) -> None:
    """Names in files may hold dollar signs that are no mathematics: such texts are drawn as they are."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        if text.get_text().count("$") > 1:
            try:
                _MATHEMATICS.parse(text.get_text())
            except ValueError:
                text.set_parse_math(False)


def png(figure: Figure, dpi: float | None = None) -> bytes:
    """The picture in memory, `dpi` pixels an inch (None: as the style says)."""
    _take_as_written(figure)
    out = io.BytesIO()
    figure.set_dpi(dpi or figure.dpi)
    figure.savefig(out, format="png", metadata=_METADATA["png"])
    return out.getvalue()


def label(place: Axes, x: str = "", y: str = "", title: str = "") -> None:
    """Axis labels and a title, each left as it is where empty."""
    if x:
        place.set_xlabel(x)
    if y:
        place.set_ylabel(y)
    if title:
        place.set_title(title)


def plain_numbers(axis: Axis) -> None:
    """0.1, 1, 10 at a logarithmic axis, as engineers write them."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def curve(number: int) -> dict[str, Any]:
    """Colour and dashes of the curve of that number."""
    return {"color": ON_LIGHT[number % len(ON_LIGHT)], "linestyle": DASHES[number % len(DASHES)]}
