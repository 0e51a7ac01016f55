"""Impossible mode tables are rejected, unlikely ones give a warning, and good ones pass silently."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import petrelkit as petrel
import pytest
from flightkit import Parts, Tree, load, scenario_of, with_stage

from maxq import ScenarioError
from maxq.sim.scenario.loader import load_scenario

LENGTH_M = 14.0
STATIONS = np.linspace(0.0, LENGTH_M, 29)
ROOTS = (4.730040744862704, 7.853204624095838, 10.995607838001671)


def beam(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the shape and slope of mode n of a uniform free-free beam, 1 at the nose (Blevins, table 8-1)."""
    root, x = ROOTS[n], STATIONS / LENGTH_M
    k = (np.cosh(root) - np.cos(root)) / (np.sinh(root) - np.sin(root))
    phi = np.cosh(root * x) + np.cos(root * x) - k * (np.sinh(root * x) + np.sin(root * x))
    slope = np.sinh(root * x) - np.sin(root * x) - k * (np.cosh(root * x) + np.cos(root * x))
    return phi / 2.0, root / LENGTH_M * slope / 2.0


def rows(
    change: Callable[[dict[str, float]], None] = lambda row: None, times: tuple[float, ...] = (0.0, 50.0)
) -> list[Tree]:
    """Return rows of a uniform beam of 4200 kg at given times; `change` alters a row."""
    out = []
    for time_s in times:
        for n in range(3):
            phi, slope = beam(n)
            for x, value, turn in zip(STATIONS, phi, slope, strict=True):
                row = {
                    "time_s": time_s,
                    "mode": n + 1,
                    "frequency_hz": 9.0 * (ROOTS[n] / ROOTS[0]) ** 2,
                    "generalized_mass_kg": 4200.0 / 4.0,
                    "station_m": x,
                    "phi": value,
                    "slope_pm": turn,
                    "mass_forward_kg": 4200.0 * x / LENGTH_M,
                }
                change(row)
                out.append(row)
    return out


def planar(table: list[Tree]) -> Tree:
    return with_stage(scenario_of(Parts()), bending={"pitch": table, "damping_ratio": [0.005] * 3})


def spatial(table: list[Tree], weight: float = 1.0) -> Tree:
    turned = []
    for row in table:
        phi, slope = row.pop("phi"), row.pop("slope_pm")
        end = 0.5 if row["station_m"] in (0.0, LENGTH_M) else 1.0
        mass = {"mass_kg": weight * end * 4200.0 / 28.0}
        shape = {"phi_x": 0.0, "phi_y": -0.6 * phi, "phi_z": 0.8 * phi, "theta_x_pm": 0.0}
        turned.append(row | shape | {"theta_y_pm": 0.8 * slope, "theta_z_pm": 0.6 * slope} | mass)
    return with_stage(scenario_of(Parts()), spatial_modes={"table": turned, "damping_ratio": [0.005] * 3})


def test_the_modes_of_a_beam_are_not_warned_of() -> None:
    for tree in (planar(rows()), spatial(rows())):
        assert load(tree).warnings == ()
    assert load_scenario("nominal").warnings == ()


def flip_slope(row: dict[str, float]) -> None:
    row["slope_pm"] = -row["slope_pm"]


def flip_late(row: dict[str, float]) -> None:
    if row["time_s"] > 0.0 and row["mode"] == 2:
        row["phi"], row["slope_pm"] = -row["phi"], -row["slope_pm"]


def swap_late(row: dict[str, float]) -> None:
    if row["time_s"] > 0.0 and row["mode"] > 1:
        row["mode"] = 5 - row["mode"]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (flip_slope, "slope of mode 1 at time_s = 0 has the opposite sign"),
        (flip_late, "mode 2 changes its sign between time_s = 0 and 50"),
        (swap_late, "mode 2 becomes mode 3 between time_s = 0 and 50"),
    ],
)
def test_impossible_shapes_are_refused(change: Callable[[dict[str, float]], None], problem: str) -> None:
    for make in (planar, spatial):
        with pytest.raises(ScenarioError, match=problem):
            load(make(rows(change)))


