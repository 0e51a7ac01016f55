"""Looks at a finished figure by Matplotlib's own bounding boxes."""

from __future__ import annotations

from itertools import combinations
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from maxq.tools.plots.style import settle


def faults(figure: Figure) -> list[str]:
    """Texts that leave the picture, and pairs of texts that lie over each other. Tick labels off their axes are not
    drawn and do not count.
    """
    settle(figure)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    off = {
        label
        for place in figure.axes
        for axis in (place.xaxis, place.yaxis)
        for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks())
        for label in (tick.label1, tick.label2)
        if not (min(axis.get_view_interval()) - 1e-9 <= tick.get_loc() <= max(axis.get_view_interval()) + 1e-9)
    }
    texts = [
        t for t in figure.findobj(Text)
        if isinstance(t, Text) and t.get_visible() and t.get_text().strip() and t not in off
        and (t.axes is None or t.axes.axison)
    ]  # fmt: skip  # three more lines otherwise
    boxes = [(t.get_text(), Text.get_window_extent(t, renderer)) for t in texts]
    whole, found = figure.bbox, []
    for text, box in boxes:
        if box.x0 < whole.x0 - 1 or box.y0 < whole.y0 - 1 or box.x1 > whole.x1 + 1 or box.y1 > whole.y1 + 1:
            found.append(f"{text!r} is clipped")
    for (one, a), (other, b) in combinations(boxes, 2):
        across = min(a.x1, b.x1) - max(a.x0, b.x0)
        along = min(a.y1, b.y1) - max(a.y0, b.y0)
        if across > 1.0 and along > 1.0:
            found.append(f"{one!r} lies over {other!r}")
    return found
