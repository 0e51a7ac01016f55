"""`simverify DESIGN...`: judge designs by a suite, write verdicts and review packs, rank them."""

from __future__ import annotations

import re
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from maxq.sim.files import FileError, check_writable
from maxq.sim.scenario.errors import ScenarioError
from maxq.tools.cli.interruption import Interruption
from maxq.tools.cli.terminal import Progress, printable

if TYPE_CHECKING:
    from maxq.design.verify.suite import LoadedSuite
    from maxq.design.verify.verify import Verification

ACCEPTED, REJECTED, BAD_INPUT, UNDECIDED, INTERRUPTED = 0, 1, 2, 3, 130


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
    """Do it; returns the exit code. Whatever is wrong with the input is one line on stderr."""
    from maxq.sim.campaign.error import CampaignError  # noqa: PLC0415  # lazy: --help is quick

    try:
        return _execute(order)
    except (ScenarioError, CampaignError, FileError) as error:
        print(f"simverify: {printable(str(error))}", file=sys.stderr)
        return BAD_INPUT


def _execute(order: Order) -> int:
    from maxq.design.case.design_file import design_path  # noqa: PLC0415
    from maxq.design.verify.suite import overall, read_suite  # noqa: PLC0415
    from maxq.tools.verify import text  # noqa: PLC0415

    loaded = read_suite(order.suite, order.overrides)
    paths = [design_path(name) for name in order.designs]
    folders = [folder_of(order, name) for name in order.designs]
    for folder in folders:
        check_writable(folder)
    found: list[Verification] = []
    with Interruption() as interruption, Progress() as progress:
        for name, path, folder in zip(order.designs, paths, folders, strict=True):
            begun = time.perf_counter()
            one = _verified(order, loaded, path, progress, lambda: interruption.requested)
            found.append(one)
            progress.show(f"writing {name}", 0, 1)
            files = write_pack(one, folder, command_of(order, (name,)), order.pack)
            print("\n".join(text.report(one, f"{name} by the suite {one.suite.name}")))
            print("\n".join(text.reasons(one)))
            print(f"\n{len(files)} files in {folder}/; {time.perf_counter() - begun:.1f} s, "
                  f"{one.recalled} parts known from before\n{text.headline(one)}\n")  # fmt: skip
    if len(found) > 1:
        print("\n".join(text.ranking(found)))
    best = text.ranked(found)[0]
    code = {"accepted": ACCEPTED, "rejected": REJECTED, "undecided": UNDECIDED}
    return code[overall(best.requirements)]


def _verified(
    order: Order, loaded: LoadedSuite, path: str, progress: Progress, stop: Callable[[], bool]
) -> Verification:  # fmt: skip
    from maxq.design.verify.memory import default_folder  # noqa: PLC0415  # lazy
    from maxq.design.verify.verify import verify  # noqa: PLC0415

    memory = default_folder() if order.memory else None
    try:
        return verify(path, loaded, vehicle=order.vehicle, memory=memory, watch=progress.show, stop=stop)
    except ValueError as error:
        if not str(error).startswith("node at"):  # a time at which the scenario has no node is the suite's mistake
            raise
        raise ScenarioError(loaded.label, str(error)) from None


def command_of(order: Order, designs: Sequence[str]) -> str:
    """The command that does the same again."""
    words = ["simverify", *designs]
    if order.suite != "standard":
        words += ["--suite", order.suite]
    if order.vehicle is not None:
        words += ["--vehicle", order.vehicle]
    for change in order.overrides:
        words += ["--set", change]
    return shlex.join(words)


def folder_of(order: Order, design: str) -> Path:
    """Where a design's pack goes; several designs get a folder each inside --out."""
    path = Path(design)
    name = path.parent.name if path.name == "design.toml" else path.name.removesuffix(".toml")
    plain = re.sub(r"[^\w.-]+", "-", name).strip(".-") or "design"
    if order.out is None:
        return Path("runs") / f"verify-{plain}"
    return Path(order.out) if len(order.designs) == 1 else Path(order.out) / plain


def write_pack(found: Verification, folder: Path, command: str, pack: bool) -> list[Path]:
    """verdict.json, and the review pack unless it is not wanted. Raises FileError."""
    from maxq.tools.verify.record import write_verdict  # noqa: PLC0415  # lazy

    files = [write_verdict(folder, found, command)]
    if pack:
        from maxq.tools.verify.page import write_page  # noqa: PLC0415  # lazy

        files += write_page(folder, found, command)
    return files
