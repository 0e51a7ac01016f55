"""The NESC check cases: their flights as scenarios, and the comparison with the published time histories.

Reference data and tolerances are in tests/data/nesc (with their notice), scenarios in scenarios/checkcases.
"""

from __future__ import annotations

import csv
import gzip
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from maxq.control.kernel.records import Array
from maxq.sim.run.flight import Flight
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario
from maxq.tools.dev.verification.nesc_units import in_nesc_units

DATA = Path(__file__).resolve().parents[3] / "tests" / "data" / "nesc"
ATMOSPHERIC = ("01", "02", "04", "05", "06", "07", "09")

# exo 6A, by simulation of the reference: the scenario, and the largest permitted distance, m
ORBITS_WITH_DRAG = {"B": ("exo-06a", 0.1), "C": ("exo-06a", 0.01), "D": ("exo-06a-no-drag", 0.01)}
JEOD = {"8A": "exo-08a", "9B": "exo-09b", "10D": "exo-10d"}
JEOD_TOLERANCES = {"pos": 1e-3, "vel": 1e-6, "w": 1e-10, "T": 1e-7}  # m, m/s, rad/s, direction cosines
AS_RECORDED = 1e-9  # s


@dataclass(frozen=True)
class LargestDifference:
    """The largest difference of a variable from a reference simulation, and its time."""

    case: str
    variable: str
    reference: str
    largest: float
    tolerance: float
    at_s: float

    @property
    def ratio(self) -> float:
        """Return the difference divided by the tolerance. It is at most 1 if the tolerance is met."""
        return self.largest / self.tolerance


def fly_case(scenario: str) -> Flight:
    """Return the flight of a scenario in scenarios/checkcases, flown with its own settings."""
    return fly(load_scenario(f"checkcases/{scenario}"))


def read_columns(path: Path) -> dict[str, list[str]]:
    """Return the columns of a CSV file, which may be compressed by gzip, as text."""
    content = path.read_bytes()
    text = (gzip.decompress(content) if path.suffix == ".gz" else content).decode()
    header, *rows = csv.reader(text.splitlines())
    return dict(zip(header, map(list, zip(*rows, strict=True)), strict=True))


def read_tolerances() -> list[dict[str, str]]:
    with (DATA / "tolerances.csv").open() as file:
        return list(csv.DictReader(file))


@dataclass(frozen=True)
class ErrorOverTime:
    """The differences of a variable from a reference, (n,) at `time_s`."""

    variable: str
    reference: str
    time_s: Array
    error: Array
    tolerance: float

    def largest(self, case: str) -> LargestDifference:
        k = int(np.argmax(self.error))
        return LargestDifference(case, self.variable, self.reference, self.error[k], self.tolerance, self.time_s[k])


def atmospheric_errors(case: str, flight: Flight) -> list[ErrorOverTime]:
    """Return the differences at t = 0, 0.1 .. 30 s and the strict tolerance of each variable in the table of
    tolerances.
    """
    columns = read_columns(DATA / f"nesc-{case}.csv.gz")
    time = np.array(columns["time"], float)
    chosen = _rows_at(flight, time)
    out = []
    for row in read_tolerances():
        if row["case"] != case:
            continue
        ours = in_nesc_units(flight, row["variable"])[chosen]
        error = np.abs(ours - np.array(columns[row["variable"]], float))
        if row["variable"].startswith("eulerAngle"):
            error = np.minimum(error, np.abs(360.0 - error))
        error[: int(row["skip_t0"])] = 0.0
        reference = f"SIM {row['ref_sim'].lstrip('0')}"
        out.append(ErrorOverTime(row["variable"], reference, time, error, float(row["strict"])))
    return out


def compare_atmospheric(case: str, flight: Flight) -> list[LargestDifference]:
    """Return the largest of `atmospheric_errors` for each variable."""
    return [e.largest(case) for e in atmospheric_errors(case, flight)]


