"""`simdesign open`: trials, limits, saving and undo by requests, on this machine and with the token only."""

from __future__ import annotations

import http.client
import json
import os
import re
import signal
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import maxq
from maxq.sim.scenario.loader import read_design
from maxq.tools import simdesign
from maxq.tools.design import serve
from maxq.tools.design.workbench import RequestError, changed, sliders


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[maxq.WorkbenchServer]:
    """Yield a workbench of a design at published derivatives, which need no flight."""
    place = tmp_path_factory.mktemp("trials")
    made = maxq.workbench("greensite-hm3", points="greensite", times_s=[60.0, 72.0], also=["greensite"], folder=place)
    yield made
    made.close()


def ask(server: maxq.WorkbenchServer, path: str, **request: Any) -> tuple[int, dict[str, Any]]:
    status, kind, content = server.answer(path, json.dumps(request).encode())
    assert kind == "application/json"
    return status, json.loads(content)


def test_the_trial_is_the_loop_of_the_changed_design(server: maxq.WorkbenchServer) -> None:
    setting = server.workbench.setting()
    assert [p["label"] for p in setting["points"]] == ["60 s", "72 s"]
    assert setting["kinds"] == ["pade", "exact"], "the computer of the points does not sample"
    edits = {"0/gains/k_p": 1.25, "0/gains/k_d_s": 0.8}
    status, found = ask(server, "show", point=1, plane="pitch", kind="exact", edits=edits, reference=True)
    assert status == 200
    design, point = read_design("greensite-hm3"), maxq.given_points("greensite", [72.0])[0]
    plain = maxq.loop(point, "greensite-hm3", kind="exact")
    trial = found["trial"]
    assert trial["gains"]["k_p"] == pytest.approx(1.25 * plain.law.gains["k_p"], rel=1e-5)
    assert trial["gains"]["k_d_s"] == pytest.approx(0.8 * plain.law.gains["k_d_s"], rel=1e-5)
    assert trial["gains"]["k_zd_radspm"] == pytest.approx(plain.law.gains["k_zd_radspm"], rel=1e-5)
    loop = maxq.loops([point], changed(design, edits), kind="exact")[0]
    curve = trial["curve"]
    own = 20.0 * np.log10(np.abs(loop.response(np.array(curve["x"]))))
    np.testing.assert_allclose(curve["y"], own, atol=0.05)
    assert f"phase margin {loop.margins().phase_deg.value:.3g} deg" in trial["text"]
    assert [row[0] for row in trial["rows"]] == ["unstable poles", "gain margin", "phase margin"]
    gain = trial["rows"][1]
    assert (gain[1], gain[5]) == (">= 5.99 dB", "met" if loop.margins().gain_db >= 5.99 else "missed")
    opened, other = found["references"]
    assert (opened["name"], other["name"]) == ("as opened", "greensite")
    assert opened["text"] != trial["text"]
    step = maxq.loops([point], changed(design, edits), kind="exact")[0].step(8.0)
    assert trial["step"][0]["y"][-1] == pytest.approx(step.attitude_rad[-1], rel=1e-4)
    gust = trial["gust"][0]
    assert max(np.abs(gust["y"])) == pytest.approx(
        np.degrees(np.abs(loop.gust(duration_s=8.0).alpha_rad).max()), rel=0.02
    )
    poles = {(round(x, 2), round(y, 2)) for x, y in zip(trial["locus"][-1]["x"], trial["locus"][-1]["y"], strict=True)}
    worst = max(loop.closed_poles(), key=lambda p: p.real) / 2.0 / np.pi
    assert (round(worst.real, 2), round(abs(worst.imag), 2)) in poles
    assert server.trial.gains.table["k_p"] == pytest.approx(1.25 * design.gains.table["k_p"])


def test_a_deviating_vehicle_and_wrong_requests(server: maxq.WorkbenchServer) -> None:
    (point,) = maxq.given_points("greensite", [60.0])
    _, found = ask(server, "show", kind="exact", vehicle={"bending_frequency": 0.9, "delay_ms": 10.0})
    modes = {f"mode_{n}_omega_radps": 0.9 for n in range(1, 1 + len(point.omega_radps))}
    loop = maxq.loop(point.with_(delay_s=0.01, **modes), "greensite-hm3", kind="exact")
    assert f"phase margin {loop.margins().phase_deg.value:.3g} deg" in found["trial"]["text"]
    for request, said in (
        ({"plane": "yaw"}, "plane = 'yaw', kind = 'exact': allowed are pitch"),
        ({"point": 2}, "point = 2: allowed are 0 to 1"),
        ({"edits": {"0/gains/k_q": 1.0}}, "0/gains/k_q: no such value in this design"),
        ({"edits": {"0/gains/k_p": 5.0}}, "0/gains/k_p = 5.0: allowed is a number from 0.25 to 4"),
        ({"edits": {"0/gains/k_p": "1"}}, "0/gains/k_p = 1: allowed is a number from 0.25 to 4"),
        ({"edits": {"0/gains/k_p": float("nan")}}, "0/gains/k_p = nan: allowed is a number"),
        ({"vehicle": {"mass": 1.0}}, "vehicle: allowed is an object of bending_frequency, bending_slope, delay_ms"),
        ({"vehicle": {"delay_ms": -1.0}}, "vehicle.delay_ms = -1.0: allowed is a number from 0 to 30"),
    ):
        status, answer = ask(server, "show", **{"kind": "exact"} | request)
        assert status == 400
        assert answer["error"].startswith(said)
    assert server.answer("show", b"[1]")[0] == server.answer("show", b"{")[0] == 400
    assert server.answer("other", b"{}")[0] == 404


