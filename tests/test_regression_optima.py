"""The optima of the shipped cases, and a certificate, equal `tests/data/optima.json`.

| quantity | expected |
|---|---|
| objective and limits of each shipped design at its operating points | as recorded, to 0.001 dB or deg |
| the objective in the description of its file | the recorded one, as printed |
| each case optimised again | the objective of its file, to 0.001 dB |
| a certificate without rounding: margins of the linear loops, and those measured in flight | as recorded, to 1e-6 dB |

After an intended change of a model or a design, `MAXQ_TEST_FILES=$(mktemp -d) python tests/test_regression_optima.py`
writes the record again.
"""

from __future__ import annotations

import json
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import petrelkit as petrel
import pytest

import maxq
from maxq.design.case.basis import stated_basis
from maxq.design.certificate.certificate import certify_node
from maxq.design.verify.judging import judge, stage_checks
from maxq.sim.input.files import builtin_files
from maxq.sim.scenario.loader import LoadedScenario, load_scenario, read_design
from maxq.tools.dev import greensite

RECORD = Path(__file__).parent / "data" / "optima.json"
WITHIN = 0.001  # dB, deg; the sixth digit of quantities in other units
CERTIFIED = "certificate of ksr3-robust at 40 s"
WITHIN_DB = 1e-6
DESIGNS = tuple(builtin_files("design"))
AGAIN = {  # design: case, its changes
    "greensite": ("greensite",),
    "ksr3-free": ("ksr3-relaxed", "gains.schedule=free"),
    "ksr3-linear": ("ksr3-relaxed", "gains.schedule=linear"),
    "ksr3-load-relief": ("ksr3-load-relief",),
    "ksr3-sampled": ("ksr3-identical", "loop=sampled"),
    "ksr3-two-phase": ("ksr3-identical", "gains.schedule=two-phase"),
}
KEYS = {
    "largest peak of mode 1": "first_mode_db",
    "least |1 + L|": "modulus_db",
    "largest rms of q alpha": "q_alpha_Padeg",
}
STATED = re.compile(rf"({'|'.join(map(re.escape, KEYS))}) (-?\d+\.?\d*)( at the worst plant found)?", re.IGNORECASE)


def objectives(description: str) -> list[tuple[str, str]]:
    """Return the objectives in a description, except those of a search for the worst plant."""
    return [(what[0].lower() + what[1:], text) for what, text, found in STATED.findall(description) if not found]


@cache
def measured(name: str) -> dict[str, dict[str, float]]:
    """Return the worst values of a shipped design's limits at its operating points, by stage."""
    flown: LoadedScenario | None
    if name.startswith("petrel"):
        flown = petrel.scenario(f"design='designs/{name}.toml'")
        design = flown.design
    else:
        design = read_design(name)
        basis = stated_basis(design)
        assert basis is not None
        along = f"design='designs/{name}.toml'"
        flown = None if name.startswith("greensite") else load_scenario(basis.scenario or "nominal", [along])
    assert design is not None
    found = {}
    for stage in range(max(1, len(design.stage))):
        basis = stated_basis(design, stage)
        assert basis is not None
        assert basis.nodes_s is not None
        nodes: Any = (
            maxq.given_points("greensite", basis.nodes_s)
            if flown is None
            else maxq.nodes(flown, basis.nodes_s, plane=basis.plane, errata=basis.errata, plant=basis.plant)
        )
        judged = judge(nodes, design, basis.loop)
        worst = {
            c.key: float(c.values[c.worst]) for c in stage_checks(judged, design.of_stage(stage), basis, basis.loop)
        }
        if name == "greensite":
            worst["q_alpha_Padeg"] = float(np.max(greensite.measured(design)[1][0].rms))
        worst["first_mode_db"] = max(j.mode_peak_db(1, 1) for j in judged)
        worst["modulus_db"] = min(20.0 * np.log10(j.margins.modulus) for j in judged)
        found[str(stage + 1)] = worst
    return found


def certified() -> dict[str, list[float]]:
    loaded = load_scenario("nominal", ["switches.converter='ideal'"])
    found = certify_node(loaded, maxq.nodes(loaded, [40.0])[0], bands=(), names=("gain_up", "gain_down"))
    return {row.what: [row.pade, row.sampled, row.held, row.measured] for row in found.margins}


def recorded() -> dict[str, Any]:
    return json.loads(RECORD.read_text())


@pytest.mark.parametrize("name", DESIGNS)
def test_shipped_designs_have_their_recorded_values(name: str) -> None:
    stages, expected = measured(name), recorded()[name]
    assert stages.keys() == expected.keys()
    for stage, values in stages.items():
        assert values.keys() == expected[stage].keys()
        for key, value in values.items():
            within = WITHIN if key.endswith(("_db", "_deg")) else 1e-5 * abs(expected[stage][key])
            assert value == pytest.approx(expected[stage][key], abs=within), (stage, key)


@pytest.mark.parametrize("name", [n for n in DESIGNS if n not in ("ksr3-default", "greensite-hm3", "greensite-zavoli")])
def test_descriptions_state_the_recorded_objective(name: str) -> None:
    stages = list(recorded()[name].values())
    stated = objectives(read_design(name).description)
    assert len(stated) == len(stages)
    for (what, text), values in zip(stated, stages, strict=True):
        value = values[KEYS[what]]
        digit = 10.0 ** -len(text.partition(".")[2])
        distance = 10.0 ** (value / 20.0) if what == "least |1 + L|" else value
        assert distance == pytest.approx(float(text), abs=0.5 * digit + 1e-6), what


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=pytest.mark.long if n in ("ksr3-load-relief", "greensite") else pytest.mark.slow)
        for n in AGAIN
    ],
)
def test_a_case_optimised_again_reaches_the_value_of_its_file(name: str) -> None:
    found = maxq.optimise(*AGAIN[name])
    assert found.outcome.feasible
    key = KEYS[objectives(found.outcome.design.description)[0][0]]
    value = recorded()[name]["1"][key]
    expected = 20.0 * np.log10(value) if key == "q_alpha_Padeg" else -value if key == "modulus_db" else value
    assert found.solution.objective_db == pytest.approx(expected, abs=WITHIN)


def test_a_certificate_has_its_recorded_margins() -> None:
    for what, values in certified().items():
        assert values == pytest.approx(recorded()[CERTIFIED][what], abs=WITHIN_DB), what


if __name__ == "__main__":
    found = {name: measured(name) for name in DESIGNS} | {CERTIFIED: certified()}
    RECORD.write_text(json.dumps(found, indent=1) + "\n")
