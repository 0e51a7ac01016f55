"""Designs as files: which one a person means, and how one is written so that simrun flies it as it is."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from maxq.control.filters import BendingFilter, Discretization
from maxq.control.kernel.records import Array
from maxq.control.laws.structures import structure_of
from maxq.sim.scenario.builtin import scenarios_folder
from maxq.sim.scenario.documents import Source, adopt, plain
from maxq.sim.scenario.errors import ScenarioError
from maxq.sim.scenario.schema_design import Design, Limits, Roll

DESIGN_NAME = "design.toml"
_DIGITS = 9


def designs_folder() -> Path:
    """Folder of the built-in designs."""
    return scenarios_folder() / "designs"


def builtin_designs() -> list[str]:
    """Names of the built-in designs, sorted."""
    return sorted(path.stem for path in designs_folder().glob("*.toml"))


def design_path(name: str) -> str:
    """What a scenario has to name to fly the design a person means by `name`.

    A design file, a folder with a design.toml that a case has left there, or the name of a built-in one.
    """
    path = Path(name)
    if not name:
        raise ScenarioError('""', "no such file", allowed="a design file (.toml)")
    if (path / DESIGN_NAME).is_file():
        return str((path / DESIGN_NAME).resolve())
    if path.is_file():
        return str(path.resolve())
    if name.removesuffix(".toml") in builtin_designs():
        return f"designs/{name.removesuffix('.toml')}.toml"
    if path.is_dir():
        raise ScenarioError(name, f"the folder has no {DESIGN_NAME}", allowed="a design file (.toml)")
    listed = ", ".join(builtin_designs())
    raise ScenarioError(name, "no such file", allowed=f"a design file (.toml), or a built-in one: {listed}")


def design_of(
    *,
    name: str,
    description: str,
    vehicle: str,
    time_s: Sequence[float] | Array,
    k_p: Sequence[float] | Array,
    k_d_s: Sequence[float] | Array,
    flt: BendingFilter,
    discretization: Discretization,
    prewarp_hz: float | None,
    roll: Roll | None = None,
    limits: Limits | None = None,
) -> Design:
    """A design with numbers of nine digits: what is written, judged and flown are the same numbers."""
    rows = [
        {"time_s": _rounded(t), "k_p": _rounded(p), "k_d_s": _rounded(d)}
        for t, p, d in zip(time_s, k_p, k_d_s, strict=True)
    ]
    keys = ("zero_hz", "zero_zeta", "pole_hz", "pole_zeta")
    sections: dict[str, Any] = {
        "quadratic": [{key: _rounded(getattr(q, key)) for key in keys} for q in flt.quadratic],
        "first_order": [{key: _rounded(getattr(f, key)) for key in ("zero_hz", "pole_hz")} for f in flt.first_order],
    }
    structure = structure_of(len(flt.quadratic), len(flt.first_order))
    filter_: dict[str, Any] = {"structure": structure, "discretization": discretization} | sections
    if structure != "none" and prewarp_hz is not None:
        filter_["prewarp_hz"] = _rounded(prewarp_hz)
    given: dict[str, Any] = {
        "schema": 1, "name": name, "description": description, "vehicle": vehicle,
        "gains": {"table": rows, "yaw": "pitch"}, "filter": filter_,
    }  # fmt: skip
    design = Design.model_validate(plain(adopt(given, Source("design"))))
    return design.model_copy(update={"roll": roll, "limits": limits})


def design_text(design: Design, comments: Sequence[str] = ()) -> str:
    """The design as TOML that reads back to the same numbers; `comments` go above it."""
    lines = [f"# {line}".rstrip() for line in comments]
    lines += ["schema = 1", f"name = {_text(design.name)}"]
    if design.description:
        lines.append(f"description = {_text(design.description)}")
    if design.vehicle:
        lines.append(f"vehicle = {_text(design.vehicle)}")
    lines += ["", "[gains]", *_gains("table", design.gains.table)]
    if design.gains.yaw_table is not None:
        lines += _gains("yaw_table", design.gains.yaw_table)
    else:
        lines.append('yaw = "pitch"')
    lines += ["", "[filter]", f'structure = "{design.filter.structure}"']
    for key in ("quadratic", "first_order"):
        sections = getattr(design.filter, key)
        if sections:
            rows = [f"    {_inline(section.model_dump())}," for section in sections]
            lines += [f"{key} = [", *rows, "]"]
    lines.append(f'discretization = "{design.filter.discretization}"')
    if design.filter.prewarp_hz is not None:
        lines.append(f"prewarp_hz = {design.filter.prewarp_hz!r}")
    for key in ("roll", "limits"):
        section = getattr(design, key)
        if section is not None:
            values = {k: v for k, v in section.model_dump().items() if v is not None}
            lines += ["", f"[{key}]", *(f"{k} = {v!r}" for k, v in values.items())]
    return "\n".join(lines) + "\n"


def forget_pictures(folder: Path) -> None:
    """Take away the pictures of an earlier run: they show another design. Nothing else in the folder is touched."""
    for stem in ("vehicle-*", "gains", "filter", "margins", "lobes", "loop-*s", "orders-*"):
        for kind in ("svg", "png"):
            for path in folder.glob(f"{stem}.{kind}"):
                path.unlink(missing_ok=True)


def _gains(key: str, table: Any) -> list[str]:
    names = ("time_s", "k_p", "k_d_s")
    columns = [table[name].tolist() for name in names]
    rows = [f"    {_inline(dict(zip(names, row, strict=True)))}," for row in zip(*columns, strict=True)]
    return [f"{key} = [", *rows, "]"]


def _inline(values: dict[str, float]) -> str:
    return "{ " + ", ".join(f"{key} = {value!r}" for key, value in values.items()) + " }"


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")
