"""Plots of channels over time, as `maxq.plot` draws them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from maxq.sim.log.tabular import Tabular
from maxq.tools.plots.palette import GREY
from maxq.tools.plots.style import curve, drawing, label, sheet

_KEY = ("altitude_m", "speed_mps", "dynamic_pressure_Pa", "alpha_total_deg", "gimbal_pitch_angle_deg")
_MOST_POINTS = 4000


def channel_plot(of: Tabular, names: Sequence[str] = ()) -> Figure:
    """Draw channels over a common time axis, with a panel for each unit and the events of the flight as dotted lines.

    `names` are channels or topics; by default, they are the key channels of a flight. Raises KeyError for an unknown
    name.
    """
    names = of.channels_in(names) or [name for name in _KEY if name in of.table]
    units: dict[str, list[str]] = {}
    for name in names:
        units.setdefault(of.table.channel(name).unit, []).append(name)
    with drawing():
        figure, places = sheet(len(units), 1, height_in=max(1.5, 2.6 - 0.2 * len(units)), sharex=True)
        for place, (unit, each) in zip(places, units.items(), strict=True):
            for n, name in enumerate(each):
                time_s, values = of.time_s(name), of[name]
                every = max(len(time_s) // _MOST_POINTS, 1)
                text = of.table.channel(name).description if len(each) == 1 else name
                place.plot(time_s[::every], values[::every], **curve(n), label=name)
                if len(each) == 1:
                    place.set_title(text)
            label(place, y=unit if unit != "1" else "")
            place.margins(x=0.0)
            if len(each) > 1:
                place.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
        for event in getattr(of, "events", ()):
            if isinstance(getattr(event, "time_s", None), float) and np.isfinite(event.time_s):
                for place in places:
                    place.axvline(event.time_s, color=GREY, linewidth=0.7, linestyle=":")
        label(places[-1], "time, s (dotted: events)")
    return figure
