"""The figures of a comparison with measured series: a channel next to its residual."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from maxq.sim.run.comparison import Residuals
from maxq.sim.run.quantities import engineering_unit, unit_text
from maxq.tools.plots.figures import Panel, Plot, limit, line, points, thinned

_MOST_POINTS = 600


def residual_plots(after: Sequence[Residuals], before: Sequence[Residuals] = ()) -> list[Plot]:
    """Return a figure for each channel: measured and modelled values, and residuals, after and before a calibration."""
    earlier = {each.name: each for each in before}
    return [_plot(each, earlier.get(each.name)) for each in after]


def _plot(each: Residuals, before: Residuals | None) -> Plot:
    measured = each.measured
    shown, factor = engineering_unit(measured.unit, float(np.abs(each.values).max()))
    small, fine = engineering_unit(measured.unit, abs((each if before is None else before).largest))
    k = slice(None, None, len(each.time_s) // _MOST_POINTS + 1)
    values = [
        points(each.time_s[k], factor * each.values[k], "measured", colour="orange"),
        line(*thinned(each.time_s, factor * each.modelled), "flight"),
    ]
    residuals = [line(*thinned(each.time_s, fine * each.residual), "residual" if before is None else "after")]
    if before is not None:
        values.append(line(*thinned(before.time_s, factor * before.modelled), "before", colour="grey", dash="6 3"))
        old = line(*thinned(before.time_s, fine * before.residual), "before", colour="grey", dash="6 3")
        residuals.insert(0, old)
    if np.isfinite(measured.sigma):
        residuals += [
            limit(sign * fine * measured.sigma, "1 sigma of the noise", colour="pale") for sign in (1.0, -1.0)
        ]
    label = "time, s", f"{measured.name}, {unit_text(shown)}".rstrip(", ")
    panels = [
        Panel("measured and flown", values, *label),
        Panel("measured minus flown", residuals, "time, s", f"residual, {unit_text(small)}".rstrip(", ")),
    ]
    name = "residual-" + measured.name.lower().replace("_", "-")
    return Plot(name, measured.name, panels, f"Heading in the file: {measured.heading}.", columns=2)
