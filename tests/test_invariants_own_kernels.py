"""Kernels compiled for the sizes of one vehicle fly the same bits as those for all vehicles."""

import ast
import dataclasses
import os
import signal
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import petrelkit
import pytest

import maxq
from maxq import FlightRun
from maxq.control.kernel import kept_code
from maxq.control.kernel.jit import from_python
from maxq.control.kernel.records import constants_in, pack, with_constants
from maxq.sim.campaign import own_kernels
from maxq.sim.campaign.runs import fly_rows
from maxq.sim.packing.flight import pack_flight, pack_for_one_vehicle
from maxq.sim.scenario.loader import load_scenario
from maxq.sim.vehicle.block import are_usual, rigid_counts, usual_counts
from maxq.sim.vehicle.state import Counts, Sizes, counts

SHORT = ["run.duration_s=12.0", "run.stop_at=[]", "campaign.keep=[]"]


@pytest.fixture(scope="module")
def campaign():
    return maxq.load("campaigns/ksr3", *SHORT)


@pytest.mark.long
def test_a_campaign_flies_the_same_bits(campaign):
    orders = [(campaign.plan.draw(0, 3), run) for run in range(3)]
    common, own = (fly_rows(campaign, orders, pack=pack) for pack in (pack_flight, pack_for_one_vehicle))
    assert {row.outcome for row in common} == {"duration"}
    assert [row.state_hash for row in own] == [row.state_hash for row in common]
    assert list(map(repr, own)) == list(map(repr, common))  # repr: nan is nan, and digits are all there
    assert len({row.state_hash for row in own}) == 3


@pytest.mark.long
def test_every_log_row_is_the_same(campaign):
    loaded = campaign.inputs(0, campaign.plan.draw(0, 1)).loaded
    flights = [FlightRun(loaded, packing(loaded.scenario)) for packing in (pack_flight, pack_for_one_vehicle)]
    for _ in range(2):
        rows, own = (flight.fly_segment() for flight in flights)
        for group in rows:
            for common_part, own_part in zip(rows[group], own[group], strict=True):
                assert np.array_equal(common_part, own_part, equal_nan=True)


ENDS, CONTINUES = "import sys; sys.stdin.readline()", "import sys; sys.stdin.read()"


@pytest.mark.parametrize(
    ("runs", "program", "stored", "packings"),
    [
        (499, ENDS, [True], [False, False]),
        (500, ENDS, [False, True], [False, True]),
        (500, CONTINUES, [False, True], [False, False]),
        (500, ENDS, [False, False], [False, False]),  # the compilation failed
        (500, CONTINUES, [True], [True, True]),
    ],
)
def test_a_campaign_uses_kernels_of_its_vehicle_once_they_are_stored(
    campaign, monkeypatch, runs, program, stored, packings
):
    """A campaign that justifies its own kernels flies with the common ones until another process has stored them."""
    monkeypatch.setattr(own_kernels, "_PROGRAM", program)
    answers = iter(stored)
    monkeypatch.setattr(FlightRun, "finds_kernels", lambda run, own: next(answers))
    kernels = own_kernels.OwnKernels(campaign, runs)
    compiler = kernels._compiler
    scenario, found = campaign.base.scenario, list[bool]()
    assert (compiler is None) == (runs < 500 or stored[0])
    for _ in packings:
        packed = kernels.pack(scenario)
        found.append(bool(constants_in(packed.parameters.dtype["vehicle"]["sizes"].names)))
        if compiler is not None and program is ENDS:
            compiler.wait()
    kernels.end()
    assert found == packings
    assert compiler is None or compiler.poll() == (0 if program is ENDS else -signal.SIGKILL)


@pytest.mark.long
def test_another_process_compiles_and_stores(campaign, monkeypatch):
    """The first flights use the common kernels, the later ones those of the vehicle, and all rows are the same."""
    used = list[bool]()

    def packed(scenario):
        used.append(True)
        return pack_for_one_vehicle(scenario)

    common = fly_rows(campaign, [(campaign.plan.draw(0, 1), 0)])
    kernels = own_kernels.OwnKernels(campaign, 500)
    if kernels._compiler is not None:
        assert kernels._compiler.wait() == 0
    monkeypatch.setattr(own_kernels, "pack_for_one_vehicle", packed)
    own = fly_rows(campaign, [(campaign.plan.draw(0, 1), 0)], pack=kernels.pack)
    kernels.end()
    assert used == [True]
    assert list(map(repr, own)) == list(map(repr, common))


