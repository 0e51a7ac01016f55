"""Pictures: equal when what they show is equal, and no notebook's settings are touched."""

from __future__ import annotations

from pathlib import Path

import matplotlib as mpl

from maxq.tools.plots.palette import ON_LIGHT
from maxq.tools.plots.style import STYLE, curve, drawing, label, save, sheet


def test_files_are_equal_when_drawn_twice_and_left_whole(tmp_path: Path) -> None:
    files = []
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        with drawing():
            figure, places = sheet(1, 2)
            places[0].plot([0.0, 1.0], [0.0, 2.0], **curve(1), label="rise")
            places[0].legend()
            label(places[1], "time, s", "angle, deg", "empty")
            files.append(save(figure, tmp_path / name / "picture"))
    assert [path.name for path in files[0]] == ["picture.svg", "picture.png"]
    for one, other in zip(*files, strict=True):
        assert one.read_bytes() == other.read_bytes()
    assert "<dc:date>" not in files[0][0].read_text()
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == ["picture.png", "picture.svg"]


def test_style_ends_with_the_drawing() -> None:
    before = mpl.rcParams["font.size"]
    with drawing():
        assert mpl.rcParams["font.size"] == STYLE["font.size"]
    assert mpl.rcParams["font.size"] == before


def test_formats_can_be_chosen(tmp_path: Path) -> None:
    with drawing(("png",)):
        assert save(sheet()[0], tmp_path / "one") == [tmp_path / "one.png"]


def test_every_setting_of_the_style_is_known() -> None:
    assert set(STYLE) <= set(mpl.rcParams)


def test_curves_differ_in_more_than_colour() -> None:
    seen = [curve(k) for k in range(len(ON_LIGHT))]
    assert len({str(c["linestyle"]) for c in seen}) == len({str(c["color"]) for c in seen}) == len(ON_LIGHT)
