"""Design files: search for a design by its name, and output of a design that simrun flies unaltered."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import tomli_w

from maxq.design.laws.law import DesignedLaw
from maxq.sim.input.documents import Source, adopt, plain
from maxq.sim.input.errors import ScenarioError, suggestion
from maxq.sim.input.files import builtin_files, note_here
from maxq.sim.scenario.loader import LoadedScenario, load_scenario
from maxq.sim.scenario.schema_design import Design, DesignBasis, RollSection, StageLaw

DESIGN_NAME = "design.toml"
_DIGITS = 9
_PLAIN_LIST = re.compile(r"\[\n((?: +[-+.\w\"]+,\n)+) *\]")
"""A pattern for a list of numbers or words with each element on its own line."""


def design_path(name: str) -> str:
    """Return the path by which a scenario refers to the design that a user calls `name`.

    `name` is a built-in design, a design file, or a folder that contains the design.toml of a case. Raises
    ScenarioError if none of these exists.
    """
    path, known = Path(name), builtin_files("design")
    if not name:
        raise ScenarioError('""', "no such file", allowed="a design file (.toml)")
    if name in known:
        note_here(name, known[name], (f"{{}}/{DESIGN_NAME}", "{}", "{}.toml"))
        return f"designs/{name}.toml"
    if (path / DESIGN_NAME).is_file():
        return str((path / DESIGN_NAME).resolve())
    if path.is_file():
        return str(path.resolve())
    stem = name.removeprefix("designs/").removesuffix(".toml")
    if stem in known:
        return f"designs/{stem}.toml"
    if path.is_dir():
        raise ScenarioError(name, f"the folder has no {DESIGN_NAME}", allowed="a design file (.toml)")
    hint = suggestion(name.removesuffix(".toml"), known)
    problem = f"no such file; {hint}" if hint else "no such file"
    raise ScenarioError(name, problem, allowed=f"a design file (.toml), or a built-in one: {', '.join(known)}")


def load_design(name: str | Path, beside: LoadedScenario | str | Path = "nominal") -> Design:
    """Load a design from a file or from the built-in designs (`designs/...`).

    The design is read as part of the scenario `beside`, whose folder is also searched for the file. Raises
    ScenarioError.
    """
    label = beside.label if isinstance(beside, LoadedScenario) else beside
    design = load_scenario(label, [f'design="{Path(name).as_posix()}"']).design
    assert design is not None
    return design


def design_of(
    *,
    name: str,
    description: str,
    vehicle: str,
    law: DesignedLaw,
    roll: RollSection | None = None,
    basis: DesignBasis | None = None,
) -> Design:
    """Return a design whose numbers are rounded to nine digits.

    The written, verified and flown numbers are thus identical.
    """
    rounded = json.loads(json.dumps(law.tables()), parse_float=lambda text: float(f"{float(text):.{_DIGITS}g}"))
    given = {"schema": 2, "name": name, "description": description, "vehicle": vehicle, **rounded}
    design = Design.model_validate(plain(adopt(given, Source("design"))))
    return design.model_copy(update={"roll": roll, "basis": basis})


def design_text(design: Design, comments: Sequence[str] = ()) -> str:
    """Return the design as TOML text that reads back to the same numbers, preceded by the lines of `comments`."""
    kept = design.model_dump(by_alias=True, exclude_none=True).items()
    content = {key: value for key, value in kept if value not in ("", ())}
    laws: list[Design | StageLaw] = [design, *design.stage]
    for mine, law in zip((content, *content.get("stage", ())), laws, strict=True):
        if law.filter is not None:
            mine["filter"] = _without_empty(mine["filter"])
        if law.loop_filters is not None:
            mine["loop_filters"] = {key: _without_empty(each) for key, each in mine["loop_filters"].items()}
        if law.gains is None:
            continue
        names = (law.gains.over, *design.gain_names)
        for key in ("table", "yaw_table"):
            if key in mine["gains"]:
                table = getattr(law.gains, key)
                columns = [table[name].tolist() for name in names]
                mine["gains"][key] = [dict(zip(names, row, strict=True)) for row in zip(*columns, strict=True)]
        if "yaw_table" not in mine["gains"]:
            mine["gains"]["yaw"] = "pitch"
    text = _PLAIN_LIST.sub(lambda m: f"[{', '.join(m[1].replace(',', ' ').split())}]", tomli_w.dumps(content))
    return "".join(f"{f'# {line}'.rstrip()}\n" for line in comments) + text


def _without_empty(filter_: dict[str, Any]) -> dict[str, Any]:
    """Return a filter section, and each point of its schedule, without empty lists of sections."""
    kept = {key: value for key, value in filter_.items() if value != ()}
    return kept | ({"schedule": [_without_empty(point) for point in kept["schedule"]]} if "schedule" in kept else {})


def forget_pictures(folder: Path) -> None:
    """Remove the plots and pages of an earlier run from a folder, since they show another design.

    Other files remain.
    """
    for page in ("design.html", "analysis.html"):
        (folder / page).unlink(missing_ok=True)
    for stem in ("vehicle-*", "gains", "filter", "margins", "lobes", "loop-*s", "orders-*"):
        for kind in ("svg", "png"):
            for path in folder.glob(f"{stem}.{kind}"):
                path.unlink(missing_ok=True)
