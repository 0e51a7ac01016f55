"""The ledger of attempts: every verification of a vehicle, with its verdict, written before the verdict is shown.

The ledger is a file of JSON lines for all vehicles, in the user's data folder and thus independent of `--out`. Each
line contains the hash of the previous line, so that an edited line, or a line removed from the middle, is detected. A
deletion of the whole file, or of its end, is not detected, but earlier review packs contain copies.

A vehicle is identified by its name and by its content. A copy under another name and a version with a changed number
therefore share its ledger.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import json
import os
import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from maxq.design.verify.memory import content_hash
from maxq.sim.files import write_whole
from maxq.sim.scenario.loader import told
from maxq.sim.scenario.schema_vehicle import Vehicle

if sys.platform != "win32":
    import fcntl

BEGUN, ENDED, REGISTERED = "begun", "ended", "registered"
INTERRUPTED = "not ended"
UNDER_TEST = frozenset({"law", "library", "python", "sources", "data", "settings", "timeout_s", "guard"})
"""The keys of a computer that belong to the flight code, which is under test."""
_WORDS = frozenset({"schema", "name", "description", "source", "file"})
_REFERENCES = frozenset({"group", "tank"})  # keys that refer to the name of a part
_LISTED = 5  # most verdicts listed on the first page; a larger number is summarised

Line = dict[str, Any]


def ledger_path() -> Path:
    """Return the path of the ledger: in `$MAXQ_LEDGER`, or else in `maxq/attempts` in the user's data folder."""
    data = os.environ.get("XDG_DATA_HOME") or os.path.join(os.path.expanduser("~"), ".local", "share")
    return Path(os.environ.get("MAXQ_LEDGER") or os.path.join(data, "maxq", "attempts")) / "attempts.jsonl"


