"""`simverify --check PACK`: a pack verified by someone else: hashes, signature, ledger, and a sample computed again.

The inputs are loaded by the names in the pack, from this machine. A random sample of the flights, operating points and
campaign runs is computed again and compared with the pack, bit by bit.
"""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from maxq.design import operating_points
from maxq.design.certificate.certificate import certify_node
from maxq.design.certificate.measured_only import measure_node
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop, law_at
from maxq.design.model.node import Node
from maxq.design.verify import flown, ledger, seeds
from maxq.design.verify import suite as suites
from maxq.design.verify.linear import measured
from maxq.design.verify.memory import PartsOnDisk
from maxq.design.verify.names import node_name
from maxq.design.verify.parts import Parts
from maxq.design.verify.verify import Prepared, missing_of, part_alone, prepare
from maxq.design.verify.waivers import apply_waivers
from maxq.sim.campaign.analysis import DataSet
from maxq.sim.campaign.store import MANIFEST, parts_in
from maxq.sim.scenario.loader import LoadedScenario
from maxq.tools.cli.frame import CommandError, Exit
from maxq.tools.cli.terminal import Progress, printable, tell
from maxq.tools.design.report import plain_record
from maxq.tools.verify.records import ATTEMPTS_NAME, campaign_folder
from maxq.tools.verify.report import FLIGHT, VERDICT_NAME, certificate_record, measured_record
from maxq.tools.verify.run import design_name
from maxq.tools.verify.signing import SUFFIX, signer

Job = tuple[str, Any, Callable[[], Any]]
"""A name, the record in the pack, and a function that computes it again."""


_KEYS = {"verdict": "judgement"}  # of a requirement
SAMPLE = 5
"""Flights, operating points and runs that are computed again, of each."""


@dataclass
class Findings:
    """The agreements and differences of a pack, a sentence each."""

    agrees: list[str] = field(default_factory=list)
    differs: list[str] = field(default_factory=list)

    def add(self, same: bool, text: str, otherwise: str = "") -> None:
        (self.agrees if same else self.differs).append(text if same else otherwise or text)


def execute(
    check: str,
    designs: Sequence[str] = (),
    *,
    suite: str | None = None,
    vehicle: str | None = None,
    sample: int = SAMPLE,
    allowed: str | None = None,
) -> int:
    """Check a pack, print agreements and differences, and return the exit code.

    The arguments are the options of `simverify`; design, suite and vehicle are in place of those that the pack names.
    Raises CommandError or ScenarioError for what cannot be read.
    """
    pack = Path(check)
    folder = pack if pack.is_dir() else pack.parent
    record, found = _read(folder / VERDICT_NAME if pack.is_dir() else pack), Findings()
    if len(designs) > 1:
        raise CommandError("a pack is of one design")
    given = {"design": design_name(designs[0]) if designs else None, "suite": suite, "vehicle": vehicle}
    seed = random.SystemRandom().randrange(2**32)
    try:
        _signature(folder, Path(allowed) if allowed is not None else None, found)
        _files(folder, record, found)
        _ledger(folder, record, found)
        with Progress() as progress:
            prepared = _prepared(record["asked"] | {k: value for k, value in given.items() if value is not None})
            _verdict(record, prepared, folder, found)
            if _hashes(record, prepared, found):
                _sample(record, prepared, folder, sample, random.Random(seed), found, progress)
            else:
                found.differs.append("nothing was computed again: the inputs are others")
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        raise CommandError(f"{pack}: no verdict.json of this version of simverify ({error})") from error
    tell(
        f"{pack}: {record['verdict'].upper()} by the suite {record['suite']}; sample of {sample}, drawn by seed {seed}"
    )
    tell(*(f"  agrees: {printable(text)}" for text in found.agrees))
    tell(*(f"  DIFFERS: {printable(text)}" for text in found.differs))
    count = len(found.differs)
    tell("", f"CHECK FAILED: {count} difference{'s' * (count != 1)}" if count else "CHECK PASSED")
    return Exit.FAILED if count else Exit.OK