@pytest.mark.parametrize("share", [1.0, 0.05], ids=["as large", "a twentieth"])
@pytest.mark.parametrize("key", ["theta_z_pm", "theta_y_pm"])
def test_a_flipped_slope_in_one_of_two_planes_is_refused(key: str, share: float) -> None:
    """In a mode that bends both planes, the larger component does not hide a flipped slope of the other."""
    tree = spatial(rows())
    small, large = ("y", "z") if key == "theta_z_pm" else ("z", "y")
    for row in tree["vehicle"]["stage"][0]["spatial_modes"]["table"]:
        phi, slope = row["phi_z"] / 0.8, row["theta_y_pm"] / 0.8
        lateral = {large: phi, small: share * phi}
        slopes = {large: slope, small: -share * slope}
        row.update(phi_y=lateral["y"], phi_z=lateral["z"], theta_y_pm=slopes["z"], theta_z_pm=-slopes["y"])
        del row["mass_kg"]
        row["generalized_mass_kg"] *= 1.0 + share**2
    with pytest.raises(ScenarioError, match="opposite sign of the shape's derivative"):
        load(tree)


def test_modes_that_twist_need_no_inertia_about_the_axis() -> None:
    """With masses alone, torsion is not checked; with a wrong inertia it is rejected."""
    tree = spatial(rows())
    table = tree["vehicle"]["stage"][0]["spatial_modes"]["table"]
    for row in table:
        if row["mode"] == 3:
            twist = np.cos(np.pi * row["station_m"] / LENGTH_M)
            row.update(dict.fromkeys(("phi_y", "phi_z", "theta_y_pm", "theta_z_pm"), 0.0) | {"theta_x_pm": twist})
    assert load(tree).warnings == ()
    for row in table:
        row["roll_inertia_kgm2"] = row["mass_kg"] * 1e-4
    with pytest.raises(ScenarioError, match="of the generalised masses"):
        load(tree)


def test_masses_at_the_stations_must_fit() -> None:
    with pytest.raises(ScenarioError, match=r"are 3\.02 to 3\.06 of the generalised masses"):
        load(spatial(rows(), weight=3.0))
    assert "are 1.21 to 1.22 of the generalised masses" in load(spatial(rows(), weight=1.2)).warnings[0]


def test_a_warning_names_the_modes_that_are_not_orthogonal() -> None:
    """For mode 3 with 0.4 of mode 1, the product is 0.4 and mode 3 has 1.16 times its mass, apart from lumping."""
    tree = spatial(rows())
    table = tree["vehicle"]["stage"][0]["spatial_modes"]["table"]
    first = [row for row in table if row["mode"] == 1]
    for row, other in zip([row for row in table if row["mode"] == 3], first, strict=True):
        for key in ("phi_y", "phi_z", "theta_y_pm", "theta_z_pm"):
            row[key] += 0.4 * other[key]
    (warning,) = load(tree).warnings
    assert "are 1.01 to 1.19 of the generalised masses, and up to 0.42 between modes (1 and 3 at 0 s)" in warning


def halve(key: str, factor: float) -> Callable[[dict[str, float]], None]:
    def change(row: dict[str, float]) -> None:
        row[key] = factor * row[key]

    return change


def late_frequency(row: dict[str, float]) -> None:
    row["frequency_hz"] *= 1.5 if row["time_s"] > 0.0 else 1.0


def falling(row: dict[str, float]) -> None:
    row["frequency_hz"] = 1000.0 / row["frequency_hz"]


@pytest.mark.parametrize(
    ("change", "warning"),
    [
        (halve("slope_pm", 0.5), "deviates by 50 % from the shape's derivative"),
        (halve("generalized_mass_kg", 1e-3), "at 0 s is 1.05 kg, where shape and mass_forward_kg give"),
        (late_frequency, "Hz between 0 and 50 s"),
        (falling, "frequencies of modes 1 and 2 at 0 s are not in rising order"),
    ],
)
def test_unlikely_tables_are_warned_of(change: Callable[[dict[str, float]], None], warning: str) -> None:
    assert any(warning in text for text in load(planar(rows(change))).warnings)


MASSES = {"time_s": [0.0, 20.0, 50.0], "mass_kg": [5000.0, 4000.0, 2600.0], "x_cg_m": [7.0, 6.8, 6.5]}
MASSES |= {
    f"I{axis}{axis}_kgm2": [moment, 0.9 * moment, 0.8 * moment]
    for axis, moment in zip("xyz", (800.0, 6e4, 6e4), strict=True)
}


