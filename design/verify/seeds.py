"""The seeds of a verification: declared before it, registered in the ledger, or chosen by hand.

A seed is declared where it is that of a shipped baseline, of a shipped campaign, or the default. Seeds are declared
and not derived from a hash of the inputs: a derived seed changes with an irrelevant digit of a design, which would then
choose the draws.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from maxq.design.verify.ledger import BEGUN, REGISTERED, Line
from maxq.design.verify.suite import CampaignWanted, LoadedSuite, Suite
from maxq.sim.campaign.read import LoadedCampaign, load_campaign
from maxq.sim.input.files import builtin_files
from maxq.sim.scenario.loader import LoadedScenario, told

DEFAULT = 1
"""The seed of every file that gives none."""

DECLARED, BY_HAND = "declared", "chosen by hand"


@dataclass(frozen=True)
class Seed:
    """A seed: the part that it is of, its value, the declared value, and how it was chosen."""

    of: str
    value: int
    declared: int
    how: str = DECLARED


def seeds_of(
    loaded: LoadedSuite,
    baseline: LoadedSuite,
    flights: Mapping[str, LoadedScenario],
    campaigns: Sequence[LoadedCampaign],
    candidate: int = 0,
) -> list[Seed]:
    """Return the seeds of a suite, of its flights by name and of its campaigns as they are flown.

    `baseline`: the suite with which it is compared.
    `candidate`: number of a candidate of `simdesign --verify`, which is added to the declared seeds of its draws.
    """
    suite, out = loaded.suite, list[Seed]()
    if suite.margins is not None:
        worst, named = suite.margins.worst, suite.margins.three_sigma.campaign
        out.append(_seed("margins", suite.margins.seed, DEFAULT, candidate))
        out += [_seed("margins.worst", worst.seed, DEFAULT)] if worst is not None else []
        if named is not None:
            out.append(_seed("margins.three_sigma.campaign", load_campaign(named).campaign.seed, _shipped(named)))
    # the author of a baseline that is not shipped would choose the seeds
    before = baseline.asked if loaded.baseline in builtin_files("suite") else Suite.model_construct()
    for n, (wanted, flown) in enumerate(zip(suite.campaign, campaigns, strict=False)):
        out.append(_seed(f"campaign.{n}", flown.campaign.seed, _declared(before, n, wanted, flown), candidate))
        out += _of_scenario(f"campaign.{n}", flown.base)
    for name, scenario in flights.items():
        out += _of_scenario(f"flight '{name}'", scenario)
    return out


def _seed(of: str, value: int, declared: int, candidate: int = 0) -> Seed:
    assigned = candidate > 0 and value == declared + candidate
    how = f"assigned to candidate {candidate}" if assigned else DECLARED if value == declared else BY_HAND
    return Seed(of, value, declared, how)


def _declared(baseline: Suite, number: int, wanted: CampaignWanted, flown: LoadedCampaign) -> int:
    """Return the seed of the baseline's campaign in this place, if it flies the same vehicle; else the file's."""
    if number < len(baseline.campaign):
        same = baseline.campaign[number]
        before = load_campaign(same.file, same.set)
        if before.base.vehicle.name == flown.base.vehicle.name:
            return before.campaign.seed if same.seed is None else same.seed
    return _shipped(wanted.file)


def _shipped(file: str) -> int:
    """Return the seed of a shipped campaign; the default of another file."""
    known = builtin_files("campaign")
    return load_campaign(file).campaign.seed if file in known or file in map(str, known.values()) else DEFAULT


def _of_scenario(name: str, loaded: LoadedScenario) -> Iterator[Seed]:
    """Yield the seeds of noise, which belong to no draw."""
    for section in ("run", "wind"):
        for path, value in _found(told(getattr(loaded.scenario, section)), section):
            yield _seed(f"{name} {path}", value, DEFAULT)


def _found(content: Any, path: str) -> Iterator[tuple[str, int]]:
    if isinstance(content, dict):
        for key, value in content.items():
            if key == "seed":
                yield path, int(value)
            else:
                yield from _found(value, f"{path}.{key}")


def drawn(seeds: Iterable[Seed]) -> dict[str, int]:
    """Return the seeds for the record of an attempt: those of draws, and every seed that is not declared."""
    return {seed.of: seed.value for seed in seeds if " " not in seed.of or seed.how != DECLARED}


def chosen(seeds: Sequence[Seed], lines: Sequence[Line], vehicle: str, design: str) -> tuple[Seed, ...]:
    """Return the seeds, with those marked as registered or assigned that the ledger contains.

    The first seed registered for a part of a vehicle counts, if no attempt had flown the part with it. Later seeds are
    chosen by hand. A seed that `simdesign` assigned to a design counts for it again.
    `vehicle` and `design`: hashes. `lines`: those before this attempt.
    """
    return tuple(_chosen(seed, lines, vehicle, design) if seed.how == BY_HAND else seed for seed in seeds)


def _chosen(seed: Seed, lines: Sequence[Line], vehicle: str, design: str) -> Seed:
    used = False
    for line in lines:
        mine = line["hashes"].get("vehicle") == vehicle
        if line["state"] == BEGUN and line["seeds"].get(seed.of) == seed.value:
            used = True
            if line["candidate"] and line["hashes"]["design"] == design:
                return replace(seed, how=f"assigned to candidate {line['candidate']}")
        elif line["state"] == REGISTERED and mine and seed.of in line["seeds"]:
            if line["seeds"][seed.of] == seed.value and not used:
                return replace(seed, how=f"registered on {line['date']}")
            used = True
    return seed


def registered(seeds: Sequence[Seed], lines: Sequence[Line], vehicle: str) -> dict[str, Any]:
    """Return the line that registers the seeds chosen by hand. Raises ValueError where one of them would not count."""
    by_hand = {seed.of: seed.value for seed in seeds if seed.how == BY_HAND}
    line = {"state": REGISTERED, "date": "", "hashes": {"vehicle": vehicle}, "seeds": by_hand}
    for seed in chosen(seeds, [*lines, line], vehicle, ""):
        if seed.how == BY_HAND:
            problem = "an attempt has flown it, or another seed was registered before"
            raise ValueError(f"seed {seed.value} of {seed.of} cannot be registered for this vehicle: {problem}")
    return {key: value for key, value in line.items() if key != "date"}


def missing(seeds: Iterable[Seed]) -> list[str]:
    """Return what the seeds lack for an acceptance, a phrase each."""
    return [f"seed {s.value} of {s.of} chosen by hand, not registered before" for s in seeds if s.how == BY_HAND]