def _read(path: Path) -> dict[str, Any]:
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise CommandError(f"{path}: cannot be read: {(error.strerror or str(error)).lower()}") from None
    except ValueError as error:
        raise CommandError(f"{path}: is no JSON: {error}") from None
    missing = [
        k for k in ("asked", "files", "hashes", "attempt", "flights") if not isinstance(record, dict) or k not in record
    ]
    if missing:
        raise CommandError(f"{path}: no verdict.json that can be checked: it has no {missing[0]}")
    return dict(record)


def _signature(folder: Path, allowed: Path | None, found: Findings) -> None:
    file = folder / VERDICT_NAME
    if file.with_name(file.name + SUFFIX).exists():
        good, said = signer(file, allowed)
        found.add(good, f"signature: {said}")
    else:
        found.add(allowed is None, "signature: the pack has none")


def _files(folder: Path, record: dict[str, Any], found: Findings) -> None:
    for name, known in record["files"].items():
        path = folder / name
        if not path.resolve().is_relative_to(folder.resolve()) or not path.is_file():
            found.differs.append(f"file {name}: is missing")
        elif hashlib.sha256(path.read_bytes()).hexdigest() != known:
            found.differs.append(f"file {name}: its SHA-256 is another")
    wrong = sum(text.startswith("file ") for text in found.differs)
    found.agrees.append(f"{len(record['files']) - wrong} of {len(record['files'])} files of the pack, by their SHA-256")


def _ledger(folder: Path, record: dict[str, Any], found: Findings) -> None:
    """Check the copy of the ledger, and this machine's ledger where that contains the attempt."""
    lines, damage = ledger.read_lines(folder / ATTEMPTS_NAME)
    found.differs += [f"ledger of attempts: {text}" for text in damage]
    hashes, attempt = [line["hash"] for line in lines], record["attempt"]
    begun = [line for line in lines if line["hash"] == attempt["line"]]
    ended = [line["verdict"] for line in lines if line.get("attempt") == attempt["line"]]
    text = ledger.attempt_of(begun[0], lines, damage).title if begun else ""
    found.add(
        (text, ended) == (attempt["text"], [record["verdict"]]),
        f"ledger of attempts: {text}",
        "ledger of attempts: its copy in the pack does not contain this attempt, its number or its verdict",
    )
    if lines and (own := ledger.ledger_path(lines[0].get("vehicle", ""))).exists():
        here = {line["hash"] for line in ledger.read_lines(own)[0]}
        lost = len(set(hashes) - here)
        if here & set(hashes):
            found.add(
                not lost,
                "ledger of this machine: contains all lines of the pack",
                f"ledger of this machine: lacks {lost} lines of the pack",
            )


def _prepared(asked: dict[str, Any]) -> Prepared:
    """Load all that the pack names. Raises ScenarioError."""
    loaded, kept = suites.read_suite(asked["suite"], asked["overrides"]), PartsOnDisk(None)
    if asked["part"]:
        loaded = part_alone(loaded, asked["part"], asked["design"], asked["vehicle"], kept)
    return prepare(asked["design"], loaded, asked["vehicle"], kept)


def _hashes(record: dict[str, Any], prepared: Prepared, found: Findings) -> bool:
    """Compare the hashes of all that the verdict depends on; return True where only the code of maxq may differ."""
    before, now = record["hashes"], prepared.hashes
    wrong = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    found.agrees.append(f"{len(now) - len(set(wrong) & set(now))} of {len(before)} inputs, by their SHA-256")
    found.differs += [f"input: {name}" if name != "code" else "code: another version of maxq" for name in wrong]
    return not set(wrong) - {"code"}


