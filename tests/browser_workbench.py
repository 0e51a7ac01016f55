"""Check the page of `simdesign open` in a real browser: `make test-browser`. Not collected by `make test`.

MAXQ_PICTURES=FOLDER also keeps pictures of both widths and colour schemes.
"""

from __future__ import annotations

import base64
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from browser_pages import FAULTS, key, value
from browser_replay import Page, page

from maxq.sim.scenario.loader import read_design
from maxq.tools.design.report import AnalysisOrder
from maxq.tools.design.serve import WorkbenchServer, workbench_of

__all__ = ["page"]
K_P = "document.querySelector('.slide input')"
TRIAL = """[...document.querySelectorAll('#figure-loop .panel')]
  .map((p) => [...p.querySelectorAll('path')].map((q) => q.getAttribute('d')).join()).join()"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WorkbenchServer]:
    order = AnalysisOrder(design="ksr3-default", times_s=(20.0, 40.0), given=("times_s",))
    made = WorkbenchServer(workbench_of(order, ("ksr3-linear",), str(tmp_path_factory.mktemp("saved"))))
    yield made
    made.close()


def shown(page: Page, url: str, width: int, scheme: str = "light") -> None:
    page.do("Emulation.setDeviceMetricsOverride", width=width, height=900, deviceScaleFactor=1, mobile=width < 500)
    page.do("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])
    for domain in ("Page", "Network", "Runtime"):
        page.do(f"{domain}.enable")
    page.do("Page.navigate", url=url)
    until(page, "document.readyState === 'complete' && document.querySelectorAll('#limits tbody tr').length > 0")


def until(page: Page, what: str) -> None:
    deadline = time.monotonic() + 60.0
    while not value(page, what):
        assert time.monotonic() < deadline, what
        time.sleep(0.05)


def picture(page: Page, name: str) -> None:
    folder = os.environ.get("MAXQ_PICTURES")
    if folder:
        height = value(page, "document.documentElement.scrollHeight")
        clip = {"x": 0, "y": 0, "width": value(page, "innerWidth"), "height": height, "scale": 1}
        data = page.do("Page.captureScreenshot", format="png", clip=clip, captureBeyondViewport=True)["data"]
        (Path(folder) / name).write_bytes(base64.b64decode(data))


def settled(page: Page, before: Any) -> Any:
    """Wait until nothing more is drawn and the figures differ from `before`. Return them."""
    until(page, f"!document.getElementById('latency').dataset.busy && {TRIAL} !== {before!r}")
    return value(page, TRIAL)


@pytest.mark.parametrize("width", [390, 1280])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_figures_follow_the_sliders_by_keyboard_with_undo_and_saving(
    page: Page, server: WorkbenchServer, width: int, scheme: str
) -> None:
    shown(page, server.url, width, scheme)
    assert page.errors == []
    assert value(page, "document.documentElement.scrollWidth <= innerWidth"), "nothing is wider than the page"
    assert value(page, FAULTS) == []
    opened, said = value(page, TRIAL), value(page, "document.getElementById('outcome').textContent")
    value(page, f"{K_P}.focus()")
    for _ in range(4):
        key(page, "ArrowRight")
    moved = settled(page, opened)
    assert value(page, "document.getElementById('outcome').textContent") != said
    assert server.latest["0/gains/k_p"] == pytest.approx(16.0**0.04, rel=1e-6)
    measured = []
    for _ in range(12):
        key(page, "ArrowRight")
        time.sleep(0.25)
        measured.append((value(page, "+latency.dataset.server"), value(page, "+latency.dataset.ms")))
    server_ms, whole_ms = (sorted(m[k] for m in measured if None not in m)[3] for k in (0, 1))
    print(f"width {width}: server {server_ms:.0f} ms, end to end {whole_ms:.0f} ms")
    picture(page, f"workbench-{width}-{scheme}.png")
    for _ in range(12):
        value(page, "document.getElementById('undo').click()")
    until(page, f"!document.getElementById('latency').dataset.busy && {TRIAL} === {moved!r}")
    for _ in range(4):
        value(page, "document.getElementById('undo').click()")
    until(page, f"!document.getElementById('latency').dataset.busy && {TRIAL} === {opened!r}")
    assert value(page, "document.getElementById('undo').disabled")
    value(page, "document.getElementById('redo').click()")
    redone = settled(page, opened)
    for name, chosen in (("plane", "yaw"), ("point", "1")):
        field = f"document.getElementById('{name}')"
        value(page, f"{field}.value = '{chosen}'; {field}.dispatchEvent(new Event('change'))")
    settled(page, redone)
    value(page, f"document.getElementById('name').value = 'by-hand-{width}-{scheme}.toml'")
    value(page, "document.querySelector('#save button').click()")
    until(page, "document.getElementById('said').textContent.startsWith('saved ')")
    saved = read_design(server.workbench.folder / f"by-hand-{width}-{scheme}.toml")
    own = read_design("ksr3-default")
    assert saved.gains.table["k_p"] == pytest.approx(16.0**0.01 * own.gains.table["k_p"], rel=1e-8)
    assert page.errors == []
    away = [u for u in page.answers if not u.startswith(server.url) and not u.startswith("data:")]
    assert away == []
