"""The difference between the paper's continuous loop and the sampled loop of the flight computer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from maxq.control.kernel.records import Array
from maxq.design.laws.law import Controller
from maxq.design.loop.fixed_path import ExactFixedPath, PadeFixedPath, SampledFixedPath
from maxq.design.loop.loop import Loop
from maxq.design.loop.resonance import Resonance
from maxq.design.model.node import Node
from maxq.design.model.state_space import ComplexArray

DeparturePart = Literal["total", "pade", "aliasing", "integrator", "filter"]
PARTS: tuple[DeparturePart, ...] = ("total", "pade", "aliasing", "integrator", "filter")


@dataclass(frozen=True)
class Departure:
    """The ratio of the Padé loop to the sampled loop at one operating point, in dB and deg at each frequency.

    `total` is the sum of four parts, each a ratio:

    - `pade`: eqs 30 to 32 over their exact factors
    - `aliasing`: the exact factors without images over the sampled path; infinite in dB where the images cancel it
    - `integrator`: k_p / s + k_d over k_p T z / (z - 1) + k_d
    - `filter`: the continuous filter over the discrete filter.
    """

    node: Node
    frequency_hz: Array
    db: dict[DeparturePart, Array]
    deg: dict[DeparturePart, Array]
    sampled_db: Array  # |L| of the sampled loop
    resonances: tuple[Resonance, ...]  # resonances of the sampled loop

    def at(self, frequency_hz: float) -> dict[DeparturePart, tuple[float, float]]:
        """Return (dB, deg) of each part at the tabulated frequency nearest to `frequency_hz`."""
        k = int(np.argmin(np.abs(self.frequency_hz - frequency_hz)))
        return {part: (float(self.db[part][k]), float(self.deg[part][k])) for part in PARTS}


def departure(
    node: Node, continuous: Controller, discrete: Controller, frequencies_hz: ArrayLike | None = None
) -> Departure:
    """Compare the loops of a design at an operating point.

    `continuous` and `discrete` are its law in both forms. By default, the frequencies are 400 values up to the Nyquist
    frequency and every resonance.
    """
    paths = PadeFixedPath(node), ExactFixedPath(node), SampledFixedPath(node)
    found = tuple(paths[2].resonances())
    if frequencies_hz is None:
        f = np.geomspace(0.02, 0.999 * paths[2].highest_hz, 400)
        f = np.union1d(f, [r.frequency_hz for r in found])
    else:
        f = np.atleast_1d(np.asarray(frequencies_hz, float))
    sampled = Loop(paths[2], discrete)
    pade, exact, images = (path.response(f) for path in paths)
    filters = continuous.filter_response(f), discrete.filter_response(f)
    law = Loop(paths[0], continuous).controller(f) / filters[0], sampled.controller(f) / filters[1]
    ratios: dict[DeparturePart, ComplexArray] = {
        "pade": pade / exact,
        "aliasing": exact / images,
        "integrator": law[0] / law[1],
        "filter": filters[0] / filters[1],
    }
    db = {part: 20.0 * np.log10(np.abs(ratio)) for part, ratio in ratios.items()}
    deg = {part: np.degrees(np.angle(ratio)) for part, ratio in ratios.items()}
    return Departure(
        node=node,
        frequency_hz=f,
        db={"total": np.asarray(sum(db.values())), **db},
        deg={"total": np.asarray(sum(deg.values())), **deg},
        sampled_db=20.0 * np.log10(np.abs(sampled.response(f))),
        resonances=found,
    )
