"""The style of all Matplotlib pictures: fonts, sizes, and files that are equal if their content is equal.

    with drawing():
        figure, places = sheet(1, 2)
        places[0].plot(time_s, values, color=BLUE)
        save(figure, folder / "margins")          # margins.svg and margins.png

Curves differ by dashes as well as by colour (palette.py), so that a greyscale print is readable. The font is that of
Matplotlib, and SVG text is drawn as outlines, so that a picture looks the same everywhere. SVG files contain no date
and no random names.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.mathtext import MathTextParser
from matplotlib.patheffects import withStroke
from matplotlib.text import Annotation, Text
from matplotlib.ticker import FuncFormatter, NullFormatter
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from maxq.sim.files import whole_file
from maxq.tools.plots.palette import BLACK, ON_LIGHT, PALE

DASHES = ("-", "--", "-.", ":", (0, (3, 1, 1, 1, 1, 1)), (0, (6, 2)), (0, (1, 1)))
MARKERS = ("o", "s", "^", "D", "v", "P", "X")

STYLE: Any = {  # newer stubs of Matplotlib expect its keys as literals, older ones as text
    "figure.dpi": 120,
    "savefig.dpi": "figure",  # the width of hinted text at another resolution differs from that in the layout
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
_TITLE_IN = 0.9  # height of a title, and of the axis labels of the lowest row
FORMATS = ("svg", "png")
_METADATA = {"svg": {"Date": None, "Creator": "maxq"}, "png": {"Software": "maxq"}}
_MATHEMATICS: Any = MathTextParser("path")
_formats: ContextVar[tuple[str, ...]] = ContextVar("formats", default=FORMATS)


@contextmanager
def drawing(formats: Sequence[str] = FORMATS, settings: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Apply the style within the block, where `save` writes these formats. Restore the settings of a notebook
    afterwards.

    `settings` replace or extend those of the style.
    """
    before = _formats.set(tuple(formats))
    style: Any = dict(STYLE) | dict(settings or {})
    try:
        with mpl.rc_context(style):
            yield
    finally:
        _formats.reset(before)


class _Shown(Figure):
    """A figure without pyplot that a notebook can display."""

    def _repr_png_(self) -> bytes:
        return png(self)


def sheet(
    rows: int = 1, columns: int = 1, height_in: float = 2.6, width_in: float = PAGE_IN, title: str = "", **more: Any
) -> tuple[Figure, Any]:
    """Return a figure as wide as a page, with `height_in` per row, and its axes as an array (rows * columns,).

    `more` is passed to `Figure.subplots`. The figure belongs to no window, so it need not be closed and needs no
    display.
    """
    figure = _Shown(figsize=(width_in, height_in * rows + (_TITLE_IN if title else 0.0)))
    if title:
        figure.suptitle(title, fontsize=11, fontweight="bold", x=0.01, ha="left")
    places: NDArray[Any] = np.atleast_1d(figure.subplots(rows, columns, squeeze=False, **more)).ravel()
    return figure, places


_RADII_PT, _ANGLES = (9.0, 15.0, 23.0, 34.0, 48.0, 66.0), np.radians(np.arange(0.0, 360.0, 30.0))
_FLOATING = "floating"


def name_point(place: Axes, x: float, y: float, text: str, *, must: bool = True, **look: Any) -> None:
    """Name a point of a curve.

    `settle` later positions the name near the point, such that it covers no curve and no other text. Contours, which
    are drawn below the curves (`zorder` < 1), may be covered. A name without a free position is omitted, unless `must`
    is True.
    """
    halo = withStroke(linewidth=1.5, foreground="white")  # over contours
    style: dict[str, Any] = {"fontsize": 6.5, "color": BLACK, "path_effects": [halo]} | look
    line: Any = {"arrowstyle": "-", "linewidth": 0.4, "color": style["color"], "shrinkA": 0.0, "shrinkB": 1.5}
    place.annotate(
        text,
        (x, y),
        xytext=(0.0, _RADII_PT[0]),
        textcoords="offset points",
        ha="center",
        va="center",
        arrowprops=line,
        annotation_clip=True,
        gid=_FLOATING + "-must" * must,
        **style,
    )


def settle(figure: Figure) -> None:
    """Fold a title that is wider than the figure, compute the layout, and position the names of points."""
    _take_as_written(figure)
    title = figure._suptitle  # type: ignore[attr-defined]  # newer releases give access to its text only
    if title is not None and "\n" not in title.get_text():
        room = 0.98 * figure.bbox.width / title.get_window_extent(FigureCanvasAgg(figure).get_renderer()).width  # type: ignore[no-untyped-call]  # Matplotlib does not annotate it
        if room < 1.0:
            title.set_text(textwrap.fill(title.get_text(), max(int(0.92 * room * len(title.get_text())), 10)))
    layout = figure.get_layout_engine()
    if layout is not None:  # once for all formats: it takes as long as the drawing
        layout.execute(figure)
        layout.execute(figure)  # once more: the ticks of the smaller axes may differ
        figure.set_layout_engine("none")
    if any(str(text.get_gid()).startswith(_FLOATING) for place in figure.axes for text in place.texts):
        renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]  # Matplotlib does not annotate it
        for place in figure.axes:
            _place_names(place, renderer)


