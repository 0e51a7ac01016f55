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
  simvehicle import rocket.ork --out mine         then: simvehicle mine/layout.toml
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
    parser = Parser("simvehicle", about, _EXAMPLES, _EXITS)
    parser.commands("LAYOUT", lambda name: "build")
    examples = """\
  simvehicle build petrel --out mine              the same as: simvehicle petrel --out mine
"""
    about = "Compute a vehicle from a layout"
    build = parser.command("build", about, examples, _build, _EXITS)
    build.option("LAYOUT", "layout file, or a built-in layout (docs/simvehicle.md)", dest="name")
    build.option("--out DIR", "where to write (default: runs/<name of the layout>)")
    build.option("--compare VEHICLE", "print differences from this vehicle (a folder, or a built-in vehicle)")
    examples = """\
  simvehicle import rocket.ork                    with the motor files next to it
  simvehicle import rocket.ork --motor H128W=AeroTech_H128W.eng --drag cd.csv
"""
    about = "Make a layout of an unguided vehicle from an OpenRocket design (.ork)"
    imported = parser.command("import", about, examples, _import)
    imported.option("DESIGN", "OpenRocket design (.ork)")
    imported.option("--motor FILE...", "thrust curve, .eng or .rse, also DESIGNATION=FILE; repeatable", dest="motors")
    imported.option("--drag FILE", "axial force coefficient: lines of Mach number and coefficient (CSV)")
    imported.option("--configuration ID", "flight configuration by identifier or name (default: that of the design)")
    imported.option("--out DIR", "where to write layout.toml (default: runs/<name of the design>)")
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
    from maxq.tools.vehicle.files import write  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.first_gains import write_with_first_gains  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.layout import read_layout  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.report import report  # noqa: PLC0415  # lazy

    layout = read_layout(name)
    folder = Path(out or Path("runs") / plain_name(layout.name, "vehicle"))
    check_writable(folder)
    with Progress(at_once=True) as progress:
        try:
            built, gains = build(layout, progress.show), None
            if layout.unguided:
                files = write(built, folder)
            else:
                built, files, gains = write_with_first_gains(built, folder, progress.show)
        except ValueError as error:
            raise ScenarioError(name, str(error)) from None
        progress.show("drawing the page", 0, 0)
        text = "unguided; no gains" if gains is None else gains.text
        code, outcome = Exit.OK, f"BUILT: {text}"
        if weak := too_weak(built):
            code, outcome = Exit.FAILED, f"TOO WEAK: {'; '.join(weak)}"
        elif gains is not None and not gains.hold:
            code, outcome = Exit.FAILED, f"UNSTABLE: {text}"
        files.append(write_whole(folder / "vehicle.html", page(built, outcome, passed=code == Exit.OK)))
    tell(report(built))
    if compare is not None:
        try:
            tell(f"\n{comparison(compared(built, folder, compare), compare)}")
        except ValueError as error:
            raise ScenarioError("--compare", str(error)) from None
    tell(f"\n{len(files)} files in {folder}/")
    tell(text)
    if code == Exit.OK:
        tell(f"BUILT: {layout.name}; fly it with: simrun {folder}/scenario.toml")
    elif weak:
        tell(outcome)
    else:
        what = f"design it with: simdesign {folder}/case.toml, or give another control.rigid_hz in the layout"
        tell(f"UNSTABLE: {layout.name}; {text}; {what}")
    return code


def _import(
    design: str,
    *,
    motors: tuple[str, ...] = (),
    drag: str | None = None,
    configuration: str | None = None,
    out: str | None = None,
) -> int:
    from maxq.sim.files import check_writable, plain_name  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.airframe_layout import table_text, with_drag, write_layout  # noqa: PLC0415  # lazy
    from maxq.tools.vehicle.openrocket import read_openrocket  # noqa: PLC0415  # lazy

    airframe = read_openrocket(Path(design), motors, configuration)
    if drag is not None:
        airframe = with_drag(airframe, Path(drag))
    folder = Path(out or Path("runs") / plain_name(airframe.name, "vehicle"))
    check_writable(folder)
    path = write_layout(airframe, folder)
    tell(f"{airframe.name}, from {airframe.source}\n", table_text(airframe))
    tell(f"\nIMPORTED: {path}; build it with: simvehicle {path}")
    return Exit.OK


command = Command("simvehicle", _run, "interrupted; nothing written")
main = command.main

if __name__ == "__main__":
    command()
