"""Writes docs/scenario.md: every key of the scenario files, from the schema.

python -m maxq.tools.dev.documents.docs_scenario [PAGE]
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from maxq.sim.scenario.errors import show_value
from maxq.sim.scenario.messages import describe, section_of, unwrap
from maxq.sim.scenario.ranges import LARGEST_NUMBER, RANGES
from maxq.sim.scenario.schema_design import Design
from maxq.sim.scenario.schema_scenario import Scenario
from maxq.sim.scenario.schema_values import Section
from maxq.sim.scenario.schema_vehicle import Vehicle

_INTRODUCTION = """\
# Scenario files

<!-- Written by `python -m maxq.tools.dev.documents.docs_scenario`: change the schema, not this file. -->

A scenario says what is flown. It is a TOML file; the vehicle and the control design that it names are TOML
files too, and they name tables in CSV files. Units are in the keys. Unknown keys are refused.

- **Files** are looked for beside the file that names them, then among the built-in scenarios. `vehicle =
  "vehicles/ksr3"` means `vehicles/ksr3/vehicle.toml`; `.toml` may be left out. What is a file may also be
  written out in the scenario: `[vehicle]` and `[design]` as tables, `table = {time_s = [0.0, 9.0], mass_kg
  = [5.0, 4.0]}` or `table = [{time_s = 0.0, mass_kg = 5.0}, {time_s = 9.0, mass_kg = 4.0}]`.
- **CSV files**: one line of column names, numbers separated by commas; lines that begin with `#` are
  skipped. A table with a single row is constant. Tables over time begin at or before 0 and reach to the end
  of thrust; gains are held outside their table.
- **Soundings**: `wind.profile` and the profiles of an ensemble may name a sounding as it comes: University of Wyoming
  (text, HTML page, CSV), IGRA version 2, or CSV with units in the column names (`altitude_ft`, `geopotential
  height_m` or `pressure_hPa`; `speed_kt` and `wind direction_degree`, or `u_m/s` and `v_m/s`; other columns are passed
  over). Rows may be in any order and have gaps; heights that are missing follow from pressure. `station.txt#12` is the
  twelfth sounding of a file.
- **`extends = "nominal.toml"`** (also in vehicle and design files): this file lies on top of the other one,
  table by table and key by key; lists and lists of tables are replaced as a whole. `unset =
  ["wind.profile"]` takes away keys of the extended file. The name is not inherited.
- **`[vehicle_overrides]`, `[design_overrides]`** change single values of the vehicle and the design:
  `stage.0.tank.0.damping_ratio = 0.01`.
- **`--set KEY=VALUE`** does so from the command line, for every key: `--set run.step_s=0.0005`, `--set
  vehicle.stage.0.engine.thrust_factor=1.02`, `--set design=designs/other.toml`; `--set KEY=` takes a key
  away.
- **Completion in editors**: `simrun --schema scenario > scenario.schema.json` writes the JSON Schema of this version
  (also `vehicle`, `design`, `campaign`, `case`, `suite`); the first line `#:schema ./scenario.schema.json` of a file
  then makes editors with a TOML language server (taplo: "Even Better TOML" in VS Code, Zed, Helix, Neovim) complete
  and check its keys.

Times marked "whole ns" must be whole numbers of nanoseconds. *required* marks keys without a default.
"""


_VALIDITY = """\
## Where the environment models hold

