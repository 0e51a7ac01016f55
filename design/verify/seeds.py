"""The seeds of a verification: declared in advance, registered in the ledger, or chosen by hand.

A seed is declared if it is that of a shipped baseline, of a shipped campaign, or the default. Declared seeds are not
derived from a hash of the inputs. A derived seed would change with an irrelevant digit of a design, which could then
select the draws.
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
"""The seed of every file without a seed."""

DECLARED, BY_HAND, REPLACED = "declared", "chosen by hand", "replaced by the registered seed"


@dataclass(frozen=True)
class Seed:
    """A seed: its part of the verification, its value, the declared value, and the way in which it was chosen."""

    of: str
    value: int
    declared: int
    how: str = DECLARED

    @property
    def lack(self) -> str:
        """Return the reason why the seed does not support an acceptance, or ""."""
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
    """Return the seeds of a suite, of its flights by name and of its campaigns as flown.

    `baseline` is the suite with which it is compared. `candidate` is the number of a candidate of `simdesign --verify`,
    which is added to the declared seeds of its draws.
    """
    suite, out = loaded.suite, list[Seed]()
    if suite.margins is not None:
        worst, named = suite.margins.worst, suite.margins.three_sigma.campaign
        out.append(_seed("margins", suite.margins.seed, DEFAULT, candidate))
        out += [_seed("margins.worst", worst.seed, DEFAULT)] if worst is not None else []
        if named is not None:
            out.append(_seed("margins.three_sigma.campaign", load_campaign(named).campaign.seed, _shipped(named)))
    # excludes a baseline that is not shipped, whose author could choose the seeds
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
    """Return the declared seed of a campaign.

    This is the seed of the baseline's campaign at the same position if its vehicle is the same. Otherwise, it is that
    of the shipped file, or the default for another file.
    """
    if number < len(baseline.campaign):
        same = baseline.campaign[number]
        before = load_campaign(same.file, same.set)
        if before.base.vehicle.name == flown.base.vehicle.name:
            return before.campaign.seed if same.seed is None else same.seed
    return _shipped(wanted.file)


def _shipped(file: str) -> int:
    """Return the seed of a shipped campaign, or the default for another file."""
    known = builtin_files("campaign")
    return load_campaign(file).campaign.seed if file in known or file in map(str, known.values()) else DEFAULT


def _of_scenario(name: str, loaded: LoadedScenario) -> Iterator[Seed]:
    """Yield the seeds of a scenario's noise, which are independent of draws."""
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
    """Return the seeds for the record of an attempt: those of draws, and every seed that is not the declared one."""
    return {seed.of: seed.value for seed in seeds if " " not in seed.of or seed.how != DECLARED}


def chosen(seeds: Sequence[Seed], lines: Sequence[Line], design: str) -> tuple[Seed, ...]:
    """Return the seeds, with those marked that the ledger lists as registered or assigned for the vehicle's name.

    Each part of a verification has one valid seed per vehicle. It is the first registered seed if no earlier attempt
    flew the part, and the declared seed otherwise. A second seed would be a second chance, and a changed number of the
    vehicle does not permit one. A seed that `simdesign` assigned to a design remains valid for it. `design` is the hash
    of the design, and `lines` are those before this attempt.
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

    A seed of noise is recorded only if it is not the declared one (`drawn`).
    """
    declared = seed.declared if " " in seed.of and not line["part"] else None
    value = line["seeds"].get(seed.of, declared)
    return None if value is None else int(value)


def registered(seeds: Sequence[Seed], lines: Sequence[Line], vehicle: str) -> dict[str, Any]:
    """Return the ledger line that registers the seeds chosen by hand. `vehicle` is the hash of the vehicle.

    Raises ValueError if a registered seed would not be valid.
    """
    by_hand = {seed.of: seed.value for seed in seeds if seed.how == BY_HAND}
    line = {"state": REGISTERED, "date": "", "hashes": {"vehicle": vehicle}, "seeds": by_hand}
    for seed in chosen([seed for seed in seeds if seed.how == BY_HAND], [*lines, line], ""):
        if not seed.how.startswith("registered"):
            problem = "an attempt has flown this part, or another seed was registered before"
            raise ValueError(f"seed {seed.value} of {seed.of} cannot be registered for this vehicle: {problem}")
    return {key: value for key, value in line.items() if key != "date"}


def missing(seeds: Iterable[Seed]) -> list[str]:
    """Return a phrase for each seed that does not support an acceptance."""
    return [text for seed in seeds if (text := seed.lack)]
