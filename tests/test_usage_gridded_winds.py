"""`simrun winds` writes profiles at a place from gridded data, for which linear fields give the exact values."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from maxq.sim.scenario.loader import load_scenario
from maxq.tools.cli.frame import CommandError
from maxq.tools.simrun import main

_EARTH_RADIUS_m = 6356766.0  # of geopotential heights
_PRESSURES_hPa = (1000.0, 500.0, 100.0)
_HEIGHTS_gpm = (110.0, 5600.0, 16200.0)
_TIMES = np.array(["2026-06-01T12:00", "2026-06-01T18:00"], dtype="datetime64[ns]")


def _geometric(height_gpm: float) -> float:
    return _EARTH_RADIUS_m * height_gpm / (_EARTH_RADIUS_m - height_gpm)


def _data(
    names: tuple[str, str, str], *, latitudes: list[float], longitudes: list[float], members: int = 0
) -> xr.Dataset:
    """Return winds that are linear in latitude, longitude, level and time, on a grid with falling latitudes.

    `names` are those of the eastward wind, the northward wind and the height or the geopotential.
    """
    hours, k = np.array([0.0, 6.0])[:, None, None, None], np.arange(3.0)[:, None, None]
    latitude, longitude = np.array(latitudes)[:, None], np.array(longitudes)
    east = 5.0 + 0.5 * latitude + 0.25 * longitude + 10.0 * k + 1.0 * hours
    north = -3.0 + 0.1 * latitude - 0.2 * longitude + 4.0 * k - 0.5 * hours
    height = np.array(_HEIGHTS_gpm)[:, None, None] + 2.0 * latitude + 0.0 * longitude + 1.0 * hours
    dims: tuple[str, ...] = ("valid_time", "pressure_level", "latitude", "longitude")
    fields = {names[0]: east, names[1]: north, names[2]: height * (9.80665 if names[2] == "z" else 1.0)}
    coords = {
        "valid_time": _TIMES,
        "pressure_level": ("pressure_level", list(_PRESSURES_hPa), {"units": "hPa"}),
        "latitude": latitudes,
        "longitude": longitudes,
    }
    if members:
        dims = ("number", *dims)
        fields = {name: np.stack([field + m for m in range(members)]) for name, field in fields.items()}
        coords["number"] = list(range(members))
    units = {names[0]: "m s**-1", names[1]: "m s**-1", names[2]: "m**2 s**-2" if names[2] == "z" else "gpm"}
    return xr.Dataset({n: (dims, field, {"units": units[n]}) for n, field in fields.items()}, coords)


def _file(folder: Path, data: xr.Dataset) -> Path:
    path = folder / "era5.nc"
    data.to_netcdf(path, engine="scipy")
    return path


def _read(path: Path) -> np.ndarray:
    return np.loadtxt(path, delimiter=",", skiprows=3)


def _run(*words: str) -> int:
    try:
        return int(main(list(words)))
    except SystemExit as end:  # of wrong options
        return int(end.code or 0)


def test_profiles_are_those_of_the_field_at_the_place(tmp_path: Path) -> None:
    file = _file(tmp_path, _data(("u", "v", "z"), latitudes=[40.0, 30.0], longitudes=[120.0, 130.0]))
    assert _run("winds", str(file), "--at", "36.5,126.25", "--out", str(tmp_path / "out")) == 0
    written = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in written] == ["era5-20260601T1200.csv", "era5-20260601T1800.csv"]
    for path, hour in zip(written, (0.0, 6.0), strict=True):
        k = np.arange(3.0)
        heights = [_geometric(h + 2.0 * 36.5 + hour) for h in _HEIGHTS_gpm]
        north = -3.0 + 3.65 - 0.2 * 126.25 + 4.0 * k - 0.5 * hour
        east = 5.0 + 18.25 + 0.25 * 126.25 + 10.0 * k + hour
        np.testing.assert_allclose(_read(path), np.column_stack([heights, north, east]), rtol=0, atol=0.051)
        np.testing.assert_allclose(_read(path)[:, 1:], np.column_stack([north, east]), rtol=0, atol=5.1e-4)
        assert f"# date: 2026-06-01T{12 + int(hour)}:00" in path.read_text()
    loaded = load_scenario("nominal", [f"wind.profile={str(written[0])!r}"])
    wind = loaded.scenario.wind
    assert wind is not None
    assert wind.profile is not None
    assert wind.profile.date == "2026-06-01T12"


def test_a_time_between_two_is_interpolated(tmp_path: Path) -> None:
    file = _file(tmp_path, _data(("U", "V", "H"), latitudes=[30.0, 40.0], longitudes=[120.0, 130.0]))
    words = ("winds", str(file), "--at", "30,130", "--time", "2026-06-01T15:30+02:00", "--out", str(tmp_path))
    assert _run(*words) == 0
    (path,) = tmp_path.glob("*.csv")
    assert path.name == "era5-20260601T1330.csv"
    np.testing.assert_allclose(_read(path)[0, 1:], [-3.0 + 3.0 - 26.0 - 0.75, 5.0 + 15.0 + 32.5 + 1.5], atol=5.1e-4)
    assert _read(path)[0, 0] == pytest.approx(_geometric(110.0 + 60.0 + 1.5), abs=0.051)


def test_a_grid_around_the_earth_is_closed(tmp_path: Path) -> None:
    data = _data(("u", "v", "gh"), latitudes=[30.0, 40.0], longitudes=[0.0, 90.0, 180.0, 270.0])
    assert _run("winds", str(_file(tmp_path, data)), "--at", "30,-45", "--out", str(tmp_path / "out")) == 0
    first = _read(sorted((tmp_path / "out").iterdir())[0])
    # between 270 deg and 0 deg: the mean of both values, not the linear continuation
    np.testing.assert_allclose(first[0, 1:], [-3.0 + 3.0 - 0.2 * 135.0, 5.0 + 15.0 + 0.25 * 135.0], atol=5.1e-4)


def test_the_site_of_a_scenario_is_the_place(tmp_path: Path) -> None:
    site = load_scenario("nominal").scenario.site
    data = _data(("u", "v", "z"), latitudes=[30.0, 40.0], longitudes=[120.0, 130.0])
    assert _run("winds", str(_file(tmp_path, data)), "--site", "nominal", "--out", str(tmp_path / "out")) == 0
    first = _read(sorted((tmp_path / "out").iterdir())[0])
    assert first[0, 2] == pytest.approx(5.0 + 0.5 * site.latitude_deg + 0.25 * site.longitude_deg, abs=5.1e-4)


def test_each_member_has_a_profile(tmp_path: Path) -> None:
    data = _data(("u", "v", "z"), latitudes=[30.0, 40.0], longitudes=[120.0, 130.0], members=3).isel(valid_time=[0])
    assert _run("winds", str(_file(tmp_path, data)), "--at", "30,120", "--out", str(tmp_path / "out")) == 0
    written = sorted((tmp_path / "out").iterdir())
    assert [path.name[-7:-4] for path in written] == ["m00", "m01", "m02"]
    assert [_read(path)[0, 2] for path in written] == pytest.approx([50.0, 51.0, 52.0])


def test_pressures_in_pa_give_altitudes_of_the_standard_atmosphere(tmp_path: Path) -> None:
    data = _data(("u", "v", "z"), latitudes=[30.0, 40.0], longitudes=[120.0, 130.0]).drop_vars("z")
    data = data.assign_coords(pressure_level=("pressure_level", [100.0 * p for p in _PRESSURES_hPa], {"units": "Pa"}))
    assert _run("winds", str(_file(tmp_path, data)), "--at", "30,120", "--out", str(tmp_path / "out")) == 0
    # heights of 1000, 500 and 100 hPa in the US Standard Atmosphere 1976, geometric, m
    first = _read(sorted((tmp_path / "out").iterdir())[0])
    np.testing.assert_allclose(first[:, 0], [110.9, 5578.9, 16221.0], rtol=0, atol=1.5)


@pytest.mark.parametrize(
    ("change", "words", "message"),
    [
        (lambda d: d, ("--at", "50,120"), "latitude = 50.0: does not contain the place; allowed: 30 to 40 deg"),
        (lambda d: d, ("--at", "30,119"), "longitude = 119.0: does not contain the place; allowed: 120 to 130 deg"),
        (lambda d: d, ("--at", "30,120", "--time", "2026-06-02"), "does not contain the time"),
        (lambda d: d.drop_vars("v"), ("--at", "30,120"), "has no northward_wind on pressure levels, but u, z"),
        (lambda d: d.rename(pressure_level="depth"), ("--at", "30,120"), "has no axis of level"),
        (lambda d: d.assign(u=d.u.assign_attrs(units="kt")), ("--at", "30,120"), "has an unknown unit"),
        (lambda d: d, (), "the place is not known"),
        (lambda d: d, ("--at", "95,120"), "is not a latitude within 90 deg"),
    ],
)
def test_wrong_input_is_named_on_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: object, words: tuple[str, ...], message: str
) -> None:
    assert callable(change)
    data = change(_data(("u", "v", "z"), latitudes=[30.0, 40.0], longitudes=[120.0, 130.0]))
    file = _file(tmp_path, data)
    assert _run("winds", str(file), *words, "--out", str(tmp_path / "out")) == 2
    said = capsys.readouterr().err.strip()
    assert message in " ".join(said.split())
    assert not (tmp_path / "out").exists()


def test_other_files_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.nc").write_text("no data")
    assert _run("winds", str(tmp_path / "text.nc"), "--at", "30,120") == 2
    assert "text.nc: cannot be read" in capsys.readouterr().err


def test_grib_gives_the_same_profile(tmp_path: Path) -> None:
    eccodes = pytest.importorskip("eccodes")  # 180 MB of libraries: not among the test requirements
    data = _data(("u", "v", "gh"), latitudes=[40.0, 30.0], longitudes=[120.0, 130.0]).isel(valid_time=0)
    path = tmp_path / "gfs.grib2"
    with path.open("wb") as file:
        for name in ("u", "v", "gh"):
            for k, pressure in enumerate(_PRESSURES_hPa):
                message = eccodes.codes_grib_new_from_samples("regular_ll_pl_grib2")
                keys = {
                    "Ni": 2,
                    "Nj": 2,
                    "latitudeOfFirstGridPointInDegrees": 40.0,
                    "longitudeOfFirstGridPointInDegrees": 120.0,
                    "latitudeOfLastGridPointInDegrees": 30.0,
                    "longitudeOfLastGridPointInDegrees": 130.0,
                    "iDirectionIncrementInDegrees": 10.0,
                    "jDirectionIncrementInDegrees": 10.0,
                    "dataDate": 20260601,
                    "dataTime": 600,
                    "step": 6,
                    "shortName": name,
                    "typeOfLevel": "isobaricInhPa",
                    "level": int(pressure),
                    "bitsPerValue": 24,
                }
                for key, value in keys.items():
                    eccodes.codes_set(message, key, value)
                eccodes.codes_set_values(message, data[name].values[k].ravel())
                eccodes.codes_write(message, file)
    assert _run("winds", str(path), "--at", "36.5,126.25", "--out", str(tmp_path / "out")) == 0
    (written,) = (tmp_path / "out").iterdir()
    assert written.name == "gfs-20260601T1200.csv"  # valid six hours after 06:00
    np.testing.assert_allclose(_read(written)[:, 2], [5.0 + 18.25 + 31.5625 + 10.0 * k for k in range(3)], atol=2e-3)


def test_without_the_packages_one_line_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from maxq.tools import simrun_winds  # noqa: PLC0415  # its import is the point

    file = _file(tmp_path, _data(("u", "v", "z"), latitudes=[30.0, 40.0], longitudes=[120.0, 130.0]))
    monkeypatch.setitem(__import__("sys").modules, "xarray", None)
    with pytest.raises(CommandError, match=r"pip install 'maxq\[winds\]'"):
        simrun_winds.execute([str(file)], place=(30.0, 120.0))


def test_axes_that_are_not_those_of_winds_are_rejected(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Both files once ended in an internal error; mutants of bytes have such axes."""
    data = _data(("u", "v", "z"), latitudes=[40.0, 30.0], longitudes=[120.0, 130.0])
    undated = data.assign_coords(valid_time=[0, 6])
    flat = data.assign(z=data["z"].isel(pressure_level=0, drop=True))
    for given, says in (
        (undated, "valid_time: has times that are no dates"),
        (flat, "z is over the axes valid_time, "),
    ):
        file = _file(tmp_path, given)
        assert _run("winds", str(file), "--at", "36.5,126.25", "--out", str(tmp_path / "out")) == 2
        said = capsys.readouterr().err
        assert says in said
        assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()
