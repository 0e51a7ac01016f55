"""Normal modes are read from NASTRAN's files; pyNastran wrote the samples (tests/data/nastran)."""

from __future__ import annotations

import re
import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from flightkit import Parts, scenario_of, toml, with_stage
from pydantic_core import PydanticCustomError

from maxq import LoadedScenario, ScenarioError
from maxq.sim.scenario.loader import load_scenario, load_scenario_text
from maxq.sim.vehicle.engine.packing import Mount
from maxq.sim.vehicle.modes.nastran import read_nastran, spatial_columns
from maxq.sim.vehicle.modes.packing import Places, _softening
from maxq.sim.vehicle.modes.shapes import ModeShapes

DATA = Path(__file__).parent / "data" / "nastran"
FREQUENCIES_HZ = (9.0, 9.45, 24.80885, 26.04929, 60.0, 70.0)
MASSES_KG = (1050.0, 1050.0, 1050.0, 1050.0, 400.0, 2100.0)
X = np.linspace(0.0, 14.0, 15)


@pytest.mark.parametrize("name", ["beam.op2", "beam.f06"])
def test_modes_of_a_beam(name: str, tmp_path: Path) -> None:
    if name == "beam.f06":  # it has no echo; the op2 has its grid points itself
        shutil.copy(DATA / "beam.bdf", tmp_path)
    modes = read_nastran(shutil.copy(DATA / name, tmp_path))
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
    """The axes are body axes (x forward, z down), and slopes other than the shapes' are rejected."""
    for file in DATA.iterdir():
        shutil.copy(file, tmp_path)
    tree = with_stage(scenario_of(Parts()), spatial_modes={"table": name, "damping_ratio": [0.005] * 6})
    (tmp_path / "beam.toml").write_text("\n".join(f"{key} = {toml(value)}" for key, value in tree.items()))
    loaded = load_scenario(tmp_path / "beam.toml")
    given = loaded.vehicle.stage[0].spatial_modes
    assert given is not None
    modes = given.modes
    assert loaded.warnings == (
        "vehicle.stage.0.spatial_modes.table: mass_forward_kg is 0 everywhere: the axial load does not soften these "
        "modes, and their generalised masses and orthogonality are unchecked",
    )
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


def test_numbers_that_overflow_are_refused_without_a_warning_of_numpy(tmp_path: Path) -> None:
    shutil.copy(DATA / "beam.bdf", tmp_path)
    text = (DATA / "beam.f06").read_text()
    (tmp_path / "beam.f06").write_text(text.replace("1.000000E+00", "1.0000E+200", 1))
    assert "1.000000E+00" in text
    with pytest.raises(PydanticCustomError, match="holds a number that is not finite, or too large"):
        read_nastran(tmp_path / "beam.f06")


def test_positions_may_stand_in_a_file_beside(tmp_path: Path) -> None:
    data = (DATA / "beam.op2").read_bytes().replace(b"   GEOM1", b"   GEOMX")
    (tmp_path / "beam.op2").write_bytes(data)
    (tmp_path / "beam.dat").write_text(
        "GRID,101,,0.,0.,0.\nGRID*                102                           1.5+0       0.\n*       0.\n"
    )
    assert read_nastran(tmp_path / "beam.op2").position_m.tolist() == [[0.0, 0.0, 0.0], [1.5, 0.0, 0.0]]


def test_pages_that_msc_nastran_printed() -> None:
    """A cantilever's first bending, torsion and axial modes are read from a run of MSC.Nastran 2005."""
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


GRIDS = "".join(f"GRID,{101 + n},,{x:g},0.,0.\n" for n, x in enumerate(X)) + "GRID,900,,3.,1.5,0.\n"
LUMPS_KG = 300.0 * np.where((X == 0.0) | (X == 14.0), 0.5, 1.0)  # of the beam's 4200 kg
ROLLING_KGM2 = LUMPS_KG / 4200.0 * 800.0  # under the torsion's cosine half of it: 400 kg m2