@pytest.mark.parametrize("make", [planar, spatial])
@pytest.mark.parametrize("interpolation", ["pchip", "linear"])
def test_modes_over_mass_are_those_over_time(make: Callable[[list[Tree]], Tree], interpolation: str) -> None:
    """Rows over the stage's mass fly to the bit like rows over the times of those masses."""
    section, keys = ("bending", ("pitch", "yaw")) if make is planar else ("spatial_modes", ("table",))
    given = {}
    for over in ("time_s", "total_mass_kg"):
        tree = make(rows(late_frequency, (0.0, 20.0, 50.0)))
        stage = tree["vehicle"]["stage"][0]
        stage |= {"interpolation": interpolation, "mass": {"table": MASSES}}
        for key in keys:
            for row in stage[section].get(key, ()):
                row.setdefault(
                    over, MASSES["mass_kg"][MASSES["time_s"].index(row.pop("time_s"))] if over != "time_s" else 0.0
                )
        given[over] = load(tree)
    ours, wanted = (given[over].vehicle.stage[0] for over in ("total_mass_kg", "time_s"))
    for (_, a), (_, b) in zip(ours.mode_tables(), wanted.mode_tables(), strict=True):
        assert a.time_s.tolist() == [0.0, 20.0, 50.0]
        assert a.frequency_hz.tobytes() == b.frequency_hz.tobytes()
        assert a.moved.tobytes() == b.moved.tobytes()
    assert given["total_mass_kg"].as_flown == given["time_s"].as_flown
    assert given["total_mass_kg"].warnings == given["time_s"].warnings


def test_a_mass_between_the_rows_is_met_on_the_joined_curve() -> None:
    """The time is half-way on a straight fall, and the end of an interval of constant mass before ignition."""
    tree = planar([])
    table = rows(times=(0.0, 1.0, 2.0))
    for row in table:
        row["total_mass_kg"] = {0.0: 4200.0, 1.0: 3600.0, 2.0: 3000.0}[row.pop("time_s")]
    tree["vehicle"]["stage"][0]["bending"]["pitch"] = table
    inertia = [[800.0, 0.0, 0.0], [0.0, 6e4, 0.0], [0.0, 0.0, 6e4]]
    constants = {"mass_kg": 4200.0, "x_cg_m": 7.0, "inertia_kgm2": inertia, "mass_flow_kgps": 24.0, "burn_s": 50.0}
    tree["vehicle"]["stage"][0] |= {"mass": constants, "ignition_s": 5.0}
    assert load(tree).vehicle.stage[0].mode_tables()[0][1].time_s.tolist() == [5.0, 30.0, 55.0]


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (
            lambda row: row.update(total_mass_kg=5000.0),
            "column time_s cannot be combined with total_mass_kg|column total_mass_kg",
        ),
        (lambda row: row.update(total_mass_kg=9000.0 - row.pop("time_s")), "the stage never has this mass"),
        (lambda row: row.update(total_mass_kg=4000.0 + row.pop("time_s")), "total_mass_kg must not rise"),
    ],
)
def test_modes_over_mass_that_are_refused(change: Callable[[dict[str, float]], None], problem: str) -> None:
    with pytest.raises(ScenarioError, match=problem):
        load(planar(rows(change)))


def test_the_second_vehicle_is_checked_likewise(tmp_path: Path) -> None:
    """Petrel's checks find flipped slopes, the length of another vehicle, and a node before liftoff."""
    lines = (petrel.folder() / "vehicle" / "stage1_modes.csv").read_text().splitlines()
    first = next(n for n, line in enumerate(lines) if line.startswith("time_s"))
    column = lines[first].split(",").index("slope_pm")
    for n, line in enumerate(lines[first + 1 :], start=first + 1):
        cells = line.split(",")
        cells[column] = repr(-float(cells[column]))
        lines[n] = ",".join(cells)
    flipped = tmp_path / "flipped.csv"
    flipped.write_text("\n".join(lines) + "\n")
    with pytest.raises(ScenarioError, match=r"slope of mode 1 .* has the opposite sign"):
        petrel.scenario(f"vehicle.stage.0.bending.pitch='{flipped}'")
    found = petrel.scenario("vehicle.reference.length_m=180.0").warnings
    assert any("reference.length_m = 180" in str(warning) for warning in found)
    said = "operating point at 0 s: the vehicle is held down; allowed are times under thrust: liftoff to "
    with pytest.raises(ValueError, match=said):
        petrel.nodes(0.0)