def _place_names(place: Axes, renderer: Any) -> None:
    names = [text for text in place.texts if str(text.get_gid()).startswith(_FLOATING)]
    if not names:
        return
    place.apply_aspect()
    frame, scale = place.get_window_extent(renderer), place.figure.dpi / 72.0
    others = [t for t in (*place.texts, place.title) if t not in names and t.get_text()]
    legend = place.get_legend()
    taken = [t.get_window_extent(renderer) for t in (*others, *([legend] if legend is not None else []))]
    curves = [line for line in place.lines if line.get_zorder() >= 1.0]
    lines = [dense(line.get_transform().transform(np.asarray(line.get_xydata()))) for line in curves]
    points = np.concatenate(lines) if lines else np.zeros((0, 2))
    points = points[frame.x0 <= points[:, 0]] if len(points) else points
    pieces = np.concatenate([np.stack([line[:-1], line[1:]], 1) for line in lines]) if lines else np.zeros((0, 2, 2))
    leaders = np.zeros((0, 2, 2))
    for name in sorted(names, key=lambda text: "must" not in str(text.get_gid())):
        assert isinstance(name, Annotation)
        at = place.transData.transform(name.xy)
        box = Text.get_window_extent(name, renderer)
        half = np.array([box.width, box.height]) / 2.0 + 1.0
        best, where, offset = np.inf, box, (0.0, 0.0)
        for radius in _RADII_PT:
            for angle in _ANGLES:
                way = np.array([np.cos(angle), np.sin(angle)])
                middle = at + radius * scale * way + half * way
                low, high = middle - half, middle + half
                spot = Bbox([low, high])
                cost = 1e4 * sum(spot.overlaps(other) for other in taken) + 0.4 * radius
                cost += 1e4 * (low[0] < frame.x0 or low[1] < frame.y0 or high[0] > frame.x1 or high[1] > frame.y1)
                cost += 6.0 * int(((points > low) & (points < high)).all(axis=1).sum())
                if _has_leader(middle - at, scale):
                    cost += 20.0 * _crossings(at + way * scale, middle, pieces)
                    cost += 1e3 * _crossings(at, middle, leaders)
                if cost < best:
                    best, where, offset = cost, spot, tuple((middle - at) / scale)
        if best >= 1e4 and "must" not in str(name.get_gid()):
            name.set_visible(False)
            continue
        name.set_position(offset)
        shown = _has_leader(np.array(offset), 1.0)
        if name.arrow_patch is not None:
            name.arrow_patch.set_visible(shown)
        if shown:
            leaders = np.concatenate([leaders, [[at, at + scale * np.array(offset)]]])
        taken.append(where)


def _has_leader(offset: NDArray[Any], scale: float) -> bool:
    """Return True if a name at this distance (pixels; `scale` pixels a point) from its point has a leader."""
    return float(np.hypot(*offset)) > 20.0 * scale


def _crossings(start: NDArray[Any], end: NDArray[Any], others: NDArray[Any]) -> int:
    """Return the number of segments `others` (n, 2, 2) that cross the segment from `start` to `end`."""

    def side(a: NDArray[Any], b: NDArray[Any], c: NDArray[Any]) -> NDArray[Any]:
        u, v = b - a, c - a
        return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    first, last = others[:, 0], others[:, 1]
    parted = side(start, end, first) * side(start, end, last) < 0.0
    return int((parted & (side(first, last, start) * side(first, last, end) < 0.0)).sum())


def dense(line: NDArray[Any]) -> NDArray[Any]:
    """Return the points of a line (n, 2), in pixels, with points added at spacings of about three pixels."""
    line = line[np.isfinite(line).all(axis=1)]
    if len(line) < 2:
        return line.reshape(-1, 2)
    steps = np.minimum(np.ceil(np.hypot(*np.diff(line, axis=0).T) / 3.0), 400).astype(int).clip(1)
    at = np.concatenate([k + np.arange(n) / n for k, n in enumerate(steps)])
    k = at.astype(int)
    return np.asarray(line[k] + (at - k)[:, None] * (line[k + 1] - line[k]))


def save(figure: Figure, stem: Path) -> list[Path]:
    """Write `stem`.svg and `stem`.png, or the formats of `drawing`. Return the paths.

    Each file is first written under a temporary name, so that it is complete or absent.
    """
    settle(figure)
    files = []
    for kind in _formats.get():
        path = stem.with_name(f"{stem.name}.{kind}")
        with whole_file(path) as part:
            figure.savefig(part, format=kind, metadata=_METADATA[kind])
        files.append(path)
    return files


def _take_as_written(figure: Figure) -> None:
    """Disable mathematics in texts that are not valid mathematics, since names of files may contain dollar signs."""
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        if text.get_text().count("$") > 1:
            try:
                _MATHEMATICS.parse(text.get_text())
            except ValueError:
                text.set_parse_math(False)


def png(figure: Figure, dpi: float | None = None) -> bytes:
    """Return the picture as a PNG file in memory, with `dpi` pixels per inch (None: those of the style)."""
    out = io.BytesIO()
    figure.set_dpi(dpi or figure.dpi)
    settle(figure)
    figure.savefig(out, format="png", metadata=_METADATA["png"])
    return out.getvalue()


def label(place: Axes, x: str = "", y: str = "", title: str = "") -> None:
    """Set axis labels and a title. An empty text leaves the label unchanged."""
    if x:
        place.set_xlabel(x)
    if y:
        place.set_ylabel(y)
    if title:
        place.set_title(title)


def plain_numbers(axis: Axis) -> None:
    """Label a logarithmic axis with 0.1, 1, 10, as is usual in engineering."""
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def curve(number: int) -> dict[str, Any]:
    """Return the colour and dashes of curve `number`."""
    return {"color": ON_LIGHT[number % len(ON_LIGHT)], "linestyle": DASHES[number % len(DASHES)]}
