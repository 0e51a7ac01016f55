"""maxq works from Python (api/): tables, files and plots take one line each."""

from __future__ import annotations

import csv
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import maxq
from maxq import Flight, LoadedCampaign, LoadedScenario, Log
from maxq.tools import simreplay


@pytest.fixture(scope="module")
def flight() -> Flight:
    return maxq.fly("nominal", "run.duration_s=1.5")


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_what_is_loaded_and_flown_says_so_in_one_line(flight: Flight) -> None:
    scenario, campaign = maxq.load("nominal"), maxq.load("campaigns/first")
    assert isinstance(scenario, LoadedScenario)
    assert isinstance(campaign, LoadedCampaign)
    assert re.fullmatch(r"<LoadedCampaign first \(.*\): 100 runs>", repr(campaign))
    assert repr(scenario).startswith("<LoadedScenario nominal (")
    assert repr(flight) == "<Flight nominal: duration at 1.500 s, 9 of 9 requirements met>"
    shown = flight._repr_html_()
    assert shown.count("<tr>") == shown.count("</tr>") > 12
    assert "<td>q alpha</td><td>met</td>" in shown
    with pytest.raises(ValueError, match="overrides go with a scenario's name"):
        maxq.fly(scenario, "run.duration_s=1")


def test_a_frame_has_each_channel_over_its_times(flight: Flight) -> None:
    frame = flight.to_pandas("altitude_m", "mach")
    assert list(frame.columns) == ["altitude_m", "mach"]
    assert frame.index.name == "time_s"
    assert frame["altitude_m"].dropna().to_numpy() == pytest.approx(flight["altitude_m"], abs=0.0)
    assert frame["mach"].dropna().index.to_numpy() == pytest.approx(flight.time_s("mach"), abs=0.0)
    every = flight.to_pandas()
    assert set(every.columns) == set(flight.channels)
    assert every["mach"].count() == len(flight["mach"])


def test_a_dataset_has_units_and_the_same_numbers(flight: Flight) -> None:
    pytest.importorskip("xarray")
    data = flight.to_xarray("altitude_m", "mach")
    assert data["altitude_m"].attrs["units"] == "m"
    assert data["mach"].dropna("time_s").to_numpy() == pytest.approx(flight["mach"], abs=0.0)


def test_topics_go_by_name_in_flights_and_logs(flight: Flight) -> None:
    maxq.fly("nominal", "run.duration_s=0.2", folder="out")
    log = maxq.read("out")
    assert isinstance(log, Log)
    assert repr(log).startswith("<Log out/flight.mcap: nominal, 0.2")
    assert log.topics == flight.topics
    assert set(log.topic("/air")) == set(flight.topic("/air")) == set(flight.to_pandas("/air").columns)
    assert log.to_pandas("mach")["mach"].to_numpy() == pytest.approx(log["mach"], abs=0.0)
    with pytest.raises(KeyError, match="no channel or topic nosuch; topics: /"):
        flight.to_pandas("nosuch")
    with pytest.raises(KeyError, match=r"no channel or topic alfa_deg; did you mean alpha_deg\?"):
        flight["alfa_deg"]
    with pytest.raises(KeyError, match="mach: flown without a log"):
        maxq.record(maxq.load("nominal", "run.duration_s=0.1"), "bare")["mach"]
    maxq.replay("out", save="out.rrd")
    assert Path("out.rrd").stat().st_size > 10_000


def test_a_csv_file_holds_every_bit(flight: Flight) -> None:
    """With two rates, the slower channel is empty between its times, and every bit is kept."""
    slow = next(n for n in flight.channels if flight.table.topic(n).group != flight.table.topic("mach").group)
    path = flight.to_csv("flight.csv", "mach", slow)
    with path.open(newline="") as file:
        head, *rows = csv.reader(file)
    assert sorted(head) == sorted(["time_s", "mach", slow])
    for name in ("mach", slow):
        at = head.index(name)
        there = [(float(row[0]), float(row[at])) for row in rows if row[at]]
        assert np.array_equal([t for t, _ in there], flight.time_s(name))
        assert np.array_equal([x for _, x in there], flight[name])
    assert pd.read_csv(path)[slow].isna().any() != (len(flight[slow]) == len(rows))


def test_a_plot_has_a_panel_a_unit_and_no_text_over_another(flight: Flight) -> None:
    figure = maxq.plot(flight, "gimbal_pitch_angle_deg", "gimbal_yaw_angle_deg", "mach")
    assert isinstance(figure, Figure)
    assert len(figure.axes) == 2
    maxq.plot(flight)
    with pytest.raises(KeyError, match="did you mean mach"):
        maxq.plot(flight, "mah")
    assert figure._repr_png_().startswith(b"\x89PNG")  # type: ignore[attr-defined]  # what a notebook asks for


def test_a_replay_of_nothing_raises() -> None:
    with pytest.raises(Exception, match="nosuch: no such file or folder"):
        maxq.replay("nosuch")
    assert simreplay.main(["nosuch"]) == 2


def test_importing_it_takes_nothing_along_and_every_name_is_there() -> None:
    code = "import sys, maxq; print([m for m in ('numpy', 'numba', 'pydantic') if m in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
    assert sorted(maxq.__all__) == dir(maxq)
    assert all(getattr(maxq, name).__doc__ for name in maxq.__all__)
    with pytest.raises(AttributeError, match="no attribute 'nosuch'"):
        maxq.nosuch  # noqa: B018  # what is looked up is not there


@pytest.mark.slow
def test_a_vehicle_from_a_layout_flies() -> None:
    place = maxq.vehicle("ksr3", "mine")
    assert place == Path("mine")
    assert maxq.fly(place / "scenario.toml", "run.duration_s=1").outcome == "duration"
    with pytest.raises(maxq.ScenarioError, match="nosuch"):
        maxq.vehicle("nosuch")


@pytest.mark.slow
def test_a_design_is_made_drawn_and_saved() -> None:
    made = maxq.optimise("ksr3-relaxed", "search.starts=2", "nodes_s=[10, 40]", "filter.structure=F2")
    assert repr(made).startswith("<Designed ksr3-relaxed: largest peak of mode 1 ")
    assert made.meets_limits
    assert "<td>met</td>" in made._repr_html_()
    made.bode(40.0)
    made.save("mine.toml")
    maxq.bode("mine.toml", 10.0)
    found = maxq.verify("mine.toml", "quick", "certificate=", "margins=")
    assert repr(found).startswith("<Verification of ")