def vehicle_hash(vehicle: Vehicle) -> str:
    """Return the SHA-256 of a vehicle's numbers, without its flight code.

    Names, descriptions, sources and file names are excluded. A reference to a name is replaced by the order of its
    first occurrence.
    """
    names = list[str]()

    def kept(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            out = _WORDS | UNDER_TEST if key == "computer" else _WORDS
            return {k: kept(v, k) for k, v in value.items() if k not in out}
        if isinstance(value, str) and value and key in _REFERENCES:
            names.extend([value] * (value not in names))
            return names.index(value)
        return [kept(v, key) for v in value] if isinstance(value, list) else value

    return content_hash(kept(told(vehicle)))


def _hash(line: Mapping[str, Any]) -> str:
    content = {key: value for key, value in line.items() if key != "hash"}
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def read_lines(path: Path) -> tuple[list[Line], tuple[str, ...]]:
    """Return the lines of a ledger, and a sentence for each break in its chain of hashes.

    A missing file has no lines. Raises OSError if the file cannot be read.
    """
    lines, damage, previous = list[Line](), list[str](), ""
    text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
    for number, row in enumerate(text.splitlines(), 1):
        try:
            line = json.loads(row)
            whole, follows = line["hash"] == _hash(line), line["previous"] == previous
        except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
            damage.append(f"line {number} is no line of a ledger")
            continue
        if not follows:
            damage.append(f"lines before line {number} were removed or changed")
        if not whole:
            damage.append(f"line {number} was changed")
        else:
            lines.append(line)
        previous = line["hash"]
    return lines, tuple(damage)


@contextlib.contextmanager
def _locked(path: Path) -> Iterator[None]:
    """Lock the ledger against other processes, on systems with file locks."""
    if sys.platform == "win32":
        yield
        return
    path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    handle = os.open(path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def lines_of(lines: Sequence[Line], vehicle: str, content: str) -> list[Line]:
    """Return the lines of attempts and registrations for a vehicle, oldest first.

    A line belongs to the vehicle if it has its name or its `content` (`vehicle_hash`), or a name or content that occurs
    together with one of them in another line.
    """
    every = [line for line in lines if line.get("state") in (BEGUN, REGISTERED)]
    names, contents = {vehicle}, {content}
    while True:
        mine = [line for line in every if line.get("vehicle") in names or line["hashes"]["vehicle"] in contents]
        before = len(names) + len(contents)
        names.update(line["vehicle"] for line in mine if "vehicle" in line)
        contents.update(line["hashes"]["vehicle"] for line in mine)
        if len(names) + len(contents) == before:
            return mine


def append(path: Path, content: Mapping[str, Any]) -> Line:
    """Append a line to a ledger, with date and hash chain, and return it. The file is replaced as a whole.

    Raises FileError if the ledger cannot be written, and OSError if it cannot be read or locked.
    """
    with _locked(path):
        text = path.read_text(encoding="utf-8", errors="replace") if path.exists() else ""
        lines, _ = read_lines(path)
        date = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        line = {"previous": lines[-1]["hash"] if lines else "", "date": date, **content}
        line["hash"] = _hash(line)
        text += "\n" if text and not text.endswith("\n") else ""
        write_whole(path, f"{text}{json.dumps(line)}\n", durable=True)
    return line


@dataclass(frozen=True)
class PastAttempt:
    """An attempt in the ledger. The `verdict` of an interrupted or running attempt is "not ended"."""

    date: str
    vehicle: str  # name of the vehicle
    design: str
    suite: str
    part: str  # part that was verified alone, or ""
    verdict: str
    seeds: dict[str, int]
    hashes: dict[str, str]
    command: str


@dataclass(frozen=True)
class Attempt:
    """A verification in the ledger, and the other attempts for its vehicle.

    `others` are attempts for the same vehicle, without repetitions. `versions` are attempts for other versions of the
    vehicle (`lines_of`). `further` are the names of other vehicles in the ledger. `damage` describes breaks in its
    chain.
    """

    number: int = 1
    repeated: bool = False
    others: tuple[PastAttempt, ...] = ()
    versions: tuple[PastAttempt, ...] = ()
    further: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()
    vehicle: str = ""
    since: str = ""  # date of the vehicle's first line
    line: Line = field(default_factory=dict, repr=False)
    path: Path = field(default=Path(), repr=False)

    @property
    def whole(self) -> list[PastAttempt]:
        """Return the other attempts that used a whole suite."""
        return [one for one in self.others if not one.part]

    @property
    def title(self) -> str:
        """Return one line of text: the number of the attempt, and the verdicts of the others."""
        whole, alone = self.whole, len(self.others) - len(self.whole)
        verdicts = [one.verdict.upper() for one in whole]
        said = ", ".join(verdicts)
        if len(verdicts) > _LISTED:
            said = ", ".join(f"{count} {verdict}" for verdict, count in Counter(verdicts).items())
        plural = "s" * (len(whole) != 1)
        if self.line.get("part"):
            texts = [f"a part alone; {len(whole)} attempt{plural} for this vehicle{': ' if whole else ''}{said}"]
        elif self.repeated:
            texts = [f"attempt {self.number} of {len(whole) + 1} for this vehicle, repeated"]
            texts += [f"{len(whole)} other{plural}: {said}"] if whole else []
        else:
            texts = [f"attempt {self.number} for this vehicle"]
            texts += [f"{len(whole)} earlier one{plural}: {said}"] if whole else []
        texts += [f"{alone} of part{'s' * (alone != 1)} alone"] if alone else []
        texts += [f"{len(self.versions)} for other versions of {self.vehicle}"] if self.versions else []
        names = [
            name for name in dict.fromkeys(p.vehicle for p in (*self.others, *self.versions)) if name != self.vehicle
        ]
        texts += [f"also under the name {' and '.join(names)}"] if names else []
        texts += [f"further vehicles in the ledger: {', '.join(self.further)}"] if self.further else []
        texts += [f"LEDGER DAMAGED: {text}" for text in self.damage]
        return "; ".join(texts)

    @property
    def date(self) -> str:
        """Return the day on which the attempt began, UTC, YYYY-MM-DD."""
        return str(self.line["date"])[:10]

    def end(self, verdict: str, met: str = "") -> None:
        """Write the end of the attempt to the ledger. Raises FileError."""
        append(self.path, {"state": ENDED, "attempt": self.line["hash"], "verdict": verdict, "met": met})


def attempts_in(lines: Sequence[Line]) -> dict[str, list[PastAttempt]]:
    """Return the attempts in a ledger, each with its repetitions, by the hash of all their inputs."""
    verdicts = {line.get("attempt"): str(line.get("verdict")) for line in lines if line.get("state") == ENDED}
    out: dict[str, list[PastAttempt]] = {}
    for line in lines:
        if line.get("state") == BEGUN:
            kept = {
                key: line[key] for key in ("date", "vehicle", "design", "suite", "part", "seeds", "hashes", "command")
            }
            past = PastAttempt(**kept, verdict=verdicts.get(line["hash"], INTERRUPTED))
            out.setdefault(past.hashes["all"], []).append(past)
    return out


def begin(vehicle: str, content: Mapping[str, Any]) -> Attempt:
    """Write the beginning of an attempt to the ledger, and return it with the other attempts for the vehicle.

    `vehicle` is the name of the vehicle. `content` contains `design`, `suite`, `part`, `seeds`, `command`, and `hashes`
    with `vehicle` and `all`. Raises FileError or OSError if the ledger cannot be written, since every verdict requires
    its line.
    """
    path = ledger_path()
    line = append(path, {"state": BEGUN, "vehicle": vehicle, **content})
    return attempt_of(line, *read_lines(path), path)


def attempt_of(line: Line, lines: Sequence[Line], damage: tuple[str, ...], path: Path = Path()) -> Attempt:
    """Return the attempt that begins with a line of a ledger, with the other attempts that began before it."""
    lines = lines[: [each["hash"] for each in lines].index(line["hash"]) + 1]
    family = lines_of(lines, line["vehicle"], line["hashes"]["vehicle"])
    names, ends = {each.get("vehicle", "") for each in family}, [each for each in lines if each.get("state") == ENDED]
    further = dict.fromkeys(each["vehicle"] for each in lines if each.get("vehicle", "") not in {"", *names})
    known, mine = attempts_in([*family, *ends]), line["hashes"]["all"]
    same, other = list[tuple[str, PastAttempt]](), list[PastAttempt]()
    for key, repeats in known.items():
        past = [past for past in repeats if past.verdict != INTERRUPTED or past is repeats[0]][-1]
        if past.hashes["vehicle"] == line["hashes"]["vehicle"]:
            same.append((key, past))
        else:
            other.append(past)
    order = [key for key, past in same if not past.part or key == mine]
    return Attempt(
        order.index(mine) + 1,
        len(known[mine]) > 1,
        tuple(past for key, past in same if key != mine),
        tuple(other),
        tuple(further),
        damage,
        line["vehicle"],
        family[0]["date"],
        line,
        path,
    )
