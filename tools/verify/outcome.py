"""The last line of a verification: the outcome, its decisive reason with numbers, and the number of requirements
met.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

from maxq.design.verify.suite import ACCEPTED, REJECTED, SCREENED, UNDECIDED, WAIVED, JudgedRequirement, SuiteVerdict
from maxq.design.verify.verify import Verification
from maxq.tools.cli.terminal import printable

ONLY_REJECTS = "A screening can reject, not accept."
MOST_REASONS = 3  # named in the line as below the floor; the report lists all
_BOUND = re.compile(r"(>=|<=) (-?[0-9.][^\s,]*(?: [^,]+)?)")
_BEYOND = {">=": "<", "<=": ">"}
_AT_POINT = re.compile(r"(\S+ s), (pitch|yaw)")


def verdict_word(judgement: SuiteVerdict, requirements: Sequence[JudgedRequirement]) -> str:
    """Return the verdict in capitals, followed by the number of waived requirements if the verdict depends on
    waivers.
    """
    waived = sum(bool(r.waived) for r in requirements)
    return f"{judgement.upper()} ({waived})" if judgement == WAIVED else judgement.upper()


def headline(found: Verification, name: str = "") -> str:
    """Return the outcome in one line. `name`, if there are several designs, is that of the design and precedes the
    line.
    """
    met, count = len(found.of(ACCEPTED)), len(found.requirements)
    reasons, texts = found.missing_evidence, [_decisive(found)]
    texts.append(f"{met} of {count} requirement{'s' * (count != 1)} met")
    if found.judgement == SCREENED:
        more = f", and {len(reasons) - MOST_REASONS} more" if len(reasons) > MOST_REASONS else ""
        texts.append(f"below the floor of an acceptance: {', '.join(reasons[:MOST_REASONS])}{more}")
    texts += [found.compared.agreed] if found.judgement in (ACCEPTED, WAIVED) and found.compared.agreed else []
    line = f"{verdict_word(found.judgement, found.requirements)}: {'; '.join(filter(None, texts))}"
    line += f". {ONLY_REJECTS}" if reasons else ""
    return f"{printable(name)}: {line}" if name else line


def _decisive(found: Verification) -> str:
    """Return a text on the decisive requirement.

    For a rejection, it is the missed requirement furthest beyond its limit. For an undecided verdict, it is the
    undecided requirement that needs the most runs. Otherwise, it is the tightest requirement.
    """
    if found.judgement in (REJECTED, WAIVED):
        missed = [r for r in found.of(REJECTED) if not r.waived] or found.of(REJECTED)
        return _missed(missed) + (f", waived by {missed[0].waived}" if found.judgement == WAIVED else "")
    if found.judgement == UNDECIDED:
        open_ = max(found.of(UNDECIDED), key=lambda r: r.more_runs, default=None)
        more = f", {open_.more_runs} more runs would settle it" if open_ and open_.more_runs else ""
        return f"{open_.name}: {open_.found}, required {open_.wanted}{more}" if open_ else ""
    finite = [r for r in found.requirements if math.isfinite(r.room)]
    if not finite:
        return ""
    tightest = min(finite, key=lambda r: round(r.room, 9))  # the first of equal values
    share = f"{100.0 * tightest.room:.0f} % of the limit left"
    return (
        f"tightest requirement: {_name(tightest)} {tightest.found}, limit {_bound(tightest)}{_at([tightest])}, {share}"
    )


def _missed(rejected: Sequence[JudgedRequirement]) -> str:
    worst = min(rejected, key=lambda r: round(r.room, 9) if math.isfinite(r.room) else math.inf)
    sense = _BOUND.fullmatch(worst.wanted)
    same = [r for r in rejected if (r.part, r.name) == (worst.part, worst.name) and _time(r) == _time(worst)]
    if sense and re.match(r"-?[0-9.]", worst.found):
        return f"{_name(worst)} {worst.found} {_BEYOND[sense[1]]} {sense[2]}{_at(same)}"
    beyond = f" {_BEYOND[sense[1]]} {sense[2]}" if sense else f", required {worst.wanted}"
    return f"{_name(worst)}: {worst.found}{beyond}{_at(same)}"


def _name(r: JudgedRequirement) -> str:
    return printable(r.name.removesuffix(", as designed"))


def _bound(r: JudgedRequirement) -> str:
    sense = _BOUND.fullmatch(r.wanted)
    return sense[2] if sense else r.wanted


def _time(r: JudgedRequirement) -> str:
    at = _AT_POINT.fullmatch(r.where)
    return at[1] if at else r.where


def _at(same: Sequence[JudgedRequirement]) -> str:
    """Return the place of requirements that differ in their planes only."""
    planes = [at[2] for r in same if (at := _AT_POINT.fullmatch(r.where))]
    where = _time(same[0])
    if planes:
        return f" at {where} ({', '.join(dict.fromkeys(planes))})"
    return f" {where}" if where.startswith("at ") else f" ({where})" if where else ""
