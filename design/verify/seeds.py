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

DECLARED, BY_HAND, REPLACED = "declared", "chosen by hand", "replaced by the registered seed"


@dataclass(frozen=True)
class Seed:
    """A seed: the part that it is of, its value, the declared value, and how it was chosen."""

    of: str
    value: int
    declared: int
    how: str = DECLARED

    @property
    def lack(self) -> str:
        """Return the reason for which it counts for no acceptance, or ""."""
        if self.how == BY_HAND:
            return f"seed {self.value} of {self.of} chosen by hand, not registered before"
        return f"seed {self.value} of {self.of} {self.how}" if self.how.startswith(REPLACED) else ""


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


def chosen(seeds: Sequence[Seed], lines: Sequence[Line], design: str) -> tuple[Seed, ...]:
    """Return the seeds, with those marked that the ledger of a vehicle's name has as registered or assigned.

    Each part of a vehicle has one seed: the first one that is registered, if no attempt has flown the part before, else
    the declared one. A second seed would be a second chance. A changed number of the vehicle gives no other seed. A
    seed that `simdesign` assigned to a design counts for it again.
    `design`: hash. `lines`: those before this attempt.
    """
    return tuple(_chosen(seed, lines, design) for seed in seeds)


def _chosen(seed: Seed, lines: Sequence[Line], design: str) -> Seed:
    if seed.how not in (DECLARED, BY_HAND):
        return seed
    for line in lines:
        if line["state"] == REGISTERED and seed.of in line["seeds"]:
            if line["seeds"][seed.of] == seed.value:
                return replace(seed, how=f"registered on {line['date']}")
            return replace(seed, how=f"{REPLACED} {line['seeds'][seed.of]}")
        if line["state"] == BEGUN and (_flown_seed(seed, line) is not None):
            break
    for line in lines:
        mine = line["state"] == BEGUN and _flown_seed(seed, line) == seed.value
        if mine and line["candidate"] and line["hashes"]["design"] == design:
            return replace(seed, how=f"assigned to candidate {line['candidate']}")
    return seed


def _flown_seed(seed: Seed, line: Line) -> int | None:
    """Return the seed of a part in an attempt, or None if the attempt did not fly the part.

    A seed of noise is recorded unless it is the declared one (`drawn`).
    """
    declared = seed.declared if " " in seed.of and not line["part"] else None
    value = line["seeds"].get(seed.of, declared)
    return None if value is None else int(value)


def registered(seeds: Sequence[Seed], lines: Sequence[Line], vehicle: str) -> dict[str, Any]:
    """Return the line that registers the seeds chosen by hand. Raises ValueError where one of them would not count.

    `vehicle`: hash.
    """
    by_hand = {seed.of: seed.value for seed in seeds if seed.how == BY_HAND}
    line = {"state": REGISTERED, "date": "", "hashes": {"vehicle": vehicle}, "seeds": by_hand}
    for seed in chosen([seed for seed in seeds if seed.how == BY_HAND], [*lines, line], ""):
        if not seed.how.startswith("registered"):
            problem = "an attempt has flown this part, or another seed was registered before"
            raise ValueError(f"seed {seed.value} of {seed.of} cannot be registered for this vehicle: {problem}")
    return {key: value for key, value in line.items() if key != "date"}


def missing(seeds: Iterable[Seed]) -> list[str]:
    """Return what the seeds lack for an acceptance, a phrase each."""
    return [text for seed in seeds if (text := seed.lack)]