def conm2(factor: float = 1.0) -> str:
    """Return CONM2 cards in free, small (continued) and large field; part of one mass is off the axis."""
    out = []
    for n, (kg, about_x) in enumerate(zip(factor * LUMPS_KG, factor * ROLLING_KGM2, strict=True)):
        if n == 1:
            out.append(f"CONM2   {501:8d}{102:8d}        {kg:8g}{0.0:8g}{0.0:8g}{0.0:8g}        +")
            out.append(f"+       {about_x:8.5f}")
        elif n == 2:
            out.append(f"CONM2*  {502:16d}{103:16d}{0:16d}{kg:16g}*")
            out.append(f"*       {0.0:16g}{0.0:16g}{0.0:16g}{'':16s}*")
            out.append(f"*       {about_x:16g}")
        elif n == 3:  # 10 kg of it at the point 1.5 m off the axis
            out.append(f"CONM2,503,104,,{kg - 10.0 * factor:.9g},,,,,+\n+,{about_x - 22.5 * factor:.9g}")
            out.append(f"CONM2,599,900,0,{10.0 * factor:g}")
        else:
            out.append(f"CONM2,{500 + n},{101 + n},,{kg:g},,,,,+\n+,{about_x:.9g}")
    return "\n".join(out) + "\n"


def beside(folder: Path, bulk: str) -> Path:
    data = (DATA / "beam.op2").read_bytes().replace(b"   GEOM1", b"   GEOMX")
    (folder / "beam.op2").write_bytes(data)
    (folder / "beam.bdf").write_text(bulk)
    return folder / "beam.op2"


def flown_with(file: Path) -> LoadedScenario:
    tree = with_stage(scenario_of(Parts()), spatial_modes={"table": file.name, "damping_ratio": [0.005] * 6})
    (file.parent / "beam.toml").write_text("\n".join(f"{key} = {toml(value)}" for key, value in tree.items()))
    return load_scenario(file.parent / "beam.toml")


def test_lumped_masses_soften_the_modes_and_are_checked(tmp_path: Path) -> None:
    """A uniform beam of 4200 kg in lumps has 300 kg/m forward of a station, and the softening of the integral."""
    loaded = flown_with(beside(tmp_path, GRIDS + conm2()))
    assert loaded.warnings == ()
    given = loaded.vehicle.stage[0].spatial_modes
    assert given is not None
    modes = given.modes
    np.testing.assert_allclose(modes.mass_forward_kg[0], 300.0 * X, atol=1e-6)
    assert modes.mass_kg is not None
    assert modes.roll_inertia_kgm2 is not None
    np.testing.assert_allclose(modes.mass_kg[0], LUMPS_KG, rtol=1e-6)
    np.testing.assert_allclose(modes.roll_inertia_kgm2[0], ROLLING_KGM2, rtol=1e-5)
    # of the first pair together, along y and z: integral of 300 x phi'^2, phi the beam's shape by its own slopes
    planes, places = modes.lateral(), Places((Mount(14.0, 1.0),), 0.0, (), (), mass_kg=(4200.0,))
    softening = sum(_softening(plane, ModeShapes(plane), places) for plane in planes)[0]
    fine, pair = np.linspace(0.0, 14.0, 20001), sum(plane.slope_pm[0, 0] ** 2 for plane in planes)
    root = 4.730040744862704 / 14.0
    k = (np.cosh(14.0 * root) - np.cos(14.0 * root)) / (np.sinh(14.0 * root) - np.sin(14.0 * root))
    slope = root / 2.0 * (np.sinh(root * fine) - np.sin(root * fine) - k * (np.cosh(root * fine) + np.cos(root * fine)))
    assert pair[0] == pytest.approx(slope[0] ** 2, rel=1e-5)
    assert softening[0, 0] == pytest.approx(np.trapezoid(300.0 * fine * slope**2, fine), rel=2e-3)


