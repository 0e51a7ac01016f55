"""The one style of all plots on paper: sizes for a page or a slide, fonts, colours for everyone's eyes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from maxq.tools.plots import style
from maxq.tools.plots.palette import ON_LIGHT

WIDTH_IN, ROW_IN = 8.0, 1.9  # of a sheet; of one plot in it
DPI = 160
STYLE: dict[str, Any] = {
    **style.STYLE,  # that of all pictures; below is what stacked plots over time need
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "hatch.linewidth": 0.5,
    "legend.columnspacing": 1.2,
    "legend.frameon": False,
    "legend.labelspacing": 0.25,
    "lines.linewidth": 1.1,
    "savefig.dpi": DPI,
    "savefig.facecolor": "white",
    "svg.fonttype": "none",  # text stays text: a review edits and searches it
    "svg.hashsalt": "maxq",
    "path.simplify": True,
    "path.simplify_threshold": 0.05,
}
DASHES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (4, 1.2, 1.2, 1.2)), (0, (7, 1.5, 1.2, 1.5)), "-")
"""Each colour has its own dashes too: curves are told apart in print without colour."""


def curve_look(number: int) -> dict[str, Any]:
    return {"color": ON_LIGHT[number % len(ON_LIGHT)], "linestyle": DASHES[number % len(DASHES)]}


@contextmanager
def in_style() -> Iterator[None]:
    """matplotlib without a display and in this style."""
    import matplotlib as mpl  # noqa: PLC0415  # lazy: a third of a second
    from cycler import cycler  # noqa: PLC0415  # lazy

    mpl.use("Agg", force=False)
    style: Any = {**STYLE, "axes.prop_cycle": cycler(color=ON_LIGHT)}
    with mpl.rc_context(style):
        yield
