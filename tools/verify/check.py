"""`simverify --check PACK`: check another party's pack by its hashes, signature and ledger, and by recomputing a
sample.

The inputs are loaded from this machine by the names in the pack. A random sample of the flights, operating points and
campaign runs is computed again and compared with the pack, bit by bit.
"""

from __future__ import annotations

import hashlib
import json
import random
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from maxq.design import operating_points
from maxq.design.quantities import SWEPT
from maxq.design.verify import board_findings, flown, ledger, linear, seeds
from maxq.design.verify import suite as suites
from maxq.design.verify.memory import PartsOnDisk, text_of
from maxq.design.verify.parts import Parts
from maxq.design.verify.results import Results
from maxq.design.verify.suite import CERTIFICATE, WORST
from maxq.design.verify.verify import Prepared, conclude, part_alone, prepare
from maxq.sim.campaign.analysis import DataSet, unfounded
from maxq.sim.campaign.schema import campaign_title
from maxq.sim.campaign.store import MANIFEST, parts_in
from maxq.sim.input.errors import ScenarioError
from maxq.sim.run.metrics import Verdict, judge
from maxq.sim.scenario.loader import told
from maxq.tools.cli.frame import CommandError, Exit
from maxq.tools.cli.terminal import Progress, printable, tell
from maxq.tools.design.report import plain_record
from maxq.tools.verify.recomputed import Job, jobs_of
from maxq.tools.verify.records import ATTEMPTS_NAME, RESULTS_NAME, campaign_folder
from maxq.tools.verify.report import VERDICT_NAME, verdict_record, worst_name
from maxq.tools.verify.run import design_name
from maxq.tools.verify.signing import SUFFIX, signer

HERE = "./"
"""The prefix of a design file below the working folder, which distinguishes it from the name of a built-in design."""
_NOT_DERIVED = ("files", "hashes", "versions", "parts", "recalled", "wall_s", "walls_s", "cpus_s", "command")
_NAMED = ("asked", "design", "flights")  # keys that contain names or commands
SAMPLE = 5
"""The number of results of each kind that are computed again."""


