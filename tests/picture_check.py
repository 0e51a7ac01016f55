"""Check the layout of a finished figure by Matplotlib's bounding boxes."""

from __future__ import annotations

from itertools import combinations

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text

from maxq.tools.plots.style import dense, settle


def faults(figure: Figure) -> list[str]:
    """Draw a figure and return its `settled_faults`."""
    settle(figure)
    return settled_faults(figure)


def settled_faults(figure: Figure) -> list[str]:
    """Return texts that leave the picture, pairs of overlapping texts, and legends that hide curves.

    Tick labels outside their axes are not drawn and do not count.
    """
    figure.draw_without_rendering()
    renderer = FigureCanvasAgg(figure).get_renderer()  # type: ignore[no-untyped-call]  # Matplotlib does not annotate it
    off = {
        label
        for place in figure.axes
        for axis in (place.xaxis, place.yaxis)
        for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks())
        for label in (tick.label1, tick.label2)
        if not (min(axis.get_view_interval()) - 1e-9 <= tick.get_loc() <= max(axis.get_view_interval()) + 1e-9)
    }
    texts = [
        t
        for t in figure.findobj(Text)
        if isinstance(t, Text)
        and t.get_visible()
        and t.get_text().strip()
        and t not in off
        and (t.axes is None or t.axes.axison)
    ]
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
    for place in figure.axes:
        legend = place.get_legend()
        if legend is None:
            continue
        low, high = np.reshape(legend.get_window_extent(renderer).extents, (2, 2))
        for line in place.lines:
            points = dense(line.get_transform().transform(np.asarray(line.get_xydata())))
            if (hidden := int(((points > low) & (points < high)).all(axis=1).sum())) > 5:
                found.append(
                    f"the legend {legend.get_texts()[0].get_text()!r}, ... hides {line.get_label()!r} ({hidden})"
                )
    return found