@pytest.mark.parametrize("bulk", [GRIDS, GRIDS + conm2(0.3)], ids=["none", "a part"])
def test_masses_that_are_not_all_are_warned_of(bulk: str, tmp_path: Path) -> None:
    assert (
        "mass_forward_kg is 0 everywhere: the axial load does not soften"
        in flown_with(beside(tmp_path, bulk)).warnings[0]
    )


def test_masses_that_fit_badly_are_warned_of(tmp_path: Path) -> None:
    warned_of = flown_with(beside(tmp_path, GRIDS + conm2(1.3))).warnings
    assert "with the masses at the stations the shapes' products are 1.3" in warned_of[0]


@pytest.mark.parametrize(
    "bulk",
    [
        GRIDS.replace("GRID,104,,3,0.,0.", "GRID,104,,3,0.,0.,7"),
        GRIDS + "GRDSET,,,,,,7\n",
        GRIDS.replace(
            "GRID,104,,3,0.,0.\n", "GRID*   " + f"{104:16d}{0:16d}{3.0:16g}{0.0:16g}*\n*       {0.0:16g}{7:16d}\n"
        ),
    ],
    ids=["field 7", "default", "large field"],
)
def test_displacements_in_a_system_of_their_own_are_refused(bulk: str, tmp_path: Path) -> None:
    with pytest.raises(PydanticCustomError) as refused:
        read_nastran(beside(tmp_path, bulk))
    assert "moves in coordinate system 7 (CD)" in str(refused.value.context["problem"])


def test_displacement_systems_in_the_op2(tmp_path: Path) -> None:
    """Displacement systems are rejected on the axis; a point off the axis is omitted."""
    data = (DATA / "beam.op2").read_bytes()
    for grid, place, left in ((104, (3.0, 0.0, 0.0), None), (900, (3.0, 1.5, 0.0), 15)):
        card = struct.pack("<ii3f3i", grid, 0, *place, 0, 0, 0)
        assert data.count(card) == 1
        path = tmp_path / "turned.op2"
        path.write_bytes(data.replace(card, struct.pack("<ii3f3i", grid, 0, *place, 7, 0, 0)))
        if left is None:
            with pytest.raises(PydanticCustomError) as refused:
                read_nastran(path)
            assert "moves in coordinate system 7 (CD)" in str(refused.value.context["problem"])
        else:
            assert len(read_nastran(path).position_m) == left


def test_lumped_masses_in_the_op2(tmp_path: Path) -> None:
    """Block GEOM2 has the layout of pyNastran's writer: record 1501, 15, 64 of 13 words per card."""
    cards = b"".join(
        struct.pack("<3i10f", 500 + n, 101 + n, 0, kg, 0.0, 0.0, 0.0, about_x, 0.0, 0.0, 0.0, 0.0, 0.0)
        for n, (kg, about_x) in enumerate(zip(LUMPS_KG, ROLLING_KGM2, strict=True))
    )
    data = (DATA / "beam.op2").read_bytes()
    announced = [found.start() for found in re.finditer(rb"\x04\0{3}\x02\0{3}\x04\0{3}\x08\0{3}[ A-Z0-9]{8}", data)]
    begin = next(at for at in announced if data[at + 16 : at + 24].strip() == b"GEOM1")
    end = announced[announced.index(begin) + 1]
    block, old = data[begin:end].replace(b"GEOM1", b"GEOM2"), data.index(struct.pack("<3i", 4501, 45, 1))
    (size,) = struct.unpack_from("<i", data, old - 4)
    record = struct.pack("<3i", 1501, 15, 64) + cards
    was = data[old - 12 : old + size + 4]
    now = struct.pack("<3i", len(record) // 4, 4, len(record)) + record + struct.pack("<i", len(record))
    path = tmp_path / "lumps.op2"
    path.write_bytes(data[:end] + block.replace(was, now) + data[end:])
    np.testing.assert_allclose(read_nastran(path).lumped[:, 3], LUMPS_KG)