@dataclass
class Findings:
    """The agreements and differences of a pack, one sentence each."""

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

    The arguments are the options of `simverify`. `designs`, `suite` and `vehicle` replace those that the pack names.
    Raises CommandError or ScenarioError for a pack or an input that cannot be read.
    """
    place = Path(check)
    folder = place if place.is_dir() else place.parent
    record, found = _read(folder / VERDICT_NAME if place.is_dir() else place), Findings()
    if len(designs) > 1:
        raise CommandError("a pack is of one design")
    given = {"design": design_name(designs[0]) if designs else None, "suite": suite, "vehicle": vehicle}
    seed = random.SystemRandom().randrange(2**32)
    try:
        _signature(folder, Path(allowed) if allowed is not None else None, found)
        _files(folder, record, found)
        _ledger(folder, record, found)
        with Progress() as progress:
            pack = _opened(folder, record, {key: value for key, value in given.items() if value is not None})
            if _hashes(record, pack.prepared, found):
                _results(pack, sample, random.Random(seed), found, progress)
            else:
                found.differs.append("nothing was derived or computed again: the inputs differ")
    except (LookupError, TypeError, AttributeError, ValueError, ArithmeticError, RecursionError) as error:
        raise CommandError(f"{place}: no verdict.json of this version of simverify ({error})") from error
    verdict, name = (printable(str(record[key])) for key in ("verdict", "suite"))  # of any type in a forged pack
    tell(f"{place}: {verdict.upper()} by the suite {name}; sample of {sample}, drawn by seed {seed}")
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
    except (ValueError, RecursionError) as error:
        raise CommandError(f"{path}: is not JSON: {error}") from None
    needed = ("asked", "files", "hashes", "attempt", "flights", "verdict", "suite")
    missing = [key for key in needed if not isinstance(record, dict) or key not in record]
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
            found.differs.append(f"file {name}: its SHA-256 differs")
    wrong = sum(text.startswith("file ") for text in found.differs)
    found.agrees.append(f"{len(record['files']) - wrong} of {len(record['files'])} files of the pack, by their SHA-256")


def _ledger(folder: Path, record: dict[str, Any], found: Findings) -> None:
    """Check the pack's copy of the ledger, and compare this machine's ledger with it if they have a line in common."""
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
    if lines and (own := ledger.ledger_path()).exists():
        here = {line["hash"] for line in ledger.read_lines(own)[0]}
        lost = len(set(hashes) - here)
        if here & set(hashes):
            found.add(
                not lost,
                "ledger of this machine: contains all lines of the pack",
                f"ledger of this machine: lacks {lost} lines of the pack",
            )


@dataclass(frozen=True)
class Pack:
    """A pack with its inputs, loaded by their names, and its attempt in the pack's copy of the ledger.

    `entry` is the content that the attempt's line should have by these inputs. `replaced` is True if the user named
    inputs.
    """

    folder: Path
    record: dict[str, Any]
    prepared: Prepared
    entry: dict[str, Any]
    attempt: ledger.Attempt
    replaced: bool


def _opened(folder: Path, record: dict[str, Any], given: dict[str, Any]) -> Pack:
    """Load all inputs that the pack names. `given` replaces names. Raises ScenarioError."""
    asked = record["asked"] | given
    design, loaded, kept = asked["design"], suites.read_suite(asked["suite"], asked["overrides"]), PartsOnDisk(None)
    if design.startswith(HERE):
        design = str(Path(design).resolve())
    if asked["part"]:
        loaded = part_alone(loaded, asked["part"], design, asked["vehicle"], kept)
    lines, damage = ledger.read_lines(folder / ATTEMPTS_NAME)
    begun = next((line for line in lines if line["hash"] == record["attempt"]["line"]), None)
    prepared = prepare(design, loaded, asked["vehicle"], kept, begun["candidate"] if begun is not None else 0)
    entry = prepared.entry()
    if begun is None:  # reported as a difference by `_ledger`
        return Pack(folder, record, prepared, entry, ledger.Attempt(line={"date": "", "hash": ""}), bool(given))
    known = ledger.lines_of(lines[: lines.index(begun)], begun["vehicle"], begun["hashes"]["vehicle"])
    drawn = seeds.chosen(prepared.seeds, known, entry["hashes"]["design"])
    attempt = ledger.attempt_of(begun, lines, damage)
    return Pack(folder, record, replace(prepared, seeds=drawn), entry, attempt, bool(given))


def _hashes(record: dict[str, Any], prepared: Prepared, found: Findings) -> bool:
    """Compare the hashes of all inputs of the verdict. Return True if at most the code of maxq differs."""
    before, now = record["hashes"], prepared.hashes
    wrong = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    found.agrees.append(f"{len(now) - len(set(wrong) & set(now))} of {len(before)} inputs, by their SHA-256")
    found.differs += [f"input: {name}" if name != "code" else "code: another version of maxq" for name in wrong]
    return not set(wrong) - {"code"}


def _results(pack: Pack, most: int, draw: random.Random, found: Findings, progress: Progress) -> None:
    """Derive the record of the pack from its results, and repeat the computation of a sample of the results."""
    job, files = pack.prepared.parts(PartsOnDisk(None), progress.show, 1), pack.record["files"]
    places = [campaign_folder(pack.folder, n) for n in range(len(pack.prepared.loaded.suite.campaign))]
    parts = [path for place in places for path in (place / MANIFEST, *(part.path for part in parts_in(place)))]
    if RESULTS_NAME not in files:
        found.differs.append(f"results: the pack has no {RESULTS_NAME}: nothing was derived or computed again")
        return
    if not all(path.relative_to(pack.folder).as_posix() in files for path in parts):
        found.differs.append("campaigns: their runs are not in the pack: nothing was derived or computed again")
        return
    try:
        results = Results.from_bytes((pack.folder / RESULTS_NAME).read_bytes())
    except (OSError, ValueError) as error:
        found.differs.append(f"results: {RESULTS_NAME} cannot be read: {error}")
        return
    if pack.attempt.line["date"] and pack.record["hashes"] == pack.prepared.hashes:  # only for the same version of maxq
        names = [key for key in ("suite", "part", "seeds", "hashes") if pack.entry[key] != pack.attempt.line[key]]
        found.differs += [f"ledger of attempts: {name} of the attempt: not of these inputs" for name in names]
    before = len(found.differs)
    data = _derived(pack, results, job, found)
    if any(text.startswith("results: ") for text in found.differs[before:]):
        found.differs.append("nothing was computed again: the results are not those of the suite")
        return
    _sample(jobs_of(pack.prepared, results, job, data), most, draw, found, progress)


def _names(results: Results) -> dict[str, Any]:
    """Return the identities of all results in the pack: flights with their requirements, operating points, vehicles."""
    return {
        "flights": [(f.name, f.counts, [told(v.requirement) for v in f.verdicts]) for f in results.flights],
        "margins": [
            (m.plane, m.stage, m.times_s, [c.label for c in m.corners], m.first, np.shape(m.random))
            for m in results.margins
        ],
        "worst vehicles": [(w.plane, w.stage) for w in results.worst],
        "certificate": sorted((c.time_s, c.plane) for c in results.certificates),
        "measured only": sorted((n.time_s, n.plane) for n in results.measured),
        "in-flight responses": sorted((r.time_s, r.plane) for r in results.in_flight),
        "control authority": [a.time_s for a in results.authority],
    }


def _wanted_names(prepared: Prepared, job: Parts, results: Results) -> dict[str, Any]:
    """Return the identities of the results that the suite requires.

    In-flight responses are required at the operating points whose results are stable.
    """
    suite, margins, design = prepared.loaded.suite, job.suite.margins, job.design
    alone = margins is not None and margins.only in (WORST, CERTIFICATE)
    parts = list(job.by_stage("", margins)) if margins is not None and design is not None and not alone else []
    studies = []
    for nodes, stage, _ in parts:
        assert margins is not None
        corners, drawn = linear.vehicles(margins, nodes[0], job.described.at(nodes[0]))
        first = int(drawn[0].label.removeprefix("vehicle ")) if drawn else 0
        shape, at_s = (len(drawn), len(nodes), len(SWEPT)), tuple(node.time_s for node in nodes)
        studies.append((nodes[0].plane, stage, at_s, [c.label for c in corners], first, shape))
    certificate, points = suite.certificate, list[tuple[float, str]]()
    if certificate is not None:
        times_s = job.times_s(certificate)
        nodes_of = [operating_points.nodes(job.along, times_s, plane=plane) for plane in certificate.planes]
        points = [(node.time_s, node.plane) for nodes in nodes_of for node in nodes]
    responses: list[tuple[float, str]]
    if design is None:
        responses = [(t, plane) for plane, held in job.held_responses(results.measured).items() for t in held]
    else:
        times = job.in_flight_times_s(results.certificates)
        responses = [(t, plane) for plane in (certificate.planes if certificate is not None else ()) for t in times]
    flights = zip(suite.flight, prepared.flights, strict=True)
    return {
        "flights": [
            (f.name, f.design_must_keep, [told(r) for r in one.scenario.requirement]) for f, (one, _) in flights
        ],
        "margins": studies,
        "worst vehicles": [(part.nodes[0].plane, part.stage) for part in job.worst_parts()],
        "certificate": sorted(points) if design is not None else [],
        "measured only": sorted(points) if design is None else [],
        "in-flight responses": sorted(responses),
        "control authority": [] if alone else job.authority_times_s(),
    }


def _judged_again(v: Verdict, metrics: Mapping[str, float]) -> Verdict:
    return judge(v.requirement, metrics, {v.requirement.metric: v.time_s})


def _derived(pack: Pack, results: Results, job: Parts, found: Findings) -> list[DataSet]:
    """Derive the whole record from the results and runs in the pack, and compare it. Return the data sets of the
    campaigns.

    The list is empty if the results are not those that the suite requires.
    """
    prepared, record = pack.prepared, pack.record
    wanted = plain_record(_wanted_names(prepared, job, results))
    wrong = [name for name, places in plain_record(_names(results)).items() if places != wanted[name]]
    found.differs += [f"results: {name}: their places or limits are not those of the suite" for name in wrong]
    for f in results.flights:
        odd = [v.name for v in f.verdicts if text_of(_judged_again(v, f.metrics)) != text_of(v)]
        found.differs += [f"results: flight '{f.name}': {name} does not follow from its metric" for name in odd]
    if wrong:
        return []
    suite, data, campaigns = prepared.loaded.suite, list[DataSet](), list[flown.CampaignResult]()
    for n, (asked, campaign) in enumerate(zip(suite.campaign, prepared.campaigns, strict=False)):
        place = campaign_folder(pack.folder, n)
        data.append(DataSet(place, campaign, campaign.campaign.runs))
        campaigns.append(flown.result_of(asked, campaign, place))
    kinds = board_findings.kinds_of(prepared.campaigns, campaigns)
    stated = record["campaigns"] if len(record["campaigns"]) == len(campaigns) else []
    campaigns = [replace(c, folder=Path(old["folder"])) for c, old in zip(campaigns, stated, strict=False)]
    again = conclude(prepared, job, results, campaigns, kinds, pack.attempt)
    given = str(record["command"])
    derived = json.loads(json.dumps(plain_record(verdict_record(again, given))))
    mine = {key: value for key, value in record.items() if key not in _NOT_DERIVED}
    derived = {key: value for key, value in derived.items() if key not in _NOT_DERIVED}
    if pack.replaced:
        mine, derived = ({k: v for k, v in each.items() if k not in _NAMED} for each in (mine, derived))
    for each in (mine, derived):
        each["requirements"] = _by_name(each["requirements"], pack.replaced)
    differences = list(compared(mine, derived))
    found.differs += differences
    if not differences:
        rows = len(record["requirements"])
        found.agrees.append(f"verdict and {rows} requirements, derived again from the results in the pack")
    for one in data:
        odd = [f"{campaign_title(one.campaign.name)}: {text}" for text in unfounded(one)]
        found.differs += odd
        if not odd:
            found.agrees.append(f"success of {len(one.runs)} runs of {one.campaign.name}, by their metrics")
    if not pack.replaced:
        found.add(
            _is_command(shlex.split(given), prepared),
            "the command, by its inputs",
            f"command: is not that of the inputs: {given}",
        )
    for w in results.worst:
        path = pack.folder / worst_name(w)
        if not path.is_file() or path.read_text(encoding="utf-8") != w.text:
            found.differs.append(f"file {path.name}: is not the worst vehicle of the results")
    return data


def _is_command(words: Sequence[str], prepared: Prepared) -> bool:
    """Return True if the words are the command for these inputs: the design by any of its names, suite, overrides and
    part.
    """
    given, part = prepared.loaded, prepared.loaded.part
    try:
        if design_name(words[1]) != prepared.design:
            return False
    except (IndexError, ScenarioError):
        return False
    wanted = shlex.split(given.command(words[1], prepared.vehicle, *(("--only", part) if part else ())))
    more = list(words[len(wanted) :])
    return list(words[: len(wanted)]) == wanted and (not more or (len(more) == 2 and more[0] == "--out"))


def _by_name(rows: Sequence[dict[str, Any]], replaced: bool) -> dict[str, Any]:
    """Return requirements by name and part, with repeated names numbered and commands split into words.

    The commands are None if the user `replaced` inputs.
    """
    out = dict[str, Any]()
    for row in rows:
        name = f"{row['name']} ({row['part']})"
        count = sum(known.partition(" #")[0] == name for known in out)
        again = None if replaced else shlex.split(str(row["again"]))
        out[f"{name} #{count + 1}" if count else name] = row | {"again": again}
    return out


def compared(pack: Any, derived: Any, path: str = "") -> Iterator[str]:
    """Yield a sentence for each difference between a record and the derived record, both as parsed from JSON."""
    if isinstance(pack, dict) and isinstance(derived, dict):
        for key in dict.fromkeys([*derived, *pack]):
            where = f"{path}: {key}" if path else key
            if key not in pack:
                yield f"{where}: the pack lacks it"
            elif key not in derived:
                yield f"{where}: does not follow from the results"
            else:
                yield from compared(pack[key], derived[key], where)
    elif isinstance(pack, list) and isinstance(derived, list) and len(pack) == len(derived):
        for n, (a, b) in enumerate(zip(pack, derived, strict=True)):
            yield from compared(a, b, f"{path} {n + 1}")
    elif isinstance(pack, list) and isinstance(derived, list):
        yield f"{path}: {len(pack)} in the pack, {len(derived)} by the results"
    elif pack != derived or isinstance(pack, bool) != isinstance(derived, bool):
        yield f"{path}: {json.dumps(pack)} in the pack, {json.dumps(derived)} by the results"


def _sample(
    every: Mapping[str, Sequence[Job]], most: int, draw: random.Random, found: Findings, progress: Progress
) -> None:
    """Compute at most `most` random results of each kind again."""
    for kind, jobs in every.items():
        chosen, good = draw.sample(jobs, min(most, len(jobs))), list[str]()
        for done, (name, known, compute) in enumerate(chosen):
            progress.show(f"{kind} computed again", done, len(chosen))
            if text_of(compute()) == text_of(known):
                good.append(name)
            else:
                one = "search" if kind == "searches" else kind.removesuffix("s")
                found.differs.append(f"{one} {name}: computed again, it differs")
        if chosen:
            found.agrees.append(f"{len(good)} of {len(jobs)} {kind}, computed again: {', '.join(good)}")
