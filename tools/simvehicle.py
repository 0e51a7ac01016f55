"""The command `simvehicle`: build a vehicle that flies from a layout.

Expensive modules are imported only when they are needed.
"""

from __future__ import annotations

from pathlib import Path

from maxq.tools.cli.frame import Command, Exit
from maxq.tools.cli.parser import Parser
from maxq.tools.cli.terminal import Progress, tell

_EXAMPLES = """\
  simvehicle petrel                               a built-in layout, into runs/petrel
  simvehicle mine.toml --out mine                 then: simrun mine/scenario.toml
  simvehicle ksr3 --compare vehicles/ksr3         print differences from existing tables
"""
_EXITS = {
    Exit.OK: "the vehicle is written",
    Exit.FAILED: "written, but the gimbals are too weak for the aerodynamics, or no first gains were found that "
    "are stable along their own flight; the output states where",
    Exit.BAD_INPUT: "bad input, or a layout that cannot fly; nothing written",
    Exit.INTERRUPTED: "interrupted; nothing written",
}


def _parser() -> Parser:
    about = "Compute a vehicle from a layout: masses, modes, slosh, aerodynamics, pitch programme and first gains."
    parser = Parser("simvehicle", about, _EXAMPLES, _EXITS, _build)
    parser.option("LAYOUT", "layout file, or a built-in layout (docs/simvehicle.md)", dest="name")
    parser.option("--out DIR", "where to write (default: runs/<name of the layout>)")
    parser.option("--compare VEHICLE", "print differences from this vehicle (a folder, or a built-in vehicle)")
    parser.about_itself({"layout": "layouts (simvehicle LAYOUT)"})
    return parser


def _run(arguments: list[str]) -> int:
    return _parser().run(arguments)


def _build(name: str, *, out: str | None = None, compare: str | None = None) -> int:
    from maxq.sim.files import check_writable, plain_name, write_whole  # noqa: PLC0415  # lazy, as all here
    from maxq.sim.input.errors import ScenarioError  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.build import build, too_weak  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.compare import compared, comparison  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.figures import page  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.first_gains import write_with_first_gains  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.layout import read_layout  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.report import report  # noqa: PLC0415  # lazy

    layout = read_layout(name)
    folder = Path(out or Path("runs") / plain_name(layout.name, "vehicle"))
    check_writable(folder)
    with Progress(at_once=True) as progress:
        try:
            built, files, gains = write_with_first_gains(build(layout, progress.show), folder, progress.show)
        except ValueError as error:
            raise ScenarioError(name, str(error)) from None
        progress.show("drawing the page", 0, 0)
        code, outcome = Exit.OK, f"BUILT: {gains.text}"
        if weak := too_weak(built):
            code, outcome = Exit.FAILED, f"TOO WEAK: {'; '.join(weak)}"
        elif not gains.hold:
            code, outcome = Exit.FAILED, f"UNSTABLE: {gains.text}"
        files.append(write_whole(folder / "vehicle.html", page(built, outcome, passed=code == Exit.OK)))
    tell(report(built))
    if compare is not None:
        try:
            tell(f"\n{comparison(compared(built, folder, compare), compare)}")
        except ValueError as error:
            raise ScenarioError("--compare", str(error)) from None
    tell(f"\n{len(files)} files in {folder}/")
    tell(gains.text)
    if code == Exit.OK:
        tell(f"BUILT: {layout.name}; fly it with: simrun {folder}/scenario.toml")
    elif weak:
        tell(outcome)
    else:
        what = f"design it with: simdesign {folder}/case.toml, or give another control.rigid_hz in the layout"
        tell(f"UNSTABLE: {layout.name}; {gains.text}; {what}")
    return code


command = Command("simvehicle", _run, "interrupted; nothing written")
main = command.main

if __name__ == "__main__":
    command()
