"""`simverify DESIGN...`: judge designs by a suite, write verdicts and review packs, rank them."""

from __future__ import annotations

import re
import shlex
import time
from dataclasses import dataclass
from pathlib import Path

from maxq.design.case.design_file import DESIGN_NAME, design_path
from maxq.design.verify import memory
from maxq.design.verify.suite import ACCEPTED, REJECTED, UNDECIDED, Judgement, overall, read_suite
from maxq.design.verify.verify import Verification, verify
from maxq.sim.files import check_writable
from maxq.sim.scenario.errors import ScenarioError
from maxq.tools.cli.frame import Exit, Interruption
from maxq.tools.cli.terminal import Progress
from maxq.tools.verify import report

_EXIT: dict[Judgement, Exit] = {ACCEPTED: Exit.OK, REJECTED: Exit.FAILED, UNDECIDED: Exit.UNDECIDED}


@dataclass(frozen=True)
class Order:
    """What the command line asks for."""

    designs: tuple[str, ...]
    suite: str = "standard"
    overrides: tuple[str, ...] = ()
    vehicle: str | None = None
    out: str | None = None
    pack: bool = True
    memory: bool = True


def execute(order: Order) -> int:
    """Do it; returns the exit code."""
    loaded = read_suite(order.suite, order.overrides)
    paths, folders = [design_path(name) for name in order.designs], [folder_of(order, name) for name in order.designs]
    for folder in folders:
        check_writable(folder)
    found: list[Verification] = []
    with Interruption() as interruption, Progress() as progress:
        for name, path, folder in zip(order.designs, paths, folders, strict=True):
            begun = time.perf_counter()
            try:
                one = verify(
                    path, loaded, vehicle=order.vehicle, memory=memory.default_folder() if order.memory else None,
                    watch=progress.show, stop=lambda: interruption.requested,
                )  # fmt: skip
            except ValueError as error:
                if not str(error).startswith("node at"):
                    raise
                raise ScenarioError(loaded.label, str(error)) from None  # the suite's times are wrong
            found.append(one)
            progress.show(f"writing {name}", 0, 1)
            files = report.write_pack(one, folder, command_of(order, name), order.pack)
            print("\n".join([*report.report(one, f"{name} by the suite {one.suite.name}"), *report.reasons(one)]))
            print(f"\n{len(files)} files in {folder}/; {time.perf_counter() - begun:.1f} s, "
                  f"{one.recalled} results reused from earlier runs\n{report.headline(one)}\n")  # fmt: skip
    if len(found) > 1:
        print("\n".join(report.ranking(found)))
    return _EXIT[overall(report.ranked(found)[0].requirements)]


def command_of(order: Order, design: str) -> str:
    """The command that repeats the verification of one design."""
    words = ["simverify", design]
    if order.suite != "standard":
        words += ["--suite", order.suite]
    if order.vehicle is not None:
        words += ["--vehicle", order.vehicle]
    return shlex.join([*words, *(word for change in order.overrides for word in ("--set", change))])


def folder_of(order: Order, design: str) -> Path:
    """Where a design's pack goes; several designs get a folder each inside --out."""
    path = Path(design)
    name = path.parent.name if path.name == DESIGN_NAME else path.name.removesuffix(".toml")
    plain = re.sub(r"[^\w.-]+", "-", name).strip(".-") or "design"
    if order.out is None:
        return Path("runs") / f"verify-{plain}"
    return Path(order.out) if len(order.designs) == 1 else Path(order.out) / plain