def orbit_errors(simulation: str, flight: Flight) -> ErrorOverTime:
    """Return the distance from the position in exo 6A, m, every 60 s for eight hours."""
    columns = read_columns(DATA / "exo-06a.csv.gz")
    time = np.array(columns["time"], float)
    chosen = _rows_at(flight, time)
    theirs = np.stack([np.array(columns[f"{simulation}_eiPosition_m_{a}"], float) for a in "XYZ"])
    error = np.linalg.norm(_vector(flight, "r_I_{}_m")[:, chosen] - theirs, axis=0)
    return ErrorOverTime("position_m", f"SIM {simulation}", time, error, ORBITS_WITH_DRAG[simulation][1])


def compare_orbit_with_drag(simulation: str, flight: Flight) -> list[LargestDifference]:
    """Return the largest of `orbit_errors`."""
    return [orbit_errors(simulation, flight).largest("exo 6A")]


def compare_jeod(run: str, flight: Flight) -> list[LargestDifference]:
    """Return the largest differences of position, velocity, body rate and attitude at the instants of NASA's JEOD."""
    columns = read_columns(DATA / "exo-jeod.csv")
    mine = [i for i, name in enumerate(columns["run"]) if name == run]
    time = np.array(columns["time_s"], float)[mine]
    chosen = _rows_at(flight, time)
    q = np.stack([flight[f"q_BI_{c}"][chosen] for c in "wxyz"])
    ours = {
        "pos": _vector(flight, "r_I_{}_m")[:, chosen],
        "vel": _vector(flight, "v_I_{}_mps")[:, chosen],
        "w": _vector(flight, "w_BI_B_{}_radps")[:, chosen],
        "T": _inertial_to_body(q),
    }
    names = {
        "pos": [f"pos_{a}_m" for a in "xyz"],
        "vel": [f"vel_{a}_m_s" for a in "xyz"],
        "w": [f"w_{a}_rad_s" for a in "xyz"],
        "T": [f"T{i}{j}" for i in range(3) for j in range(3)],
    }
    out = []
    for kind, tolerance in JEOD_TOLERANCES.items():
        theirs = np.array([np.array(columns[name], float)[mine] for name in names[kind]])
        error = np.abs(ours[kind] - theirs).max(axis=0)
        k = int(np.argmax(error))
        out.append(LargestDifference(f"exo {run}", kind, "JEOD", error[k], tolerance, time[k]))
    return out


ALL_CASES: dict[str, tuple[str, Callable[[Flight], list[LargestDifference]]]] = {
    **{case: (f"nesc-{case}", partial(compare_atmospheric, case)) for case in ATMOSPHERIC},
    **{
        f"exo 6A {simulation}": (scenario, partial(compare_orbit_with_drag, simulation))
        for simulation, (scenario, _) in ORBITS_WITH_DRAG.items()
    },
    **{f"exo {run}": (scenario, partial(compare_jeod, run)) for run, scenario in JEOD.items()},
}
"""The scenario of each case, and the function that compares its flight with the reference."""


def _rows_at(flight: Flight, time_s: Array) -> Array:
    """Return the indices of the logged rows of a flight at these times. Raises ValueError if a row is missing."""
    logged = flight.time_s("r_I_x_m")
    rows = np.clip(np.searchsorted(logged, time_s - AS_RECORDED), 0, len(logged) - 1)
    if np.abs(logged[rows] - time_s).max() > AS_RECORDED:
        raise ValueError("the flight has not logged every instant of the reference")
    return np.asarray(rows)


def _vector(flight: Flight, name: str) -> Array:
    return np.stack([flight[name.format(axis)] for axis in "xyz"])


def _inertial_to_body(q: Array) -> Array:
    """Return the direction cosines (9, n), row by row, from I to B, for quaternions from B to I (4, n)."""
    w, x, y, z = q
    return np.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y + w * z),
            2 * (x * z - w * y),
            2 * (x * y - w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z + w * x),
            2 * (x * z + w * y),
            2 * (y * z - w * x),
            1 - 2 * (x * x + y * y),
        ]
    )
