"""The subcommand `simrun winds FILE...`: wind profiles at a place, from gridded data of weather services.

The files are NetCDF or GRIB with winds on pressure levels, such as those of ERA5, GFS and MERRA-2. They are
interpolated linearly in latitude, longitude and time on each level, by xarray (extra `maxq[winds]`). One CSV file is
written for each time and ensemble member; `wind.profile` and `[wind_model] profiles` accept the files and their folder.

Without heights, altitudes follow from the pressure by the US Standard Atmosphere 1976 (`wind_table` in
sim/scenario/soundings.py). A level is omitted if a value is missing. Weather models extrapolate below the ground.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from maxq.sim.files import whole_file
from maxq.sim.input.errors import ScenarioError
from maxq.sim.input.tables_csv import CsvTable
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.scenario.soundings import SoundingLevel, wind_table
from maxq.sim.world.constants import STANDARD_GRAVITY_mps2
from maxq.tools.cli.frame import CommandError, Exit
from maxq.tools.cli.terminal import aligned, tell

_VARIABLES = {
    "east": ("eastward_wind", ("u", "ugrd", "ua")),
    "north": ("northward_wind", ("v", "vgrd", "va")),
    "height": ("geopotential_height", ("gh", "hgt", "zg", "h")),
    "geopotential": ("geopotential", ("z", "phi")),
}
"""The standard name of each quantity, and its names in files, in lower case."""
_AXES = {
    "time": ("valid_time", "time"),
    "level": ("pressure_level", "isobaricinhpa", "level", "lev", "plev", "isobaric"),
    "latitude": ("latitude", "lat"),
    "longitude": ("longitude", "lon"),
    "member": ("number", "member", "ensemble", "ens", "realization"),
}
_PRESSURES = {"hpa": 1.0, "millibar": 1.0, "millibars": 1.0, "mbar": 1.0, "mb": 1.0, "pa": 0.01}
_HEIGHTS = {"m": 1.0, "gpm": 1.0, "metre": 1.0, "meter": 1.0, "metres": 1.0, "meters": 1.0}
_SPEEDS = {"m/s": 1.0, "m s-1": 1.0, "m s**-1": 1.0}
_GEOPOTENTIALS = dict.fromkeys(("m**2 s**-2", "m2 s-2", "m^2 s^-2", "m^2/s^2", "m2/s2"), 1.0 / STANDARD_GRAVITY_mps2)
_UNITS = {"east": _SPEEDS, "north": _SPEEDS, "height": _HEIGHTS, "geopotential": _GEOPOTENTIALS}
_OF_GRIB = {"indexpath": "", "filter_by_keys": {"typeOfLevel": "isobaricInhPa"}}


class _Profile(NamedTuple):
    time: str  # ISO 8601, UTC, to the minute; empty if the files have no time
    member: int | None
    table: CsvTable


def execute(
    files: Sequence[str],
    *,
    place: tuple[float, float] | None = None,
    site: str | None = None,
    time: datetime | None = None,
    out: str = "winds",
) -> int:
    """Write the profiles at `place` (geodetic latitude and longitude, deg), or at the site of a scenario.

    `time` selects one time, UTC; without it, every time in the files has a profile. Raises CommandError without the
    packages of `maxq[winds]`, and ScenarioError for files that cannot be read or do not contain the place or the time.
    """
    if (place is None) == (site is None):
        raise CommandError("the place is not known: give either --at LATITUDE,LONGITUDE or --site SCENARIO")
    if site is not None:
        given = load_scenario(site).scenario.site
        place = (given.latitude_deg, given.longitude_deg)
    assert place is not None
    label = ", ".join(files)
    found = list(_profiles(_opened(files), label, *place, time))
    rows = [("file", "time, UTC", "levels", "altitude, m", "largest wind, m/s")]
    stem = Path(files[0]).stem
    for profile in found:
        stamp = re.sub(r"[-:]", "", profile.time)
        number = "" if profile.member is None else f"m{profile.member:02d}"
        path = Path(out) / f"{'-'.join(filter(None, (stem, stamp, number)))}.csv"
        _write(path, profile, label, place)
        altitude_m, north, east = (profile.table.columns[name] for name in ("altitude_m", "north_mps", "east_mps"))
        span = f"{altitude_m[0]:,.0f} to {altitude_m[-1]:,.0f}"
        rows.append((str(path), profile.time, str(len(altitude_m)), span, f"{np.hypot(north, east).max():.1f}"))
    tell(*aligned(rows, right=(2, 3, 4)))
    return Exit.OK


def _write(path: Path, profile: _Profile, label: str, place: tuple[float, float]) -> None:
    comments = [f"# from {label} at {place[0]:g} deg north, {place[1]:g} deg east", f"# date: {profile.time}"]
    rows = zip(*(profile.table.columns[name] for name in ("altitude_m", "north_mps", "east_mps")), strict=True)
    body = [f"{altitude:.1f},{north:.3f},{east:.3f}" for altitude, north, east in rows]
    with whole_file(path) as part:
        head = comments if profile.time else comments[:1]
        part.write_text("\n".join([*head, "altitude_m,north_mps,east_mps", *body]) + "\n", encoding="utf-8")


def _opened(files: Sequence[str]) -> Any:
    """Return one xarray data set with the winds of all files."""
    try:
        import xarray  # noqa: PLC0415  # an extra
    except ImportError as error:
        raise CommandError(
            f"winds needs the packages of the extra winds ({error}): pip install 'maxq[winds]'"
        ) from None
    parts = []
    for file in files:
        if not Path(file).is_file():
            raise ScenarioError(file, "no such file", allowed="NetCDF or GRIB files with winds on pressure levels")
        with open(file, "rb") as head:
            grib = head.read(4) == b"GRIB"
        options: dict[str, Any] = {"engine": "cfgrib", "backend_kwargs": _OF_GRIB} if grib else {}
        try:
            parts.append(xarray.open_dataset(file, **options).load())
        except Exception as error:  # each reader has its own
            reason = " ".join(str(error).split())[:200]
            raise ScenarioError(file, f"cannot be read: {reason}", allowed="NetCDF or GRIB") from None
    parts = [_of_valid_time(part, file) for part, file in zip(parts, files, strict=True)]
    try:
        return parts[0] if len(parts) == 1 else xarray.combine_by_coords(parts, combine_attrs="override")
    except ValueError as error:
        reason = " ".join(str(error).split())[:200]
        raise ScenarioError(", ".join(files), f"cannot be combined: {reason}", allowed="files of one grid") from None


def _of_valid_time(data: Any, file: str) -> Any:
    """Return the data over the times for which they are valid, also for one time or the steps of a forecast."""
    if "valid_time" not in data.coords:
        return data.expand_dims("time") if "time" in data.coords and "time" not in data.dims else data
    dims = data["valid_time"].dims
    if len(dims) > 1:
        raise ScenarioError(file, "contains several forecasts with several steps each", allowed="one base time")
    data = data.drop_vars(["time", "step"], errors="ignore")
    if not dims:
        return data.expand_dims("valid_time")
    return data if dims == ("valid_time",) else data.swap_dims({dims[0]: "valid_time"})


def _profiles(
    data: Any, label: str, latitude_deg: float, longitude_deg: float, time: datetime | None
) -> Iterator[_Profile]:
    """Yield the profile of every time and member of a data set."""
    axes = {axis: _axis(data, axis, names) for axis, names in _AXES.items()}
    for axis in ("level", "latitude", "longitude"):
        if axes[axis] is None:
            allowed = f"one of {', '.join(_AXES[axis])}"
            raise ScenarioError(label, f"has no axis of {axis}, only {', '.join(map(str, data.dims))}", allowed=allowed)
    there = _columns(data, label)
    known = set(filter(None, axes.values()))
    for name, _ in there.values():
        if axes["level"] not in data[name].dims or not known.issuperset(data[name].dims):
            problem = f"{name} is over the axes {', '.join(map(str, data[name].dims)) or 'none'}"
            raise ScenarioError(label, problem, allowed=f"{', '.join(sorted(known))}, with {axes['level']}")
    if axes["time"] is not None and not np.issubdtype(data[axes["time"]].dtype, np.datetime64):
        allowed = "dates, by units such as hours since 1970-01-01"
        raise ScenarioError(label, "has times that are no dates", str(axes["time"]), allowed=allowed)
    here = _at_place(data[[name for name, _ in there.values()]], label, axes, latitude_deg, longitude_deg)
    if axes["time"] is not None:
        here = _at_time(here, label, axes["time"], time)
    elif time is not None:
        raise ScenarioError(label, "has no axis of time", "--time", value=time.isoformat(), allowed="no --time")
    level = data[axes["level"]]
    pressure_hPa = np.asarray(level.values, float) * _factor(level, _PRESSURES, label)
    for moment in here[axes["time"]].values if axes["time"] in here.dims else [None]:
        then = here if moment is None else here.sel({axes["time"]: moment})
        stamp = "" if moment is None else str(np.datetime_as_string(moment, unit="m"))
        for member in here[axes["member"]].values if axes["member"] in here.dims else [None]:
            one = then if member is None else then.sel({axes["member"]: member})
            columns = {what: factor * np.asarray(one[name].values, float) for what, (name, factor) in there.items()}
            heights = columns.get("height", columns.get("geopotential", np.full(len(pressure_hPa), np.nan)))
            rows = zip(heights, pressure_hPa, columns["north"], columns["east"], strict=True)
            levels = [
                SoundingLevel(k, geopotential_m=height, pressure_hPa=pressure, north_mps=north, east_mps=east)
                for k, (height, pressure, north, east) in enumerate(rows, start=1)
            ]
            yield _Profile(stamp, None if member is None else int(member), wind_table(levels, label, label, stamp))


def _axis(data: Any, axis: str, names: Sequence[str]) -> str | None:
    found = {str(name).lower(): str(name) for name in data.dims}
    return next((found[name] for name in names if name in found), None)


def _columns(data: Any, label: str) -> dict[str, tuple[str, float]]:
    """Return the variable of each quantity that the data have, and the factor to m/s or to geopotential metres."""
    there: dict[str, tuple[str, float]] = {}
    for what, (standard, names) in _VARIABLES.items():
        for name, variable in data.data_vars.items():
            if variable.attrs.get("standard_name") == standard or str(name).lower() in names:
                there[what] = (str(name), _factor(variable, _UNITS[what], label))
                break
    for what in ("east", "north"):
        if what not in there:
            standard, names = _VARIABLES[what]
            known = ", ".join(map(str, data.data_vars)) or "nothing"
            raise ScenarioError(label, f"has no {standard} on pressure levels, but {known}", allowed=", ".join(names))
    return there


def _factor(variable: Any, units: dict[str, float], label: str) -> float:
    """Return the factor of a variable's unit; the first of `units` is assumed if none is given."""
    given = str(variable.attrs.get("units", next(iter(units)))).strip()
    if given.lower() not in units:
        raise ScenarioError(label, "has an unknown unit", str(variable.name), value=given, allowed=", ".join(units))
    return units[given.lower()]


