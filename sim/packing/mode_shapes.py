"""Mode shapes between the stations of their table."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from maxq.control.kernel.tables import hermite
from maxq.sim.scenario.modes import ModeTable


class ModeShapes:
    """Shapes of the T times and M modes of a table: cubics with its `phi` and `slope_pm` at the stations.

    Beyond the first and last station the cubics there go on.
    """

    def __init__(self, table: ModeTable) -> None:
        self._of = table.phi.shape[:2]
        stations = len(table.station_m)
        columns = (values.reshape(-1, stations).T for values in (table.phi, table.slope_pm))
        self._cubics = hermite(table.station_m, *columns)

    def value(self, station_m: ArrayLike) -> NDArray[np.float64]:
        """phi (P, T, M) at stations (P,)."""
        s, (c0, c1, c2, c3) = self._at(station_m)
        return np.reshape(c0 + c1 * s + c2 * (s * s) + c3 * (s * s * s), (-1, *self._of))

    def slope(self, station_m: ArrayLike) -> NDArray[np.float64]:
        """d(phi)/d(station) (P, T, M) at stations (P,), 1/m."""
        s, (_, c1, c2, c3) = self._at(station_m)
        return np.reshape(c1 + c2 * s * 2.0 + c3 * (s * s) * 3.0, (-1, *self._of))

    def _at(self, station_m: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Distance (P, 1) into the interval of each station, and its coefficients (4, P, T M)."""
        x, breaks = np.atleast_1d(np.asarray(station_m, float)), self._cubics.breaks
        k = np.clip(np.searchsorted(breaks, x, side="right") - 1, 0, len(breaks) - 2)
        return (x - breaks[k])[:, None], self._cubics.coefficients[k].transpose(1, 0, 2)