def test_the_type_tells_the_sizes():
    plain = pack_flight(load_scenario("nominal").scenario).parameters
    telling = pack_for_one_vehicle(load_scenario("nominal").scenario).parameters
    known = constants_in(telling.dtype["vehicle"]["sizes"].names)
    assert known == {name: int(plain["vehicle"]["sizes"][name][0]) for name in Sizes.__dataclass_fields__}
    assert constants_in(plain.dtype["vehicle"]["sizes"].names) == {}
    assert telling.tobytes() == plain.tobytes()
    assert telling.dtype.itemsize == plain.dtype.itemsize
    assert isinstance(telling[0], np.record)


def test_modes_are_grouped_by_four():
    assert [Sizes(modes, 0, 0, 0).mode_groups for modes in (0, 1, 4, 5, 12)] == [0, 1, 1, 2, 3]


@pytest.mark.parametrize("unusual", [f.name for f in dataclasses.fields(Sizes) if f.default is not dataclasses.MISSING])
@pytest.mark.parametrize(("modes", "of"), [((3, 2), usual_counts), ((0, 1), usual_counts), ((0, 0), rigid_counts)])
def test_counts_are_usual_only_where_the_constants_are_theirs(modes, of, unusual):
    """Code for usual counts is used only where its constants hold, since it ignores other components."""
    sizes = Sizes(*modes, 4, 5)
    usual = counts(pack([sizes])[0])
    assert are_usual(usual)
    assert of(usual) == usual
    for count in (getattr(sizes, unusual) - 1, getattr(sizes, unusual) + 1):
        if count >= 0:
            assert not are_usual(counts(pack([dataclasses.replace(sizes, **{unusual: count})])[0]))


@pytest.mark.parametrize("modes", [(5, 0), (0, 5)])
def test_more_than_four_modes_in_a_plane_are_unusual(modes):
    assert not are_usual(counts(pack([Sizes(*modes, 4, 5)])[0]))


VEHICLES = """
import sys
from maxq.control.kernel.kept_code import EntryCache
from maxq.sim.run.fly import fly
from maxq.sim.scenario.loader import load_scenario

asked, load = [], EntryCache.load_overload
EntryCache.load_overload = lambda cache, *of: (asked.append(cache), load(cache, *of))[1]
for scenario in sys.argv[1:]:
    before = len(asked)
    fly(load_scenario(scenario, ["run.duration_s=0.05"]))
    print(scenario, len(asked) - before)
"""


@pytest.mark.slow
def test_a_second_vehicle_compiles_nothing():
    """A second vehicle with other modes, tanks, stages, a TVC load or many engines compiles nothing."""
    petrel = str(petrelkit.folder() / "scenario.toml")
    scenarios = ["nominal", "checkcases/nesc-01", "checkcases/nesc-17", "ksr3-ringed", "tvc-load", petrel]
    command = [sys.executable, "-c", VEHICLES, *scenarios]
    environment = os.environ | {"NUMBA_DISABLE_JIT": "0"}
    printed = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    asked = {name: int(count) for name, count in (line.split() for line in printed.splitlines())}
    assert list(asked) == scenarios
    assert asked.pop("nominal") > 0
    assert set(asked.values()) == {0}


def test_stages_of_unlike_sizes_stay_with_the_common_kernels():
    rows = np.zeros(2, pack_flight(load_scenario("nominal").scenario).parameters.dtype)
    rows["vehicle"]["sizes"]["pendulums"] = 1, 2
    assert with_constants(rows, "vehicle", "sizes") is rows


def test_uncompiled_source_reads_the_record():
    numbers = tuple(range(1, len(Counts._fields)))
    sizes = with_constants(pack([Sizes(*numbers)]))[0]
    assert getattr(counts, "py_func", counts)(sizes) == (*numbers, 1)  # four modes at most


@pytest.mark.skipif(numba.config.DISABLE_JIT, reason="of compiled code")
def test_compiled_code_has_the_sizes_as_constants():
    """Code for one vehicle uses the sizes in its type, even after the sizes in memory change."""
    numbers = tuple(range(1, len(Counts._fields)))
    plain = pack([Sizes(*numbers)])
    own = with_constants(plain)
    of = from_python(counts)
    assert of(plain[0]) == of(own[0]) == (*numbers, 1)
    for name in Sizes.__dataclass_fields__:
        plain[name] = 0
    assert of(plain[0]) == (0,) * len(Counts._fields)
    assert of(own[0]) == (*numbers, 1)
    other = with_constants(pack([Sizes(*numbers[:-1], 3 * numbers[-1])]))
    assert of(other[0]) == (*numbers[:-1], 3 * numbers[-1], 1)  # other constants are another type