def test_a_trial_is_saved_under_another_name_only(server: maxq.WorkbenchServer, tmp_path: Path) -> None:
    folder = server.workbench.folder
    status, answer = ask(server, "save", name="mine.toml", edits={"0/gains/k_p": 2.0})
    assert (status, answer["saved"]) == (200, str(folder / "mine.toml"))
    saved, own = read_design(folder / "mine.toml"), read_design("greensite-hm3")
    np.testing.assert_allclose(saved.gains.table["k_p"], 2.0 * own.gains.table["k_p"], rtol=1e-15)
    assert saved.basis == own.basis
    text = (folder / "mine.toml").read_text()
    assert text.startswith("# Written by simdesign open: greensite-hm3 with 1 value changed by hand.\n")
    (folder / "kept.toml").write_text("kept")
    for name, said in (
        ("kept.toml", "kept.toml exists: give another name"),
        ("../mine.toml", "'../mine.toml': allowed is a file name"),
        ("mine.txt", "'mine.txt': allowed is a file name"),
        (".toml", "'.toml': allowed is a file name"),
    ):
        status, answer = ask(server, "save", name=name, edits={})
        assert status == 400
        assert said in answer["error"]
    assert (folder / "kept.toml").read_text() == "kept"
    assert sorted(p.name for p in folder.iterdir()) == ["kept.toml", "mine.toml"]
    made = maxq.workbench(folder / "mine.toml", points="greensite", times_s=[72.0], folder=folder)
    with pytest.raises(RequestError, match="is the opened design, which is not replaced"):
        made.workbench.save({}, "mine.toml")
    made.close()


def test_every_number_of_a_filter_has_a_slider() -> None:
    for name in ("ksr3-default", "petrel-robust", "ksr3-free"):
        design = read_design(name)
        for stage in range(max(len(design.stage), 1)):
            own = design.of_stage(stage)
            every = {s.key: s for s in sliders(design, stage, [])}
            quadratic, first_order = own.filter.counts
            assert len(every) == len(own.gain_names) + 4 * quadratic + 2 * first_order
            assert all(s.low <= s.value <= s.high for s in every.values())
            key = f"{stage}/filter/quadratic/0/pole_hz"
            moved = changed(design, {key: 1.1 * every[key].value}).of_stage(stage)
            before, after = (one.filter.scheduled().filters[0].quadratic[0] for one in (own, moved))
            assert after.pole_hz == pytest.approx(1.1 * before.pole_hz)
            assert (after.zero_hz, after.zero_zeta) == (before.zero_hz, before.zero_zeta)


def test_only_this_machine_with_the_token_is_answered(server: maxq.WorkbenchServer) -> None:
    token = server.url.split("/")[3]
    assert len(token) == 32
    assert server.url == f"http://127.0.0.1:{server.port}/{token}/"

    def status(path: str, **headers: str) -> tuple[int, dict[str, str]]:
        connection = http.client.HTTPConnection("127.0.0.1", server.port, timeout=60)
        connection.request("POST", path, body=b'{"kind": "exact"}', headers=headers)
        answer = connection.getresponse()
        answer.read()
        connection.close()
        return answer.status, dict(answer.getheaders())

    good, headers = status(f"/{token}/show")
    assert good == 200
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert status("/show")[0] == status(f"/{'x' * 32}/show")[0] == 403
    assert status(f"/{token}/show", Host="elsewhere.example")[0] == 403
    assert status(f"/{token}/show", Origin="http://elsewhere.example")[0] == 403
    assert status(f"/{token}/show", Origin=f"http://127.0.0.1:{server.port}")[0] == 200


def test_the_page_contains_everything_it_needs(server: maxq.WorkbenchServer) -> None:
    status, kind, content = server.answer("")
    page = content.decode()
    assert (status, kind) == (200, "text/html; charset=utf-8")
    assert 'id="figure-loop"' in page
    assert '"0/gains/k_p"' in page
    assert re.findall(r"""src=|href="http|@import|url\((?!#)|<link""", page) == []
    assert 'title="workbench"' in server._repr_html_()


def test_the_command_ends_by_ctrl_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The address is printed, and SIGINT ends the command with code 0."""
    said: list[str] = []

    def tell(*lines: str) -> None:
        if not said:
            threading.Timer(0.1, lambda: os.kill(os.getpid(), signal.SIGINT)).start()
        said.extend(lines)

    monkeypatch.setattr(serve, "tell", tell)
    monkeypatch.chdir(tmp_path)
    assert simdesign.main(["open", "greensite-hm3", "--at", "72", "--no-browser"]) == 0
    assert said[0].startswith("open http://127.0.0.1:")
    assert said[1:] == ["Ctrl-C ends it", "closed; 0 designs saved"]


def test_wrong_options_are_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in (
        (["open", "ksr3-defualt"], "did you mean ksr3-default"),
        (["open", "greensite-hm3", "--at", "1e4"], "node at 10000 s"),
        (["open", "greensite-hm3", "--at", "72", "--with", "nosuch"], "nosuch"),
        (["open", "greensite-hm3", "--at", "72", "--port", "99999"], "--port 99999: cannot be used"),
        (["open", "greensite-hm3", "--kind", "sampled"], "does not sample"),
    ):
        assert simdesign.main(words) == 2
        assert said in capsys.readouterr().err