def _verdict(record: dict[str, Any], prepared: Prepared, folder: Path, found: Findings) -> None:
    """Compare the verdict with the requirements, their waivers, and the flights of the pack.

    Waivers are those of the suite, on the day of the attempt in the ledger.
    """
    rows = [suites.JudgedRequirement(**{_KEYS.get(k, k): v for k, v in row.items()}) for row in record["requirements"]]
    begun = [line for line in ledger.read_lines(folder / ATTEMPTS_NAME)[0] if line["hash"] == record["attempt"]["line"]]
    date, board = (begun[0]["date"][:10] if begun else ""), prepared.loaded.suite.board
    plain = [replace(row, waived="") for row in rows]
    waived, _ = apply_waivers(plain, board, date, bool(record["missing_evidence"]))
    same = suites.overall(waived, record["missing_evidence"]) == record["verdict"]
    same &= [row.waived for row in waived] == [row.waived for row in rows]
    passed = {flight["name"]: flight["passed"] for flight in record["flights"]}
    scenarios = [row for row in rows if row.part == "scenarios" and row.name in passed]
    same &= all((row.judgement == suites.ACCEPTED) == passed[row.name] for row in scenarios)
    found.add(
        same, "the verdict, by the requirements in the pack", "the verdict: it does not follow from the requirements"
    )


def _sample(
    record: dict[str, Any],
    prepared: Prepared,
    folder: Path,
    most: int,
    draw: random.Random,
    found: Findings,
    progress: Progress,
) -> None:
    """Recompute a random sample of each kind of result, and judge the campaigns of the pack again."""
    suite = prepared.loaded.suite
    changes, first = flown.design_changes(prepared.design, prepared.vehicle), next(iter(prepared.campaigns), None)
    job = Parts(suite, prepared.scenario, prepared.along, PartsOnDisk(None), progress.show, 1, first, changes)
    _floor(record, prepared, job, folder, found)
    jobs = {
        "flights": _flights(record, prepared, found),
        "operating points": _points(record, prepared, job, found),
        "runs": [],
    }
    judged = list[suites.JudgedRequirement]()
    places = [campaign_folder(folder, n) for n in range(len(suite.campaign))]
    parts = [path for place in places for path in (place / MANIFEST, *(part.path for part in parts_in(place)))]
    if all(path.relative_to(folder).as_posix() in record["files"] for path in parts):
        for place, wanted, campaign in zip(places, suite.campaign, prepared.campaigns, strict=False):
            data = DataSet(place, campaign, campaign.campaign.runs)
            name = f"of {campaign.name}"
            jobs["runs"] += [(f"{run} {name}", True, partial(flown.same_run, data, run)) for run in data.runs.tolist()]
            judged += flown.campaign_requirements(flown.result_of(wanted, campaign, place))
        found.add(
            _said(plain_record([vars(r) for r in judged])) == _said(record["requirements"]),
            f"verdicts of {len(places)} campaigns, by the {len(jobs['runs'])} runs in the pack",
            "verdicts of the campaigns: the runs in the pack give others",
        )
    else:
        found.differs.append("campaigns: their runs are not in the pack")
    for kind, every in jobs.items():
        chosen, good = draw.sample(every, min(most, len(every))), list[str]()
        for done, (name, known, compute) in enumerate(chosen):
            progress.show(f"{kind} computed again", done, len(chosen))
            if plain_record(compute()) == known:
                good.append(name)
            else:
                found.differs.append(f"{kind.removesuffix('s')} {name}: computed again, it is another")
        if chosen:
            found.agrees.append(f"{len(good)} of {len(every)} {kind}, computed again: {', '.join(good)}")


def _said(rows: Sequence[dict[str, Any]]) -> list[tuple[Any, ...]]:
    """Return the name, wanted, found and verdict of the requirements of campaigns."""
    mine = (row for row in rows if row["part"] == "campaign")
    return [(row["name"], row["wanted"], row["found"], row.get("verdict", row.get("judgement"))) for row in mine]