def test_the_cache_follows_the_sources_wherever_they_lie(tmp_path, monkeypatch):
    """In a checkout below a folder named like one of sim's folders, the kernel sources still determine the cache."""
    here = tmp_path / "run" / "control" / "kernel"
    here.mkdir(parents=True)
    monkeypatch.setattr(kept_code, "__file__", str(here / "kept_code.py"))
    (here / "kept_code.py").write_text("a = 1\n")
    before = kept_code.source_hash()
    (here / "kept_code.py").write_text("a = 2\n")
    assert kept_code.source_hash() != before
    (tmp_path / "run" / "sim" / "log").mkdir(parents=True)
    (tmp_path / "run" / "sim" / "log" / "writer.py").write_text("")
    assert list(kept_code._source_files()) == [here / "kept_code.py"]  # what holds no kernel compiles nothing again


ROUTINES = {"routine", "disjoint_routine", "rare_routine", "routine_beside"}
DECORATORS = ROUTINES | {"kernel", "formula", "entry", "from_python"}


def modules_used(path: Path) -> set[str]:
    """Return the modules of maxq from which the compiled functions of a file, or its constants, use a name."""
    tree, origin = ast.parse(path.read_text()), dict[str, str]()
    for node in tree.body:
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("maxq."):
            origin |= {name.asname or name.name: f"{node.module}:{name.name}" for name in node.names}
    compiled = [
        node
        for node in tree.body
        if isinstance(node, ast.FunctionDef) and DECORATORS & {getattr(d, "id", "") for d in node.decorator_list}
    ]
    if not compiled:
        return set()
    constants = [node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value]
    code = [*constants, *(line for function in compiled for line in function.body)]
    annotations = [node.annotation for part in code for node in ast.walk(part) if isinstance(node, ast.AnnAssign)]
    typing = {id(node) for annotation in annotations for node in ast.walk(annotation)}
    names = {n.id for part in code for n in ast.walk(part) if isinstance(n, ast.Name) and id(n) not in typing}
    return {origin[name] for name in names if name in origin}


@pytest.mark.slow
def test_all_that_compiled_code_is_made_of_counts_for_its_cache():
    """The cache key covers all files with compiled functions and all modules whose names these use.

    The syntax trees of all layers are searched.
    """
    layers = Path(kept_code.__file__).resolve().parents[2]
    sources = {path.relative_to(layers) for path in kept_code._source_files()}
    files = [
        p.relative_to(layers) for layer in ("control", "sim", "design", "tools") for p in (layers / layer).rglob("*.py")
    ]
    used = {path: modules_used(layers / path) for path in files if not {"dev", ".ns"} & set(path.parts)}
    assert len([path for path, names in used.items() if names]) > 50
    missing = set[tuple[str, str]]()
    for path, names in used.items():
        for name in names:
            module, _, last = name.removeprefix("maxq.").partition(":")
            inside = Path(module.replace(".", "/")) / f"{last}.py"  # a name may be a module
            found = inside if (layers / inside).exists() else Path(module.replace(".", "/") + ".py")
            missing |= {(str(each), name) for each in (path, found) if each not in sources}
    assert missing == set()


LAYOUTS = {"short": [("a", "f8"), ("b", "f8")], "long": [("c", "f8"), ("a", "f8"), ("b", "f8")]}
MANGLED = """
import numpy, sys
from maxq.control.kernel.compilers import adapted_numba
from numba.np.numpy_support import from_dtype
with adapted_numba:
    print(*(from_dtype(numpy.dtype(fields, align=True)).mangling_args[1][0] for fields in {fields}))
"""


def test_names_in_machine_code_tell_layouts_whatever_a_process_has_met_before():
    """Machine code has names that identify the layout, since the loader identifies functions of equal names."""
    told = {}
    for order in (("short", "long"), ("long", "short")):
        program = MANGLED.format(fields=[LAYOUTS[name] for name in order])
        printed = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout
        told[order] = dict(zip(order, printed.split(), strict=True))
    (first, second) = told.values()
    assert first == second
    assert first["short"] != first["long"]
