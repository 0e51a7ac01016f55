"""The designs in scenarios/designs that the optimiser has made: `python -m maxq.tools.dev.studies.case_study.designs`.

Writes scenarios/designs/NAME.toml for each of DESIGNS, solved anew.
"""

from __future__ import annotations

from dataclasses import dataclass

from maxq.design.case.read import LoadedCase, read_case
from maxq.design.optimise.solution import Solution
from maxq.design.optimise.solve import nominal_plants, solve
from maxq.tools.design.case_report import comments
from maxq.tools.design.design_file import design_text, designs_folder, write_whole
from maxq.tools.design.outcome import Outcome, judge_solution

DESIGNS: dict[str, tuple[str, tuple[str, ...]]] = {
    "ksr3-two-phase": ("ksr3-identical", ("gains.schedule=two-phase",)),
    "ksr3-linear": ("ksr3-relaxed", ("gains.schedule=linear",)),
    "ksr3-free": ("ksr3-relaxed", ("gains.schedule=free",)),
    "ksr3-sampled": ("ksr3-identical", ("loop=sampled",)),
    "ksr3-robust": ("ksr3-robust", ()),
}
"""Name of the design: its case, and what is changed in it."""


@dataclass(frozen=True)
class Made:
    """A design, the problem it solves, and how it was judged."""

    loaded: LoadedCase
    solution: Solution
    outcome: Outcome


def make(name: str) -> Made:
    """Solve the case of a design in DESIGNS."""
    case, changes = DESIGNS[name]
    loaded = read_case(case, [f"name={name}", *changes])
    plants = nominal_plants(loaded)
    solution = solve(loaded, plants)
    return Made(loaded, solution, judge_solution(loaded, solution, [plant.node for plant in plants.each]))


def main() -> None:
    for name, (case, changes) in DESIGNS.items():
        made = make(name)
        order = " ".join(["simdesign", case, *(f"--set {change}" for change in changes)])
        lines = [*comments(made.outcome, made.solution), f"Again: {order}"]
        path = write_whole(designs_folder() / f"{name}.toml", design_text(made.outcome.design, lines))
        print(f"{path.name}: {made.solution.status}, {made.solution.objective_db:.3f} dB, "
              f"{made.solution.certificate.seconds:.1f} s")  # fmt: skip


if __name__ == "__main__":
    main()
