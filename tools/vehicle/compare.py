"""A vehicle worked out from a layout beside one that is given: what the linear model reads of both, over the burns."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from maxq.control.kernel.records import Array
from maxq.design.paper.vehicle_at import vehicle_at
from maxq.sim.flight.metric_table import figures
from maxq.sim.packing.flight import pack_flight
from maxq.sim.scenario.files import scenarios_folder
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.tools.cli.terminal import aligned
from maxq.tools.vehicle.build import Built, burning, spread

ALIKE = 1e-2
TIMES = 11  # of each burn, at full thrust
_UNITS = {
    "kg": "kg", "kgps": "kg/s", "kgpm": "kg/m", "kgm2": "kg m2", "kgm2ps": "kg m2/s", "m": "m", "m2": "m2",
    "mps": "m/s", "pm": "1/m", "pr": "1/rad", "mpr": "m/rad", "radps": "rad/s", "rad": "rad", "N": "N", "Nms": "N m s",
}  # fmt: skip  # a table
_ONE = {"pendulums": "pendulum", "modes": "mode", "aerodynamics": "surface"}
_SAID = {"phi_": "shape_at_", "slope_g": "slope_at_g", "slope_s": "slope_at_s", "_": " ", "cg": "CG"}
_NOT_COMPARED = ("follower", "gimbal", "rest", "slope", "flow_share", "gain", "spatial", "local_incidence")


@dataclasses.dataclass(frozen=True)
class Difference:
    """A quantity at the times of all burns: of the layout and of the given vehicle."""

    name: str
    here: Array
    there: Array

    @property
    def largest(self) -> float:
        """Relative to the largest value of the given vehicle."""
        scale = float(np.abs(self.there).max())
        return float(np.abs(self.here - self.there).max()) / (scale or 1.0)


def compared(built: Built, folder: Path, vehicle: str) -> list[Difference]:
    """Of the files in `folder`, written from `built`, and the vehicle in a folder or of that built-in name.

    Raises ScenarioError for a vehicle that cannot be read, ValueError for one of other stages, tanks or modes.
    """
    path = Path(vehicle) if Path(vehicle).exists() else scenarios_folder() / vehicle
    ours = load_scenario(folder / "scenario.toml")
    theirs = load_scenario(folder / "scenario.toml", [f'vehicle="{path.resolve().as_posix()}"'])
    if len(ours.vehicle.stage) != len(theirs.vehicle.stage):
        count = len(ours.vehicle.stage)
        raise ValueError(f"{vehicle} has {len(theirs.vehicle.stage)} stages, the layout makes {count}")
    columns = [_quantities(built, loaded) for loaded in (ours, theirs)]
    if other := sorted(set(columns[0]) ^ set(columns[1])):
        raise ValueError(f"{vehicle} has other tanks, modes or surfaces: {other[0]}")
    return [Difference(name, columns[0][name], columns[1][name]) for name in columns[0] if columns[1][name].any()]


def _quantities(built: Built, loaded: LoadedScenario) -> dict[str, Array]:
    packed, found = pack_flight(loaded.scenario), dict[str, list[float]]()
    for n in range(len(built.stacks)):
        for p in spread(burning(built, n), TIMES):
            at = vehicle_at(packed, p.clock_s, p.mach, stage=n)
            for part in ("body", "pendulums", "modes", "engine", "aerodynamics"):
                for name, value in _numbers(getattr(at, part), part):
                    found.setdefault(name, []).append(value)
            found.setdefault("vehicle: CG station, m", []).append(at.total_cg_station_m)
            found.setdefault("vehicle: transverse inertia, kg m2", []).append(at.total_inertia_kgm2)
    return {name: np.array(values) for name, values in found.items()}


def _numbers(part: Any, name: str) -> Iterator[tuple[str, float]]:
    for field in dataclasses.fields(part):
        value = getattr(part, field.name)
        if field.name not in _NOT_COMPARED and isinstance(value, float | np.ndarray):
            for place, number in np.ndenumerate(value):
                yield _titled(name, field.name, [k + 1 for k in place]), float(np.nan_to_num(number))


def _titled(part: str, field: str, place: list[int]) -> str:
    """ "pendulum 2: mass rate, kg/s", "modes: shape at hinge 1, 3"."""
    words, _, unit = field.rpartition("_")
    if unit not in _UNITS:
        words, unit = field, ""
    for name, said in _SAID.items():
        words = words.replace(name, said)
    if len(place) == 1:
        part, place = f"{_ONE.get(part, part)} {place[0]}", []
    return f"{part}: {' '.join([words, ', '.join(map(str, place))]).rstrip()}" + (f", {_UNITS[unit]}" if unit else "")


def comparison(found: list[Difference], vehicle: str) -> str:
    """The differences as a table, largest first."""
    rows = [("quantity", "here", "there", "off, %")]
    alike = [d for d in found if d.largest < ALIKE]
    for d in sorted((d for d in found if d.largest >= ALIKE), key=lambda d: -d.largest):
        k = int(np.argmax(np.abs(d.here - d.there)))
        rows.append((d.name, figures(d.here[k]), figures(d.there[k]), f"{100.0 * d.largest:.3g}"))
    head = f"compared with {vehicle}, {TIMES} times of each burn: values where they differ most, % of the largest there"
    rest = f"  {len(alike)} more differ by less than {100.0 * ALIKE:g} %"
    return "\n".join([head, *aligned(rows, "  ", right=range(1, 4)), rest])
