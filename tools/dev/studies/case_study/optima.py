"""The paper's table of optima: F2 to F6, three kinds of gain schedule, two sets of limits, two plants.

python -m maxq.tools.dev.studies.case_study.optima [FILE.json]
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from maxq.design.case.read import LoadedCase, read_case
from maxq.design.optimise.solution import Solution
from maxq.design.optimise.solve import nominal_plants, solve

STRUCTURES = ("F2", "F3", "F4", "F5", "F6")
SCHEDULES = ("two-phase", "linear", "free")
LIMITS = {"identical": "ksr3-identical", "relaxed": "ksr3-relaxed"}
PLANTS = ("flown", "table2")
DEFAULT_FILE = Path(__file__).resolve().parents[4] / "docs" / "case-study.json"


@dataclass(frozen=True)
class Optimum:
    """One entry of a table."""

    plant: str
    limits: str
    schedule: str
    structure: str
    status: str
    objective_db: float
    violation_db: float
    starts: int
    near_best: int
    leaps: int
    leaps_back: int
    kkt_residual: float
    evaluations: int
    seconds: float
    time_s: list[float]
    k_p: list[float]
    k_d_s: list[float]
    quadratic: list[list[float]]
    first_order: list[list[float]]
    explanation: str

    @property
    def key(self) -> tuple[str, str, str, str]:
        return self.plant, self.limits, self.schedule, self.structure


def table(plant: str, limits: str) -> list[Optimum]:
    """Fifteen optima; each starts from those that it contains, too, so that more freedom never ends worse."""
    out: list[Optimum] = []
    found: dict[tuple[str, str], Solution] = {}
    plants = None
    for structure in STRUCTURES:
        for schedule in SCHEDULES:
            loaded = the_case(plant, limits, structure, schedule)
            plants = nominal_plants(loaded) if plants is None else plants
            begun = time.perf_counter()
            solution = solve(loaded, plants, list(_contained(found, structure, schedule)))
            found[structure, schedule] = solution
            out.append(_optimum(plant, limits, schedule, structure, solution, time.perf_counter() - begun))
    return out


def the_case(plant: str, limits: str, structure: str, schedule: str) -> LoadedCase:
    """The case of an entry."""
    changes = [f"plant={plant}", f"filter.structure={structure}", f"gains.schedule={schedule}"]
    return read_case(LIMITS[limits], changes)


def _contained(found: dict[tuple[str, str], Solution], structure: str, schedule: str) -> Iterator[Solution]:
    k, s = STRUCTURES.index(structure), SCHEDULES.index(schedule)
    if k > 0:
        yield found[STRUCTURES[k - 1], schedule]
    if s > 0:
        yield found[structure, SCHEDULES[s - 1]]


def _optimum(plant: str, limits: str, schedule: str, structure: str, solution: Solution, seconds: float) -> Optimum:
    c, flt = solution.certificate, solution.filter
    return Optimum(
        plant, limits, schedule, structure, solution.status, solution.objective_db, solution.violation_db, c.starts,
        c.near_best, c.leaps, c.leaps_back, c.kkt_residual, c.evaluations, seconds, solution.nodes_s.tolist(),
        solution.k_p.tolist(), solution.k_d_s.tolist(),
        [[q.zero_hz, q.zero_zeta, q.pole_hz, q.pole_zeta] for q in flt.quadratic],
        [[f.zero_hz, f.pole_hz] for f in flt.first_order], solution.explanation(),
    )  # fmt: skip


def all_tables(workers: int = 2) -> list[Optimum]:
    """Sixty optima."""
    pairs = [(plant, limits) for plant in PLANTS for limits in LIMITS]
    if workers < 2:
        return [optimum for pair in pairs for optimum in table(*pair)]
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # two processes, two cores
    with ProcessPoolExecutor(workers) as pool:
        return [o for result in pool.map(table, *zip(*pairs, strict=True)) for o in result]


def write(optima: Iterable[Optimum], file: Path) -> None:
    """Digits enough to set the designs up again."""
    rows: list[dict[str, Any]] = [asdict(o) for o in optima]
    file.write_text(json.dumps({"optima": [_short(row) for row in rows]}, indent=1) + "\n", encoding="utf-8")


def read(file: Path = DEFAULT_FILE) -> list[Optimum]:
    """What `write` has left."""
    return [Optimum(**row) for row in json.loads(file.read_text(encoding="utf-8"))["optima"]]


def _short(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _short(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_short(item) for item in value]
    return float(f"{value:.7g}") if isinstance(value, float) else value


def main() -> None:
    file = Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT_FILE
    begun = time.perf_counter()
    found = all_tables()
    write(found, file)
    for o in found:
        print(
            *o.key,
            o.status,
            f"{o.objective_db:.3f} dB, {o.near_best} of {o.starts}, {o.leaps_back} of {o.leaps}, {o.seconds:.1f} s",
        )
    print(f"{time.perf_counter() - begun:.0f} s")


if __name__ == "__main__":
    main()
