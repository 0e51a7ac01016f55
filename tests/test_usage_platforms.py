"""maxq takes another way, or says so in one line, on a system that lacks what Linux has."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path
from typing import Any

import pytest

import maxq
from maxq import ScenarioError
from maxq.design.case.schema import read_case
from maxq.design.optimise.solve import nominal_plants
from maxq.sim.run import guard
from maxq.sim.run.flight_software import FlightSoftware
from maxq.tools.cli import frame, system
from maxq.tools.design import run_case
from maxq.tools.dev import links
from maxq.tools.replay import run as replay
from maxq.tools.replay import viewer

ROOT = Path(__file__).resolve().parents[1]
LAW = ROOT / "examples" / "flight_software" / "pd_law.py"
EXTERNAL = ("vehicle.computer.law=external", f"vehicle.computer.python={LAW}:Autopilot")


def test_guarded_code_needs_a_fork(monkeypatch: pytest.MonkeyPatch) -> None:
    loaded: Any = maxq.load("nominal", *EXTERNAL)
    monkeypatch.setattr(guard, "FORKS", False)
    with pytest.raises(ScenarioError) as caught:
        FlightSoftware(loaded)
    said = str(caught.value)
    assert "vehicle.computer.guard" in said
    assert "this system cannot fork the process that guards a flight" in said
    assert "false, with which a crash of the code also ends maxq" in said
    assert "\n" not in said
    FlightSoftware(maxq.load("nominal", *EXTERNAL, "vehicle.computer.guard=false")).close()  # type: ignore[arg-type]


def test_functions_of_linux_are_left_out_elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    called: list[str] = []

    def function(name: str) -> Any:
        called.append(name)
        return None

    for module in (frame, replay, viewer):
        monkeypatch.setattr(module, "linux_function", function)
    frame._keep_freed_memory()
    replay._give_back_memory()
    assert viewer._bind_to(1) is None
    assert called == ["mallopt", "malloc_trim", "prctl"]


def test_functions_are_those_of_linux(monkeypatch: pytest.MonkeyPatch) -> None:
    assert (system.linux_function("getpid") is not None) == sys.platform.startswith("linux")
    assert system.linux_function("no_such_function") is None
    monkeypatch.setattr(system, "LINUX", False)
    assert system.linux_function("getpid") is None


def test_the_viewer_needs_neither_a_display_variable_nor_folders_of_linux(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "XDG_RUNTIME_DIR", "XDG_CONFIG_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(system, "LINUX", False)
    monkeypatch.setattr(viewer, "executable", lambda: tmp_path / "rerun")
    monkeypatch.setattr(viewer.subprocess, "run", lambda *_args, **_named: None)
    viewer.check_display()
    assert not {"XDG_RUNTIME_DIR", "XDG_CONFIG_HOME"} & viewer.environment().keys()


def test_a_pool_that_spawns_gets_all_that_a_fork_has() -> None:
    """Spawned processes get cases, plants and tasks as pickles; a fork has them in memory."""
    assert ("fork" if sys.platform == "linux" else "spawn") == run_case.START
    loaded = read_case("ksr3-relaxed")
    orders = run_case.order_cases(loaded)
    plants = nominal_plants(loaded)
    cases, again = pickle.loads(pickle.dumps((orders, plants)))
    assert cases == orders
    assert [p.node.time_s for p in again.each] == [p.node.time_s for p in plants.each]
    assert pickle.loads(pickle.dumps(run_case._solve_order)) is run_case._solve_order


@pytest.mark.parametrize("ways", [links.WAYS, links.WAYS[1:]], ids=["links", "copies"])
def test_type_checkers_find_the_layers_without_links(tmp_path: Path, ways: Any) -> None:
    """A checkout without symbolic links has a text file in place of each."""
    folder = tmp_path / "tools" / ".ns" / "maxq"
    for name in links.LAYERS:
        (tmp_path / name).mkdir(exist_ok=True)
        (tmp_path / name / "module.py").write_text(f"NAME = '{name}'\n")
    folder.mkdir(parents=True)
    (folder / "sim").write_text("../../../sim")
    assert links.make_links(folder, tmp_path, ways) == list(links.LAYERS)
    assert {path.name for path in folder.iterdir()} == set(links.LAYERS)
    (tmp_path / "sim" / "module.py").write_text("NAME = 'changed'\n")
    copies = ways is not links.WAYS
    assert links.make_links(folder, tmp_path, ways) == list(links.LAYERS) * copies
    assert (folder / "sim" / "module.py").read_text() == "NAME = 'changed'\n"
    assert (folder / "sim").is_symlink() is not copies
    assert not (folder / "tools" / ".ns").exists() or not copies
    with pytest.raises(OSError, match="junctions exist on Windows only"):
        links.make_links(tmp_path / "other", tmp_path, ways[-2:-1])


def test_the_links_of_this_checkout_are_there() -> None:
    assert links.make_links(ROOT / "tools" / ".ns" / "maxq", ROOT) == []
