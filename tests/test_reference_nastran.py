"""Normal modes as NASTRAN's files hold them; the samples were written by pyNastran (tests/data/nastran)."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from flightkit import Parts, scenario_of, toml, with_stage
from pydantic_core import PydanticCustomError

from maxq.sim.scenario.errors import ScenarioError
from maxq.sim.scenario.loader import load_scenario, load_scenario_text
from maxq.sim.scenario.nastran import read_nastran, spatial_columns

DATA = Path(__file__).parent / "data" / "nastran"
FREQUENCIES_HZ = (9.0, 9.45, 24.80885, 26.04929, 60.0, 70.0)
MASSES_KG = (1050.0, 1050.0, 1050.0, 1050.0, 400.0, 2100.0)
X = np.linspace(0.0, 14.0, 15)


@pytest.mark.parametrize("name", ["beam.op2", "beam.f06"])
def test_modes_of_a_beam(name: str) -> None:
    modes = read_nastran(DATA / name)
    np.testing.assert_allclose(modes.frequency_hz, FREQUENCIES_HZ, rtol=1e-6)
    np.testing.assert_allclose(modes.generalized_mass_kg, MASSES_KG, rtol=1e-6)
    np.testing.assert_allclose(modes.position_m[:15], np.stack([X, 0 * X, 0 * X], axis=1))
    assert modes.position_m[15].tolist() == [3.0, 1.5, 0.0]
    # the first pair at the nose: 1 across, turned by 0.5 rad from z towards y
    np.testing.assert_allclose(modes.shape[0, 0, :3], [0.0, np.sin(0.5), np.cos(0.5)], atol=1e-6)
    np.testing.assert_allclose(modes.shape[1, 0, :3], [0.0, np.cos(0.5), -np.sin(0.5)], atol=1e-6)
    np.testing.assert_allclose(modes.shape[4, :15, 3], np.cos(np.pi * X / 14.0), atol=1e-6)  # torsion
    np.testing.assert_allclose(modes.shape[5, :15, 0], np.cos(np.pi * X / 14.0), atol=1e-6)  # axial


@pytest.mark.parametrize("name", ["beam.op2", "beam.f06"])
def test_a_vehicle_names_such_a_file(name: str, tmp_path: Path) -> None:
    """Read in body axes: x forward, z down; slopes are those of the shapes, or the table would be refused."""
    for file in DATA.iterdir():
        shutil.copy(file, tmp_path)
    tree = with_stage(scenario_of(Parts()), spatial_modes={"table": name, "damping_ratio": [0.005] * 6})
    (tmp_path / "beam.toml").write_text("\n".join(f"{key} = {toml(value)}" for key, value in tree.items()))
    loaded = load_scenario(tmp_path / "beam.toml")
    given = loaded.vehicle.stage[0].spatial_modes
    assert given is not None
    modes = given.modes
    assert loaded.doubts == ()
    assert modes.station_m.tolist() == X.tolist()
    np.testing.assert_allclose(modes.displacement[0, 0, 0], [0.0, np.sin(0.5), -np.cos(0.5)], atol=1e-6)
    for plane in modes.lateral():
        by_differences = np.gradient(plane.phi[0, 0], X, edge_order=2)
        np.testing.assert_allclose(plane.slope_pm[0, 0], by_differences, atol=0.01)
    np.testing.assert_allclose(modes.rotation_pm[0, 4, :, 0], -np.cos(np.pi * X / 14.0), atol=1e-6)
    assert load_scenario_text(loaded.as_flown).scenario == loaded.scenario
    (tmp_path / name).unlink()
    with pytest.raises(ScenarioError, match="no such file"):
        load_scenario(tmp_path / "beam.toml")


def test_several_states_of_mass_make_a_table_over_time() -> None:
    modes = read_nastran(DATA / "beam.op2")
    columns = spatial_columns({0.0: modes, 59.0: modes}, count=2)
    assert sorted(set(columns["time_s"])) == [0.0, 59.0]
    assert len(columns["mode"]) == 2 * 2 * 15
    assert max(columns["mode"]) == 2.0


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [
        (lambda data: data[:200], "is not an op2 file"),
        (lambda data: data[:5000], "holds no eigenvectors|is not an op2 file"),
        (lambda data: b"hello, world", "is not an op2 file"),
        (lambda data: data.replace(b"LAMA    ", b"LAXX    "), "holds no eigenvalues"),
        (lambda data: data.replace(b"   GEOM1", b"   GEOMX"), "holds no positions of grid points"),
        (lambda data: data[:3000] + data[3004:], "is not an op2 file"),
    ],
)
def test_a_file_that_holds_no_modes_is_refused(spoil, problem: str, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]  # lambdas
    path = tmp_path / "spoilt.op2"
    path.write_bytes(spoil((DATA / "beam.op2").read_bytes()))
    with pytest.raises(PydanticCustomError) as refused:
        read_nastran(path)
    assert re.search(problem, str(refused.value.context["problem"]))


def test_positions_may_stand_in_a_file_beside(tmp_path: Path) -> None:
    data = (DATA / "beam.op2").read_bytes().replace(b"   GEOM1", b"   GEOMX")
    (tmp_path / "beam.op2").write_bytes(data)
    (tmp_path / "beam.dat").write_text(
        "GRID,101,,0.,0.,0.\nGRID*                102                           1.5+0       0.\n*       0.\n"
    )
    assert read_nastran(tmp_path / "beam.op2").position_m.tolist() == [[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]]


def test_pages_that_msc_nastran_printed() -> None:
    """A cantilever's first bending mode, its torsion and its axial mode, from a run of MSC.Nastran 2005."""
    modes = read_nastran(DATA / "msc2005_beam.f06")
    assert modes.frequency_hz.tolist() == [456.6603, 3554.923, 4507.487]
    assert modes.generalized_mass_kg.tolist() == [8.719168e-3, 3.668128e-3, 1.334596e-2]
    assert modes.position_m.tolist() == [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [10.0, 0.0, 0.0]]
    x, bending = modes.position_m[:, 0], modes.shape[0]
    for across, about, sign in ((1, 5, 1.0), (2, 4, -1.0)):  # rotations are the slopes of a beam: R3 = T2', R2 = -T3'
        by_polynomial = np.polynomial.Polynomial.fit(x[:3], bending[:3, across], 2).deriv()(x[1])
        assert sign * bending[1, about] == pytest.approx(by_polynomial, rel=0.1)
    assert modes.shape[1, :, 3].tolist() == [0.0, 0.1014664, 0.2029328, 1.0]
    assert modes.shape[2, :, 0].tolist() == [0.0, 0.142823, 0.2827877, 1.0]
