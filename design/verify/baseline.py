"""The comparison of a suite with its baseline, an agreed suite: each difference in resolved content, and its kind.

The key `baseline` names the baseline. The default is the shipped suite that the suite extends or equals, or else
`standard`. Limits, levels, flights, campaigns, winds, vehicle and switches are compared as resolved, including the
contents of files. A copy under another name therefore has no differences.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from textwrap import shorten
from typing import Any

from maxq.design.quantities import MEASURED
from maxq.design.verify.memory import content_hash
from maxq.design.verify.suite import LoadedSuite, Suite, SuiteFlight, read_suite
from maxq.sim.campaign.read import load_campaign
from maxq.sim.input.documents import parse_override
from maxq.sim.input.files import builtin_files
from maxq.sim.input.tables_csv import DATE_KEY, FILE_KEY
from maxq.sim.scenario.loader import load_scenario, told
from maxq.sim.scenario.schema_scenario import Switches

OFF, EXCUSED, REMOVED = "physics switched off", "design_must_keep = false", "removed"
SEED, WAIVED = "seed chosen by hand", "requirement waived"
LOOSENED, SPREAD, LOWERED, SHORTENED = "limit loosened", "spread reduced", "level or number lowered", "shortened"
WEAKER = "wind weaker"
CHANGED, STRICTER = "changed", "added or stricter"
KINDS = (OFF, WAIVED, EXCUSED, SEED, REMOVED, LOOSENED, SPREAD, WEAKER, LOWERED, SHORTENED, CHANGED, STRICTER)
"""The kinds of differences, in the order of their listing."""

_HARMLESS = frozenset({WAIVED, SEED, STRICTER})
"""The kinds that do not loosen a suite. Separate rules apply to waivers and seeds."""
_FLOORED = frozenset({"runs", "cases", "nodes_per_stage", "starts"})
"""The numbers that may be lower than in the baseline. The floor has a minimum for all of them except `starts`."""
_LEVELS = frozenset({"success", "confidence"})  # the floor has the levels of the shipped suites
_ENDS = frozenset({"burnout", "impact"})  # ends of a whole flight; the burnout is that of the last stage
SCREENINGS = frozenset({"quick"})
"""The shipped suites that cannot accept a design. The rules of `standard` apply to suites that extend them."""
ACCEPTING, BASE = "standard", "launcher"
_OF_CAMPAIGN = re.compile(r"^campaign \S+: ")
_MOST_NAMED, _LONGEST = 3, 120  # loosened keys in a line of text, and characters per key

_WORDS = frozenset({"why", "description", "name", "schema", "schema_version", "source", "log", "design"})
"""The keys that do not affect a verdict, and the design, which is under test."""
_COUNTS = frozenset({"success", "confidence", "availability", "runs", "cases", "trajectories", "nodes_per_stage"})
_COUNTS |= {"corner_sigmas", "sigmas", "starts", "in_flight", "bound", "together", "planes", "between_nodes"}
_LEAST = frozenset({"modulus", "minimum", "wind_limit_mps", "room", "probability"})  # a larger value is stricter
_MOST = frozenset({"fault_probability", "tolerance"})  # a smaller value is stricter
_SPREADS = frozenset({"sigma", "three_sigma", "factor"})
_NOT_COMPARED = "whose own numbers, limits and winds are not compared"
_MOST_SHOWN = 6  # most elements of a list that are shown

KeyPath = tuple[str, ...]


@dataclass(frozen=True)
class SuiteDifference:
    """A difference from the baseline: its kind, its key or part, and the values in the baseline and in the suite."""

    kind: str
    what: str
    baseline: str
    here: str

    @property
    def text(self) -> str:
        """Return the difference as one line of text."""
        return f"{self.kind}: {self.what}" + (f", {self.baseline} -> {self.here}" if self.baseline or self.here else "")


@dataclass(frozen=True)
class Compared:
    """A suite compared with its baseline.

    `hashes` are those of the resolved content of both suites, and of each part of the suite. If the baseline is not
    shipped, `from_shipped` compares the suite with the shipped suite that it extends, or else with `standard`.
    """

    baseline: str
    shipped: bool
    hashes: dict[str, str]
    differences: tuple[SuiteDifference, ...]
    from_shipped: Compared | None = None

    @property
    def title(self) -> str:
        """Return one line of text: the number of differences, and the suite with which this suite was compared."""
        count, suite = len(self.differences), f"suite {self.baseline}"
        suite = f"the shipped {suite}" if self.shipped else f"the {suite}, not shipped"
        text = f"{count or 'no'} difference{'s' * (count != 1)} from {suite}"
        return f"{text}; {self.from_shipped.title}" if self.from_shipped is not None else text

    @property
    def loosening(self) -> list[SuiteDifference]:
        """Return the differences that loosen the suite.

        Excluded are stricter values, numbers with a floor, and differences of the vehicle under test, in the suite's
        scenario and equally in its campaigns.
        """
        of_scenario = {(d.what, d.baseline, d.here) for d in self.differences}

        def judged(d: SuiteDifference) -> bool:
            what = _OF_CAMPAIGN.sub("", d.what)
            same = what.startswith("scenario.vehicle.") and (what, d.baseline, d.here) in of_scenario
            return same or d.what.endswith(_NOT_COMPARED)

        def floored(d: SuiteDifference) -> bool:
            key = d.what.replace(": ", ".").rpartition(".")[2]
            if key == "stop_at":
                return set(re.findall(r"\w+", d.here)) <= _ENDS
            return d.kind == LOWERED and (key in _FLOORED or (self.shipped and key in _LEVELS))

        return [d for d in self.differences if d.kind not in _HARMLESS and not floored(d) and not judged(d)]

    @property
    def loosened(self) -> str:
        """Return one line of text with the differences that loosen the suite, or "" if there are none."""
        every = [shorten(d.text, _LONGEST, placeholder=" ...") for d in self.loosening]
        more = f", and {len(every) - _MOST_NAMED} more" if len(every) > _MOST_NAMED else ""
        return f"looser than the suite {self.baseline}: {'; '.join(every[:_MOST_NAMED])}{more}" if every else ""

    @property
    def agreed(self) -> str:
        """Return one line of text with the agreed baseline and its loosening differences, or "" if shipped."""
        if self.from_shipped is None:
            return ""
        text = f"agreed baseline {self.baseline}, SHA-256 {self.hashes['baseline'][:16]}, not shipped"
        return f"{text}; {self.from_shipped.loosened}" if self.from_shipped.loosened else text

    @property
    def all_differences(self) -> list[SuiteDifference]:
        """Return the differences from the baseline, and further differences from the shipped suite."""
        further = self.from_shipped.differences if self.from_shipped is not None else ()
        return [*self.differences, *(d for d in further if d not in self.differences)]


def against_baseline(loaded: LoadedSuite, vehicle: str | None = None, baseline: LoadedSuite | None = None) -> Compared:
    """Compare a suite, as read, with its baseline. Raises ScenarioError.

    `vehicle` replaces the vehicle of the suite. `baseline` avoids a second reading of that suite.
    """
    baseline = baseline or read_suite(loaded.baseline)
    own, named = ("scenario" in suite.asked.model_fields_set for suite in (baseline, loaded))
    before, after = resolved(baseline.asked, own=own), resolved(loaded.asked, vehicle, own or named)
    hashes = {"baseline": _hash(before), "suite": _hash(after)}
    if loaded.asked.board is not None:  # covers the whole section, including its texts
        hashes["suite: board"] = content_hash(told(loaded.asked.board))
    hashes |= {f"suite: {part.replace('_', ' ')}": _hash(content) for part, content in after.items() if content}
    shipped = loaded.baseline in builtin_files("suite")
    further = None if shipped else against_baseline(replace(loaded, baseline=loaded.shipped), vehicle)
    return Compared(loaded.baseline, shipped, hashes, tuple(differences(before, after)), further)


def accepting_baseline(loaded: LoadedSuite, vehicle: str) -> str:
    """Return the name of the suite whose rules apply to the acceptance of a vehicle with the given name.

    `launcher` has no winds and deviations. For the vehicle of `standard`, those of `standard` apply.
    """
    if loaded.baseline == BASE and vehicle == load_scenario(read_suite(ACCEPTING).suite.scenario).vehicle.name:
        return ACCEPTING
    return ACCEPTING if loaded.baseline in SCREENINGS else loaded.baseline


def _hash(content: Any) -> str:
    """Return the SHA-256 of content without file names and texts."""
    return content_hash([[list(path), value] for path, value in _leaves(content)])


def resolved(suite: Suite, vehicle: str | None = None, own: bool = True) -> dict[str, Any]:
    """Return all content that affects the verdicts of a suite, including the contents of its files.

    If `own` is False, the scenario of the suite is replaced by the switches of the complete model. Raises
    ScenarioError.
    """
    changes = [f'vehicle="{vehicle}"'] if vehicle is not None else []
    out: dict[str, Any] = {key: told(getattr(suite, key)) for key in ("margins", "certificate", "wind_limit_mps")}
    if suite.margins is not None and suite.margins.three_sigma.campaign is not None:
        out["margins"]["three_sigma"]["campaign"] = _campaign(suite.margins.three_sigma.campaign, changes)
    out["dispersed_limit"] = {one.requirement: one.limit for one in suite.dispersed_limit}
    out["scenario"] = _scenario(load_scenario(suite.scenario, changes)) if own else {"switches": told(Switches())}
    if suite.limit_wind is not None:
        windy = load_scenario(suite.scenario, [*changes, f'wind.profile="{suite.limit_wind}"'])
        out["limit_wind"] = told(windy.scenario.wind.profile)
    out["flight"] = {flight.name: _flight(suite, flight, changes) for flight in suite.flight}
    out["campaign"] = {}
    for n, wanted in enumerate(suite.campaign, 1):
        mine = {key: value for key, value in told(wanted).items() if key not in ("file", "set")}
        designs = {_of_change(path): value for path, value in map(parse_override, wanted.set) if path[0] == "design"}
        mine |= {key: str(value) for key, value in designs.items()}
        out["campaign"][str(n)] = _campaign(wanted.file, [*changes, *wanted.set]) | mine
    if suite.board is not None:
        out["waiver"] = {one.about: told(one) for one in suite.board.waiver}
        out["second_tool"] = {one.about: told(one) for one in suite.board.second_tool}
        out["fault_probability"] = suite.board.fault_probability
    return {key: value for key, value in out.items() if value is not None}


def _scenario(loaded: Any) -> dict[str, Any]:
    content = told(loaded.scenario)
    content["requirement"] = {r.get("name") or r["metric"]: r for r in content.get("requirement", ())}
    return {key: value for key, value in content.items() if key not in _WORDS}


def _flight(suite: Suite, flight: SuiteFlight, changes: Sequence[str]) -> dict[str, Any]:
    keys = ("limits", "design_must_keep", "each_stage", "probability")
    out: dict[str, Any] = {key: getattr(flight, key) for key in keys}
    for text in (*suite.every, *flight.set):
        path, value = parse_override(text)
        out[_of_change(path)] = value if isinstance(value, bool | int | float) else str(value)
    for how in ("scale", "add"):
        out |= {f"{how} {key}": value for key, value in getattr(flight, how).items()}
    if flight.scenario is not None:
        out["scenario"] = content_hash(_scenario(load_scenario(flight.scenario, changes)))[:16]
    return out


def _of_change(path: Sequence[str | int]) -> str:
    """Return the key of a change. The key of a design is renamed, since `_WORDS` would exclude it."""
    key = ".".join(map(str, path))
    return "design in place of the judged one" if key == "design" else key


def _campaign(file: str, changes: Sequence[str]) -> dict[str, Any]:
    loaded = load_campaign(file, changes)
    content = told(loaded.file)
    numbers = {key: value for key, value in content["campaign"].items() if key not in ("keep", "envelope", "batch")}
    deviations = {
        f"{d.key or ', '.join(d.keys or ())}{f' ({d.tag})' if d.tag else ''}": told(d) for d in loaded.file.disperse
    }
    models = {"wind_model": content["wind_model"]} if content.get("wind_model") else {}
    return numbers | models | {"scenario": _scenario(loaded.base), "deviation": deviations}


def differences(before: dict[str, Any], after: dict[str, Any]) -> list[SuiteDifference]:
    """Return the differences of `after` from `before`, both as returned by `resolved`, in the order of `KINDS`."""
    names = [each["scenario"].get("vehicle", {}).get("name", "") for each in (before, after)]
    old, new = ({path: value for path, value in _leaves(each)} for each in (before, after))
    out = []
    if names[0] != names[1]:  # numbers of different vehicles are not comparable
        out += [SuiteDifference(CHANGED, f"vehicle, {_NOT_COMPARED}", *names)] if all(names) else []
        out += _smaller_spreads(old, new)
        old, new = ({p: v for p, v in each.items() if not _of_vehicle(p)} for each in (old, new))
    for mine, other, kind in ((old, new, REMOVED), (new, old, STRICTER)):
        others = {path[:n] for path in other for n in range(1, len(path) + 1)}
        for head in (head for head in _parts_of(mine) if head not in others):
            below = [path for path in mine if path[: len(head)] == head]
            if below:
                out.append(SuiteDifference(_kind_of_part(head, kind), " ".join(head), "", ""))
                for path in below:
                    del mine[path]
    alike: dict[tuple[Any, ...], list[str]] = {}
    for path in [*old, *(path for path in new if path not in old)]:
        a, b = old.get(path), new.get(path)
        if a != b:
            in_flight = path[0] == "flight"
            key = (_kind(path, a, b), path[2:] if in_flight else path, _shown(a), _shown(b))
            alike.setdefault(key, []).append(path[1] if in_flight else "")
    for (kind, path, a, b), flights in alike.items():
        of = f"{len(flights)} flights" if len(flights) > 1 else f"flight {flights[0]}"
        out.append(SuiteDifference(kind, f"{of}: {'.'.join(path)}" if flights[0] else _title(path), a, b))
    return sorted(_joined(out), key=lambda d: KINDS.index(d.kind))


def _kind_of_part(head: KeyPath, kind: str) -> str:
    """Return the kind of a part that is removed, or added (`STRICTER`)."""
    if head[0] == "waiver":
        return STRICTER if kind == REMOVED else WAIVED
    return SPREAD if kind == REMOVED and "deviation" in head else kind


def _joined(found: Sequence[SuiteDifference]) -> Iterator[SuiteDifference]:
    """Yield the differences, with all removed flights and all added flights as one difference each."""
    whole = [d for d in found if d.what.startswith("flight ") and not (d.baseline or d.here)]
    for kind in (REMOVED, STRICTER):
        names = [d.what.removeprefix("flight ") for d in whole if d.kind == kind]
        if names:
            yield SuiteDifference(kind, f"{len(names)} flight{'s' * (len(names) != 1)}: {'; '.join(names)}", "", "")
    yield from (d for d in found if d not in whole)


def _parts_of(leaves: dict[KeyPath, Any]) -> list[KeyPath]:
    """Return the parts that are present or absent as a whole: sections, flights, campaigns, deviations."""
    out: dict[KeyPath, None] = {}
    for path in leaves:
        if path[0] in ("margins", "certificate"):
            out[path[:1]] = None
        if path[0] in ("flight", "campaign", "waiver", "second_tool"):
            out[path[:2]] = None
        for n, word in enumerate(path[:-1]):
            if word in ("deviation", "requirement"):
                out[path[: n + 2]] = None
            elif word in ("worst", "wind_model"):
                out[path[: n + 1]] = None
    return sorted(out, key=len)


def _of_vehicle(path: KeyPath) -> bool:
    """Return True for keys whose values differ between vehicles."""
    return "deviation" in path or ("scenario" in path and "switches" not in path) or path[0] == "limit_wind"


def _smaller_spreads(before: dict[KeyPath, Any], after: dict[KeyPath, Any]) -> Iterator[SuiteDifference]:
    """Yield the deviations with a smaller standard deviation than before.

    Deviations in units of one vehicle are excluded.
    """
    old, new = _standard_deviations(before), _standard_deviations(after)
    for path in (path for path in old if path in new and new[path] < old[path]):
        yield SuiteDifference(SPREAD, f"{_title(path)}, standard deviation", _shown(old[path]), _shown(new[path]))


def _standard_deviations(leaves: dict[KeyPath, Any]) -> dict[KeyPath, float]:
    """Return the standard deviations of normal and uniform draws that are comparable between vehicles, by deviation."""
    every: dict[KeyPath, dict[str, Any]] = {}
    for path, value in leaves.items():
        if "deviation" in path[:-2]:
            every.setdefault(path[: path.index("deviation") + 2], {})[path[-1]] = value
    out = {}
    for path, d in every.items():
        if d.get("apply") != "scale" and path[-1].startswith("vehicle.") and "_factor" not in path[-1]:
            continue  # an absolute value of one vehicle
        if d["distribution"] == "uniform":
            out[path] = (d["high"] - d["low"]) / math.sqrt(12.0)
        elif d["distribution"] in ("normal", "log-normal") and "covariance" not in d:
            out[path] = d.get("sigma", d.get("three_sigma", 0.0) / 3.0)
    return out


def _leaves(value: Any, path: KeyPath = ()) -> Iterator[tuple[KeyPath, Any]]:
    if isinstance(value, dict):
        table = any(isinstance(column, list) for column in value.values())
        for key, item in value.items():
            if key not in _WORDS and not (table and key in (FILE_KEY, DATE_KEY)):
                yield from _leaves(item, (*path, str(key)))
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for n, item in enumerate(value):
            yield from _leaves(item, (*path, str(n)))
    elif value is not None:
        yield path, value


def _title(path: KeyPath) -> str:
    return f"campaign {path[1]}: {'.'.join(path[2:])}" if path[0] == "campaign" else ".".join(path)


def _kind(path: KeyPath, before: Any, after: Any) -> str:
    key = path[-1]
    if key.rpartition(".")[2] == "seed":
        return SEED
    if (path[0] == "limit_wind" or "wind" in path or ".wind." in f".{key}") and _is_speed(key):
        weaker = _weaker(before, after)
        return CHANGED if weaker is None else WEAKER if weaker else STRICTER
    if "switches" in path or key.startswith("switches."):
        return OFF if after in (False, "false", "ideal", "linear", "'ideal'", "'linear'") else STRICTER
    if key == "design_must_keep":
        return STRICTER if after else EXCUSED
    if path == ("margins", "only"):
        return REMOVED if after else STRICTER
    if key == "limits":
        return LOOSENED if after == "dispersed" else STRICTER
    less = _less(key, before, after)
    if path[:2] in (("margins", "nominal"), ("margins", "dispersed")) and key in MEASURED:
        if before is None or after is None or less is None:
            return LOOSENED if after is None else STRICTER if before is None else CHANGED
        return LOOSENED if less == (MEASURED[key].sense == ">=") else STRICTER
    if less is None:
        return LOOSENED if after is None and key in (*_LEAST, *_MOST, "limit") else CHANGED
    if key in _LEAST:
        return LOOSENED if less else STRICTER
    if key in _MOST:
        return STRICTER if less else LOOSENED
    if path[0] == "dispersed_limit" or ("requirement" in path and key == "limit"):
        return STRICTER if less else LOOSENED
    if "deviation" in path or "wind_model" in path or "three_sigma" in path:
        if key in _SPREADS or "three_sigma" in path[:-1] or key in ("low", "high"):
            return SPREAD if less != (key == "low") else STRICTER
        return CHANGED
    if key in _COUNTS:
        return LOWERED if less else STRICTER
    return SHORTENED if key.endswith("duration_s") and less else CHANGED


def _is_speed(key: str) -> bool:
    """Return True for a key of a wind whose magnitude determines its strength."""
    name = key.rpartition(".")[2]
    return name.endswith("_mps") or name == "factor"


def _weaker(before: Any, after: Any) -> bool | None:
    """Return True if any wind speed is smaller than before, or None if the two winds cannot be compared."""
    try:
        a, b = ([abs(float(x)) for x in (v if isinstance(v, list) else [v])] for v in (before, after))
    except (TypeError, ValueError):
        return None
    return any(y < x for x, y in zip(a, b, strict=True)) if len(a) == len(b) else None


def _less(key: str, before: Any, after: Any) -> bool | None:
    """Return True if a value is less than before, or None if the comparison has no meaning."""
    if key == "planes":
        return len(after or ()) < len(before or ())
    if key == "between_nodes":
        return bool(after == "ignore")
    if key.endswith("duration_s") and before is None:
        return True  # the change limits the duration of the flight
    try:
        a, b = float(before), float(after)
    except (TypeError, ValueError):
        return None
    return None if math.isnan(a) or math.isnan(b) else b < a


def _shown(value: Any) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list | tuple):
        if len(value) > _MOST_SHOWN:
            return f"{len(value)} values, {content_hash(list(value))[:8]}"
        return f"[{', '.join(map(_shown, value))}]"
    return str(value)