def _flights(record: dict[str, Any], prepared: Prepared, found: Findings) -> list[Job]:
    wanted, known = prepared.loaded.suite.flight, {flight["name"]: flight for flight in record["flights"]}
    if list(known) != [flight.name for flight in wanted]:
        found.differs.append("flights: those of the pack are not those of the suite")

    def compute(flight: suites.SuiteFlight, loaded: LoadedScenario, again: str) -> Any:
        result = flown.fly_alone(flight, loaded, again)
        return {key: getattr(result, key) for key in FLIGHT}

    return [
        (f"'{f.name}'", known[f.name], partial(compute, f, loaded, known[f.name]["again"]))
        for f, (loaded, _) in zip(wanted, prepared.flights, strict=True)
        if f.name in known
    ]


def _floor(record: dict[str, Any], prepared: Prepared, job: Parts, folder: Path, found: Findings) -> None:
    """Compare the evidence that is missing for an acceptance with that of the pack.

    Seeds count as registered by the pack's copy of the ledger. In-flight responses are taken as measured where the
    suite requires them.
    """
    lines = ledger.read_lines(folder / ATTEMPTS_NAME)[0]
    begun = [n for n, line in enumerate(lines) if line["hash"] == record["attempt"]["line"]]
    hashes, known = prepared.entry()["hashes"], [x for x in lines[: begun[0] + 1 if begun else 0] if "seeds" in x]
    drawn = seeds.chosen(prepared.seeds, known, hashes["design"])
    certificate = prepared.loaded.suite.certificate
    planes = certificate.planes if certificate is not None and certificate.in_flight else ()
    lacking = [
        text
        for text in missing_of(replace(prepared, seeds=drawn), job, planes)
        if text not in record["missing_evidence"]
    ]
    found.differs += [f"missing evidence: the pack does not list '{text}'" for text in lacking]
    found.agrees += [] if lacking else ["the evidence that is missing for an acceptance"]


def _points(record: dict[str, Any], prepared: Prepared, job: Parts, found: Findings) -> list[Job]:
    """Return the linear margins as designed, the certificates and the measurements of flight code.

    The operating points are those of the suite: a pack that lacks one differs.
    """
    scenario, design, suite = prepared.scenario, prepared.scenario.design, prepared.loaded.suite

    def linear(node: Node) -> Any:
        assert suite.margins is not None
        assert design is not None
        return measured(Loop(fixed_path(node), law_at(design, node)), suite.margins.dispersed.slosh_peak_db)

    def certificate(node: Node) -> Any:
        return certificate_record(certify_node(scenario, node))

    def code(node: Node) -> Any:
        return measured_record(measure_node(scenario, node))

    out, expected = list[Job](), dict[str, list[Node]]()
    if suite.margins is not None and design is not None and not prepared.loaded.part:
        expected["margins"] = [node for plane in suite.margins.planes for node in job.nodes(plane)]
    if suite.certificate is not None:
        times_s, planes = job.times_s(suite.certificate), suite.certificate.planes
        nodes = [node for plane in planes for node in operating_points.nodes(prepared.along, times_s, plane=plane)]
        expected["certificate" if design is not None else "measured_only"] = nodes
    margins = [
        {"time_s": time_s, "plane": study["plane"], "found": known}
        for study in record["margins"]
        for time_s, known in zip(study["times_s"], study["as_designed"], strict=True)
    ]
    for kind, nodes in expected.items():
        rows = margins if kind == "margins" else record[kind]
        known = {(row["time_s"], row["plane"]): row.get("found", row) for row in rows}
        compute = {"margins": linear, "certificate": certificate, "measured_only": code}[kind]
        if {(node.time_s, node.plane) for node in nodes} != set(known):
            found.differs.append(f"{kind}: the operating points of the pack are not those of the suite")
        out += [
            (f"{kind.replace('_', ' ')} {node_name(node)}", known[at], partial(compute, node))
            for node in nodes
            if (at := (node.time_s, node.plane)) in known
        ]
    return out