def _at_place(data: Any, label: str, axes: dict[str, Any], latitude_deg: float, longitude_deg: float) -> Any:
    """Return the data interpolated at a place. A grid around the whole Earth is closed at its ends."""
    import xarray  # noqa: PLC0415  # an extra

    data = data.sortby([axes["latitude"], axes["longitude"]])
    longitudes = np.asarray(data[axes["longitude"]].values, float)
    if len(longitudes) > 1 and longitudes[-1] + 1.5 * (longitudes[1] - longitudes[0]) > longitudes[0] + 360.0:
        first = data.isel({axes["longitude"]: [0]})
        closing = first.assign_coords({axes["longitude"]: first[axes["longitude"]] + 360.0})
        data = xarray.concat([data, closing], axes["longitude"])
    west = float(longitudes[0])
    wanted = {axes["latitude"]: latitude_deg, axes["longitude"]: west + (longitude_deg - west) % 360.0}
    for (axis, value), asked in zip(wanted.items(), (latitude_deg, longitude_deg), strict=True):
        values = np.asarray(data[axis].values, float)
        if not values.min() <= value <= values.max():
            allowed = f"{values.min():g} to {values.max():g} deg"
            raise ScenarioError(label, "does not contain the place", axis, value=asked, allowed=allowed)
        if len(values) == 1:  # xarray interpolates between two values or more
            data = data.isel({axis: [0, 0]}).assign_coords({axis: [value, value + 1.0]})
    return data.interp(wanted)


def _at_time(data: Any, label: str, axis: str, time: datetime | None) -> Any:
    if time is None:
        return data
    moment = np.datetime64(time.astimezone(UTC).replace(tzinfo=None), "ns")
    times = data[axis].values
    if not times.min() <= moment <= times.max():
        allowed = " to ".join(str(np.datetime_as_string(t, unit="m")) for t in (times.min(), times.max()))
        raise ScenarioError(label, "does not contain the time", "--time", value=time.isoformat(), allowed=allowed)
    return data.sel({axis: [moment]}) if moment in times else data.sortby(axis).interp({axis: [moment]})