| key | holds | beyond |
|---|---|---|
| `earth.shape` `wgs84`, `sphere` | everywhere; altitude is geodetic, or above the sphere | |
| `earth.shape` `flat` | while the distance flown is small beside the Earth's radius | the same plane |
| `earth.gravity` `j2` | outside the Earth; left out are harmonics beyond J2 (1e-6 of gravity each), local anomalies \
(to 1e-4), Moon and Sun | the same formula |
| `earth.gravity` `inverse_square`, `uniform` | while J2 (1e-3) does not matter; at small altitudes | the same |
| `atmosphere.model` `us1976` | -5 to 1000 km: a steady mean year at 45 deg; the thermosphere varies with the Sun by \
factors | below, the values at -5 km; above, no air |
| `atmosphere.model` `table` | its rows | below, the first row; above, isothermal from the last |
| `wind.profile` | its rows | the end rows, or a failure (`wind.outside`) |
| `wind.ground` | a neutral surface layer, some 100 m above the site | used below the profile only |
| `wind.turbulence` `dryden`, `von-karman` | MIL-F-8785C: 10 to 1000 ft above the site by the surface wind, 2000 to \
80,000 ft by exceedance, linear between | the end values; no dependence on weather or terrain |
| the same, `frame = "body"` | where the nose points along the path and intensities are alike in all directions: \
aircraft, and rockets above 1000 ft | near the ground a vertical vehicle's pitch axis gets the weak vertical component |
| the same, `frame = "horizontal"` | any attitude but vertical descent | |
| `wind.turbulence` `spectrum` | between its wave numbers, at the altitudes that its source says | the same everywhere |

Turbulence is drawn at 100 Hz and joined by straight lines: waves shorter than the way flown in 40 ms are weakened.
"""


def page() -> str:
    """The page in Markdown."""
    parts = [_INTRODUCTION]
    for title, name, model in (
        ("The scenario", "", Scenario),
        ("The vehicle (`vehicle.toml`)", "", Vehicle),
        ("The control design (`designs/*.toml`)", "", Design),
    ):
        parts.append(f"## {title}\n")
        parts.append("\n".join(_section(model, name)))
    parts.append("\n".join(_ranges()))
    return "\n".join([*parts, _VALIDITY]).rstrip() + "\n"


def _ranges() -> Iterator[str]:
    """What numbers may be, by the names of keys and columns."""
    yield "## Ranges of numbers\n"
    yield "Beside what a key allows itself, its magnitude, and that of a column in a table, lies in the range of its"
    yield "name or, where the name is not listed, of its unit, the end of the name; 0 is within. Beyond it lies what no"
    yield f"vehicle can have. Numbers of neither are {LARGEST_NUMBER:g} at most.\n"
    yield "What is possible and hardly meant, such as a reference length of 180 m on a vehicle of 14 m or a dispersion"
    yield "that turns a sign within 3 sigma, is flown, with a warning in report and summary.\n"
    yield "| names | least | most | why |"
    yield "|---|---|---|---|"
    for r in RANGES:
        names = ", ".join(f"`{name}`" if name[0] != "_" else f"`...{name}`" for name in r.names)
        yield (
            f"| {names} | {r.least:g} | {r.most:g} | {r.why} |" if r.least else f"| {names} | | {r.most:g} | {r.why} |"
        )
    yield ""


def _section(model: type[Section], path: str) -> Iterator[str]:
    if path:
        yield f"### `{path}`\n"
    yield f"{(model.__doc__ or '').splitlines()[0]}\n"
    yield "| key | allowed | default | meaning |"
    yield "|---|---|---|---|"
    below: list[tuple[str, type[Section]]] = []
    for name, field in model.model_fields.items():
        key = field.alias or name
        yield f"| `{key}` | {_cell(_allowed(field))} | {_default(field)} | {_cell(field.description or '')} |"
        section = section_of(field.annotation)
        if section is not None and section not in (Vehicle, Design):
            bare, _ = unwrap(field.annotation)
            inner = ".".join(part for part in (path.strip("[]"), key) if part)
            below.append((f"[{inner}]" if isinstance(bare, type) else f"[[{inner}]]", section))
    yield ""
    for inner, section in below:
        yield from _section(section, inner)


def _allowed(field: FieldInfo) -> str:
    if section_of(field.annotation) in (Vehicle, Design):
        return "a file, or a table"
    return describe(field.annotation, list(field.metadata))


def _default(field: FieldInfo) -> str:
    default: Any = field.default
    if field.default_factory is not None or default is None or default == "" or isinstance(default, Section):
        return ""
    return "*required*" if default is PydanticUndefined else f"`{show_value(default)}`"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def main(arguments: list[str]) -> int:
    """Write the page; returns 0."""
    path = Path(arguments[0] if arguments else "docs/scenario.md")
    path.write_text(page(), encoding="utf-8", newline="\n")
    print(path)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
