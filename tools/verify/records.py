"""The records of a verification in its pack: attempts, seeds, results from the cache, runs, and hashes of the files."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from maxq.design.verify.seeds import BY_HAND, DECLARED
from maxq.design.verify.verify import Verification
from maxq.sim.campaign.schema import campaign_title
from maxq.sim.campaign.store import MANIFEST, parts_in
from maxq.sim.files import write_whole
from maxq.tools.verify.record_model import ProvenanceRecord

ATTEMPTS_NAME, RUNS_NAME, RESULTS_NAME = "attempts.jsonl", "verdict-runs", "results.json.gz"
MOST_NAMES = 6  # recalled results named in a line; verdict.json lists all


def record_lines(found: Verification) -> list[str]:
    """Return the lines of the first page on the attempt, the seeds that were not declared, and the recalled results."""
    out = [found.attempt.title]
    for seed in found.seeds:
        if seed.value == seed.declared and seed.lack:
            out.append(seed.lack)
        elif seed.how != DECLARED:
            how = f"{seed.how}, not registered before" if seed.how == BY_HAND else seed.how
            out.append(f"seed {seed.value} of {seed.of}, not the declared {seed.declared}: {how}")
    return [*out, reused_line(found)]


def reused_line(found: Verification) -> str:
    """Return a line on the parts and runs that were recalled from the cache, and those of them that were computed
    again.
    """
    runs = sum(c.recalled for c in found.campaigns)
    if not found.recalled and not runs:
        return "computed afresh: nothing was recalled from the cache"
    texts = [f"{found.recalled} of {found.recalled + found.worked_out} parts"] if found.recalled else []
    texts += [f"{c.recalled} of {c.runs} runs of {campaign_title(c.name)}" for c in found.campaigns if c.recalled]
    again = [*found.reused.computed_again, *(f"{c.name} run {n}" for c in found.campaigns for n in c.reflown)]
    names = f": {', '.join(again)}" if len(again) <= MOST_NAMES else ""
    checked = f"{len(again)} computed again, alike{names}" if again else "none computed again"
    return f"NOT COMPUTED AFRESH: {' and '.join(texts)} recalled from the cache; {checked}"


def records(found: Verification) -> ProvenanceRecord:
    """Return the sections of verdict.json on the attempt, the seeds and the recalled results."""
    attempt = found.attempt
    return {
        "attempt": {
            "number": attempt.number,
            "repeated": attempt.repeated,
            "text": attempt.title,
            "since": attempt.since,
            "line": attempt.line["hash"],
            "others": [vars(one) for one in attempt.others],
            "other_versions": [vars(one) for one in attempt.versions],
            "damage": list(attempt.damage),
        },
        "seeds": [vars(seed) for seed in found.seeds],
        "recalled": {
            "parts": list(found.reused.names),
            "computed_again": list(found.reused.computed_again),
            "runs": {c.name: {"recalled": c.recalled, "flown_again": c.reflown} for c in found.campaigns},
        },
    }


def write_attempts(found: Verification, folder: Path) -> Path:
    """Copy the ledger, with the attempts for all its vehicles, into the pack. Return the path of the copy.

    Raises FileError if the copy cannot be written, and OSError if the ledger cannot be read.
    """
    return write_whole(folder / ATTEMPTS_NAME, found.attempt.path.read_bytes())


def campaign_folder(folder: Path, number: int) -> Path:
    """Return the folder of a campaign in a pack. `number` is counted from 0."""
    return folder / RUNS_NAME / str(number + 1)


def write_runs(found: Verification, folder: Path) -> list[Path]:
    """Copy the runs of the campaigns into the pack: manifests and data sets. Return the paths. Raises FileError."""
    out = []
    for n, campaign in enumerate(found.campaigns):
        copied = [
            campaign.folder / MANIFEST,
            *(part.path for part in parts_in(campaign.folder) if part.first < campaign.runs),
        ]
        place = campaign_folder(folder, n)
        for part in parts_in(place):  # from an earlier pack
            part.path.unlink()
        out += [write_whole(place / path.relative_to(campaign.folder), path.read_bytes()) for path in copied]
    return out


def file_hashes(folder: Path, files: Sequence[Path]) -> dict[str, str]:
    """Return the SHA-256 of each file of a pack, by its name in the pack."""
    return {p.relative_to(folder).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
