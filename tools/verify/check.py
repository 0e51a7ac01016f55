"""`simverify --check PACK`: a pack verified by someone else: hashes, signature, ledger, and a sample computed again.

The inputs are loaded by the names in the pack, from this machine; a random sample of the flights, operating points and
campaign runs is computed again and compared with the pack, bit by bit.
"""

from __future__ import annotations

import hashlib
import json
import random
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from maxq.design import operating_points
from maxq.design.certificate.certificate import certify_node
from maxq.design.certificate.measured_only import measure_node
from maxq.design.loop.fixed_path import fixed_path
from maxq.design.loop.loop import Loop, law_at
from maxq.design.model.instruments import Plane
from maxq.design.model.node import Node
from maxq.design.verify import flown, ledger
from maxq.design.verify import suite as suites
from maxq.design.verify.linear import measured
from maxq.design.verify.memory import PartsOnDisk
from maxq.design.verify.verify import Prepared, part_alone, prepare
from maxq.sim.campaign.analysis import DataSet
from maxq.tools.cli.frame import CommandError, Exit
from maxq.tools.cli.terminal import Progress, printable, tell
from maxq.tools.design.report import plain_record
from maxq.tools.verify.records import ATTEMPTS_NAME, campaign_folder
from maxq.tools.verify.report import FLIGHT, VERDICT_NAME, certificate_record, measured_record
from maxq.tools.verify.run import design_name
from maxq.tools.verify.signing import SUFFIX, signer

Job = tuple[str, Any, Callable[[], Any]]
"""A name, the record in the pack, and a function that computes it again."""


SAMPLE = 5
"""Flights, operating points and runs that are computed again, of each."""


@dataclass
class Findings:
    """What agrees with a pack and what does not, a sentence each."""

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
    """Check a pack, print what agrees and what does not, and return the exit code.

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
            if _hashes(record, prepared, found):
                _sample(record, prepared, folder, sample, random.Random(seed), found, progress)
            else:
                found.differs.append("nothing was computed again: the inputs are others")
    except (KeyError, TypeError, AttributeError, IndexError) as error:
        raise CommandError(f"{pack}: no verdict.json of this version of simverify ({error})") from None
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
    ended = [line for line in lines if line.get("attempt") == attempt["line"]]
    whole = attempt["line"] in hashes and [line["verdict"] for line in ended] == [record["verdict"]]
    found.add(
        whole,
        f"ledger of attempts: {attempt['text']}",
        "ledger of attempts: its copy in the pack does not contain this attempt with this verdict",
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


def _sample(
    record: dict[str, Any],
    prepared: Prepared,
    folder: Path,
    most: int,
    draw: random.Random,
    found: Findings,
    progress: Progress,
) -> None:
    """Compute a sample of each kind again, and judge the campaigns of the pack again."""
    kinds = {"flight": list(_flights(record, prepared)), "operating point": list(_points(record, prepared)), "run": []}
    for n, _ in enumerate(record["campaigns"]):
        place, wanted, campaign = campaign_folder(folder, n), prepared.loaded.suite.campaign[n], prepared.campaigns[n]
        if not place.is_dir():
            found.agrees.append(f"campaign {campaign.name}: its runs are not in the pack and were not checked")
            continue
        data = DataSet(place, campaign, campaign.campaign.runs)
        name = f"of campaign {campaign.name}"
        kinds["run"] += [(f"{run} {name}", True, partial(flown.same_run, data, run)) for run in data.runs.tolist()]
        again = flown.campaign_requirements(flown.result_of(wanted, campaign, place))
        same = _judged(record["requirements"], campaign.name) == _judged(
            plain_record([vars(r) for r in again]), campaign.name
        )
        found.add(
            same,
            f"campaign {campaign.name}: {len(data.runs)} runs, judged again",
            f"campaign {campaign.name}: its runs give other verdicts",
        )
    for kind, jobs in kinds.items():
        chosen = draw.sample(jobs, min(most, len(jobs)))
        good = []
        for done, (name, known, compute) in enumerate(chosen):
            progress.show(f"{kind}s computed again", done, len(chosen))
            if plain_record(compute()) == known:
                good.append(name)
            else:
                found.differs.append(f"{kind} {name}: computed again, it is another")
        if jobs:
            found.agrees.append(f"{len(good)} of {len(jobs)} {kind}s computed again, bit by bit: {'; '.join(good)}")


def _judged(rows: Sequence[dict[str, Any]], campaign: str) -> list[tuple[Any, ...]]:
    """Return name, wanted, found and verdict of the requirements of a campaign."""
    mine = (row for row in rows if row["part"] == "campaign" and row["name"].startswith(f"{campaign}: "))
    return [(row["name"], row["wanted"], row["found"], row.get("verdict", row.get("judgement"))) for row in mine]


def _flights(record: dict[str, Any], prepared: Prepared) -> Iterator[Job]:
    for known, wanted, (loaded, _) in zip(
        record["flights"], prepared.loaded.suite.flight, prepared.flights, strict=True
    ):

        def compute(wanted: suites.SuiteFlight = wanted, loaded: Any = loaded, again: str = known["again"]) -> Any:
            flight = flown.fly_alone(wanted, loaded, again)
            return {key: getattr(flight, key) for key in FLIGHT}

        yield f"'{wanted.name}'", known, compute


def _points(record: dict[str, Any], prepared: Prepared) -> Iterator[Job]:
    """Yield the linear margins as designed, the certificates and the measurements of flight code."""
    scenario, design, wanted = prepared.scenario, prepared.scenario.design, prepared.loaded.suite.margins

    def node(time_s: float, plane: Plane) -> Node:
        (found,) = operating_points.nodes(prepared.along, [time_s], plane=plane)
        return found

    def linear(time_s: float, plane: Plane) -> Any:
        at = node(time_s, plane)
        assert wanted is not None
        assert design is not None
        return measured(Loop(fixed_path(at), law_at(design, at)), wanted.dispersed.slosh_peak_db)

    def certificate(time_s: float, plane: Plane) -> Any:
        return certificate_record(certify_node(scenario, node(time_s, plane)))

    def code(time_s: float, plane: Plane) -> Any:
        return measured_record(measure_node(scenario, node(time_s, plane)))

    for study in record["margins"]:
        plane = study["plane"]
        for time_s, known in zip(study["times_s"], study["as_designed"], strict=True):
            yield f"margins at {time_s:g} s, {plane}", known, partial(linear, time_s, plane)
    for kind, compute in (("certificate", certificate), ("measured_only", code)):
        for known in record[kind]:
            time_s, plane = known["time_s"], known["plane"]
            yield f"{kind.replace('_', ' ')} at {time_s:g} s, {plane}", known, partial(compute, time_s, plane)
