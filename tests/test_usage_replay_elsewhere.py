"""Logs of maxq open in other viewers: Rerun alone, and Foxglove with the shipped layout."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from replaykit import OLD_LOG, free_port, headless_viewer

import maxq
from maxq.tools.replay import log_layout, viewer

FOXGLOVE = Path(__file__).parents[1] / "docs" / "viewers" / "maxq.foxglove-layout.json"


@pytest.mark.long
def test_rerun_alone_shows_the_events_of_a_log() -> None:
    with headless_viewer() as client:
        viewer.open_whole(client, OLD_LOG)
        viewer.steady_picture(client)
        assert [view.view_class for view in client.get_state().views] == ["TextLog"]
        assert viewer.complaints_of(client) == []


@pytest.mark.long
def test_rerun_shows_frames_and_every_number_once_told(tmp_path: Path) -> None:
    table = maxq.read(OLD_LOG).table
    log = shutil.copy(OLD_LOG, tmp_path / "another.mcap")  # the viewer names recordings after the file
    with headless_viewer() as client:
        viewer.open_whole(client, log)
        log_layout.send_layout(log, int(client.url.rsplit(":", 1)[1].split("/")[0]))
        viewer.steady_picture(client)
        for time_s in (3.0, 9.0):
            client.pause_at("message_log_time", timestamp=time_s)
            viewer.steady_picture(client)
            assert viewer.complaints_of(client) == []
        views = {view.name: view for view in client.get_state().views}
        plots = {f"{t.name.strip('/')} ({unit})" for t in table.topics for unit in log_layout.selectors(t)}
        assert {name for name, view in views.items() if view.view_class == "TimeSeries"} == plots
        for name in ("actuator (deg)", "Body axes at the launch site", "Events"):
            picture = Image.open(io.BytesIO(viewer.steady_picture(client, views[name].view_id)))
            assert np.asarray(picture.convert("L"), float).std() > 5.0, name


def test_a_layout_without_a_viewer_says_so(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    port = free_port()
    monkeypatch.setattr("sys.argv", ["log_layout", str(OLD_LOG), str(port)])
    assert log_layout.main() == 2
    assert capsys.readouterr().err == f"log_layout: no viewer listens on port {port} of 127.0.0.1\n"


# Foxglove, which no test starts: what its layout names must exist. The kinds of panels are those that Foxglove Studio
# 1.48.0 knows; the panel of logs is called RosOut there.
FOXGLOVE_PANELS = {"3D", "Plot", "RosOut"}


def values(node: Any, key: str) -> Iterator[Any]:
    """Yield all values of a key anywhere in a tree."""
    if isinstance(node, dict):
        for name, value in node.items():
            if name == key:
                yield value
            yield from values(value, key)
    elif isinstance(node, list):
        for item in node:
            yield from values(item, key)


def test_the_foxglove_layout_names_what_a_log_has() -> None:
    layout, log = json.loads(FOXGLOVE.read_text(encoding="utf-8")), maxq.read(OLD_LOG)
    topics = {topic.name: {channel.name for channel in topic.channels} for topic in log.table.topics}
    plotted = [path["value"] for paths in values(layout, "paths") for path in paths]
    assert len(plotted) > 15
    for value in plotted:
        topic, _, field = value.partition(".")
        assert field in topics[topic], value
    known = {*topics, "/events", "/tf"}
    assert set(values(layout, "topicToRender")) | set(values(layout, "topicPath")) <= known
    scene = layout["configById"]["3D!scene"]
    frames = {scene["followTf"], *values(scene["layers"], "frameId"), *scene["transforms"]}
    assert {name.removeprefix("frame:") for name in frames} == {"launch_site", "body"}


def test_the_foxglove_layout_has_panels_that_foxglove_knows() -> None:
    layout = json.loads(FOXGLOVE.read_text(encoding="utf-8"))
    assert {name.partition("!")[0] for name in layout["configById"]} == FOXGLOVE_PANELS
    for config in layout["configById"].values():  # `title` is an older name that changes the layout when it is opened
        assert config["foxglovePanelTitle"]
        assert "title" not in config


def test_the_foxglove_scene_stands_upright() -> None:
    """The vehicle is upright at the first view, because a camera that follows the body takes its initial attitude."""
    layout = json.loads(FOXGLOVE.read_text(encoding="utf-8"))
    scene = layout["configById"]["3D!scene"]
    assert (scene["followTf"], scene["followMode"]) == ("launch_site", "follow-none")


def test_the_foxglove_layout_places_every_panel_once() -> None:
    layout = json.loads(FOXGLOVE.read_text(encoding="utf-8"))

    def placed(node: Any) -> Iterator[str]:
        if isinstance(node, str):
            yield node
        else:
            yield from placed(node["first"])
            yield from placed(node["second"])

    inside = [
        name
        for config in layout["configById"].values()
        for tab in config.get("tabs", [])
        for name in placed(tab["layout"])
    ]
    assert sorted([*placed(layout["layout"]), *inside]) == sorted(layout["configById"])
