"""A verification pack can be checked by others: signature, rows, and results from an edited cache."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import filelock
import pyarrow.parquet as pq
import pytest
from made_once import copy_of

from maxq.design.verify import ledger
from maxq.design.verify.memory import PartsOnDisk
from maxq.design.verify.results import Results
from maxq.tools.simverify import main
from maxq.tools.verify.recomputed import Job, jobs_of

SUITE = """
schema = 2
[margins]
times_s = [20.0, 40.0]
between_nodes = "ignore"
cases = 3
corner_sigmas = 0.0
success = 0.5
[margins.nominal]
gain_up_db = 3.0
[margins.dispersed]
gain_up_db = 3.0
[margins.three_sigma]
thrust = 0.03
[margins.worst]
starts = 1
modulus = 0.2
[certificate]
times_s = [30.0]
planes = ["pitch"]
in_flight = false
[[flight]]
name = "two seconds"
set = ["run.duration_s=2.0"]
[[campaign]]
file = "campaigns/ksr3"
runs = 4
set = ["run.duration_s=2.0", "campaign.keep=[]"]
"""
FLIGHT = """
schema = 2
[[flight]]
name = "two seconds"
set = ["run.duration_s=2.0"]
"""
"""A suite of the flight alone, which has a result in the cache."""


@pytest.fixture(scope="module")
def made() -> Path:
    """Return a folder with a suite, a cache, a ledger, and the resulting pack, made once for all workers."""
    return copy_of("verified-pack", _make)


def _make(folder: Path) -> None:
    (folder / "suite.toml").write_text(SUITE)
    with pytest.MonkeyPatch.context() as patch:
        _at(folder, patch)
        assert main(["ksr3-robust", "--suite", "suite.toml", "--out", "pack"]) == 3


def _at(folder: Path, patch: pytest.MonkeyPatch) -> None:
    patch.chdir(folder)
    patch.setenv("MAXQ_LEDGER", str(folder / "ledger"))
    patch.setattr("maxq.design.verify.memory.default_folder", lambda: folder / "memory")


@pytest.fixture
def here(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a copy of that folder, in which the test runs."""
    shutil.copytree(made, tmp_path / "copy")
    _at(tmp_path / "copy", monkeypatch)
    return tmp_path / "copy"


def _run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str]:
    capsys.readouterr()
    try:
        code = main(list(words))
    except SystemExit as ended:
        code = int(ended.code or 0)
    out, err = capsys.readouterr()
    return code, out + err


def _verdict(change: Callable[[dict[str, Any]], None] = lambda verdict: None) -> dict[str, Any]:
    path = Path("pack/verdict.json")
    verdict: dict[str, Any] = json.loads(path.read_text())
    change(verdict)
    path.write_text(json.dumps(verdict))
    return verdict


def _differs(said: str) -> list[str]:
    return [line.strip().removeprefix("DIFFERS: ") for line in said.splitlines() if "DIFFERS" in line]


@pytest.mark.skipif(not any(map(shutil.which, ("chromium", "google-chrome"))), reason="no browser")
def test_a_browser_prints_the_pack(made: Path) -> None:
    assert (made / "pack" / "review.pdf").read_bytes()[:5] == b"%PDF-"


@pytest.mark.slow
def test_an_honest_pack_agrees_in_all_that_is_computed_again(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, said = _run(capsys, "--check", "pack", "--sample", "99")
    assert (code, _differs(said)) == (0, [])
    assert "1 of 1 flights, computed again: 'two seconds'" in said
    for count, kind in ((3, "operating points"), (3, "dispersed vehicles"), (1, "worst vehicles"), (2, "searches")):
        assert f"{count} of {count} {kind}, computed again" in said
    assert "4 of 4 runs, computed again" in said
    rows = len(json.loads(Path("pack/verdict.json").read_text())["requirements"])
    assert f"verdict and {rows} requirements, derived again from the results in the pack" in said
    assert "ledger of attempts: attempt 1 for this vehicle" in said
    assert said.rstrip().endswith("CHECK PASSED")
    assert _run(capsys, "--check", "pack/verdict.json", "--sample", "0")[0] == 0


@pytest.mark.slow
def test_what_was_edited_in_a_pack_is_found(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def better(verdict: dict[str, Any]) -> None:
        verdict["flights"][0]["metrics"]["max_attitude_error_deg"] = 0.01
        verdict["margins"][0]["as_designed"][0]["gain_up_db"] = 9.0
        verdict["certificate"] = []
        verdict["verdict"] = "accepted"

    _verdict(better)
    with Path("pack/review.html").open("a") as page:
        page.write("<p>And well done.</p>")
    Path("pack/figures/flights.csv").unlink()
    code, said = _run(capsys, "--check", "pack", "--sample", "0")
    assert code == 1
    found = _differs(said)
    assert [text for text in found if " by the results" not in text] == [
        "file figures/flights.csv: is missing",
        "file review.html: its SHA-256 differs",
        "ledger of attempts: its copy in the pack does not contain this attempt, its number or its verdict",
    ]
    derived = [text for text in found if " by the results" in text]
    assert derived[0] == 'verdict: "accepted" in the pack, "undecided" by the results'
    assert derived[1].startswith("flights 1: metrics: max_attitude_error_deg: 0.01 in the pack, ")
    assert derived[2].startswith("margins 1: as_designed 1: gain_up_db: 9.0 in the pack, 6.65")
    assert derived[3:] == ["certificate: 0 in the pack, 1 by the results"]
    assert said.rstrip().endswith("CHECK FAILED: 7 differences")


ROWS = (
    "two seconds (scenarios)",
    "upper gain margin, as designed (margins)",
    "random vehicles meet the dispersed limits (dispersed)",
    "least |1 + L| within 3 sigma, pitch (worst)",
    "flight and linear loop agree, pitch (certificate)",
    "ksr3: control kept (campaign)",
    "ksr3: all requirements (campaign)",
)
"""A row of each part."""


def test_every_kind_of_row_that_was_edited_is_named(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Edited limits, values, outcomes and margins, and deleted or added rows, are named without a signature."""

    def edit(verdict: dict[str, Any]) -> None:
        rows = {f"{row['name']} ({row['part']})": row for row in verdict["requirements"]}
        for n, name in enumerate(ROWS[:-1]):
            rows[name] |= ({"wanted": ">= 0.1 dB"}, {"found": "9 of 9"}, {"room": 7.0}, {"verdict": "open"})[n % 4]
        verdict["requirements"].remove(rows[ROWS[-1]])  # as in a pack from before this row
        verdict["requirements"].append(rows[ROWS[0]] | {"name": "well done"})
        verdict["missing_evidence"].remove("no flight in wind from liftoff to the last burnout")
        verdict["baseline"]["differences"].pop()
        verdict["seeds"][0]["how"] = "registered"
        verdict["worst"][0]["modulus"] = 0.9
        verdict["command"] = verdict["command"].replace("suite.toml", "standard")
        verdict["attempt"]["number"] = 0

    _verdict(edit)
    code, said = _run(capsys, "--check", "pack", "--sample", "0")
    found = [text for text in _differs(said) if not text.startswith("ledger")]
    assert code == 1
    for n, name in enumerate(ROWS[:-1]):
        key = ("wanted", "found", "room", "verdict")[n % 4]
        assert sum(text.startswith(f"requirements: {name}: {key}: ") for text in found) == 1, name
    assert f"requirements: {ROWS[-1]}: the pack lacks it" in found
    assert "requirements: well done (scenarios): does not follow from the results" in found
    begins = (
        "missing_evidence: ",
        "baseline: differences: ",
        "seeds 1: how: ",
        "worst 1: modulus: 0.9 in",
        "command: ",
    )
    for begin in (*begins, "attempt: number: 0 in the pack, 1 by"):
        assert sum(text.startswith(begin) for text in found) == 1, begin
    assert len(found) == len(ROWS) + 1 + len(begins) + 1


def _forge(change: Callable[[Results], Results]) -> None:
    """Change the results of the pack, and compute its hash again."""
    path = Path("pack/results.json.gz")
    path.write_bytes(change(Results.from_bytes(path.read_bytes())).to_bytes())
    _verdict(lambda verdict: verdict["files"].update({path.name: hashlib.sha256(path.read_bytes()).hexdigest()}))


def _recompute_only(monkeypatch: pytest.MonkeyPatch, *kinds: str) -> None:
    """Compute only results of these kinds again, and no certificate of operating points."""

    def jobs(*given: Any) -> dict[str, list[Job]]:
        every = jobs_of(*given)
        return {kind: [job for job in every[kind] if not job[0].startswith("certificate")] for kind in kinds}

    monkeypatch.setattr("maxq.tools.verify.check.jobs_of", jobs)


@pytest.mark.slow
def test_edited_results_are_found_in_the_sample(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    _recompute_only(monkeypatch, "operating points", "dispersed vehicles", "worst vehicles", "searches")

    def better(results: Results) -> Results:
        (study,), (worst,) = results.margins, results.worst
        study.random[1] += 1.0
        study.nominal.nodes[0]["gain_up_db"] += 1.0
        sigmas = {**worst.sigmas, next(iter(worst.sigmas)): 0.0}
        return replace(results, worst=(replace(worst, sigmas=sigmas, modulus=0.9),))

    _forge(better)
    code, said = _run(capsys, "--check", "pack", "--sample", "99")
    found = [text for text in _differs(said) if text.endswith("computed again, it differs")]
    assert code == 1
    assert {text.partition(":")[0] for text in found} == {
        "operating point margins 20 s, pitch",
        "dispersed vehicle vehicle 1, pitch",
        "worst vehicle pitch",
        "search worst vehicle at 20 s, pitch",
        "search worst vehicle at 40 s, pitch",
    }


def test_results_that_are_not_those_of_the_suite_are_found(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Fewer vehicles, and a flight with a looser limit, are found, although all rows follow from them."""

    def fewer(results: Results) -> Results:
        (study,), (flight,) = results.margins, results.flights
        first = flight.verdicts[0]
        loose = replace(first, requirement=first.requirement.model_copy(update={"limit": 1e9}))
        flight = replace(flight, verdicts=(loose, *flight.verdicts[1:]))
        return replace(results, margins=(replace(study, random=study.random[:2]),), flights=(flight,))

    _forge(fewer)
    found = _differs(_run(capsys, "--check", "pack")[1])
    places = "their places or limits are not those of the suite"
    assert found == [
        f"results: flights: {places}",
        f"results: margins: {places}",
        "nothing was computed again: the results are not those of the suite",
    ]


def test_an_honest_pack_of_a_flight_alone_agrees(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its gimbal authority is at times that are chosen from the flight."""
    Path("suite.toml").write_text(FLIGHT)
    assert _run(capsys, "ksr3-robust", "--suite", "suite.toml", "--out", "alone")[0] == 0
    code, said = _run(capsys, "--check", "alone")
    assert (code, _differs(said)) == (0, [])
    assert "2 of 2 other results, computed again: " in said


def test_a_pack_of_an_earlier_version_fails_the_check(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A pack without results and without a row of all requirements fails; its own version can check it."""

    def earlier(verdict: dict[str, Any]) -> None:
        del verdict["files"]["results.json.gz"]
        verdict["hashes"]["code"] = "0"

    _verdict(earlier)
    code, said = _run(capsys, "--check", "pack")
    assert (code, _differs(said)) == (
        1,
        [
            "code: another version of maxq",
            "results: the pack has no results.json.gz: nothing was derived or computed again",
        ],
    )


@pytest.mark.slow
def test_missing_evidence_that_was_deleted_from_a_pack_is_found(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The deletion is found even after file hashes and the ledger, which have no key, were computed again."""
    honest = _verdict(lambda verdict: verdict["missing_evidence"].remove("certificate: not in yaw"))
    assert "campaign ksr3: 4 runs, not 852" in honest["missing_evidence"]
    (found,) = _differs(_run(capsys, "--check", "pack", "--sample", "0")[1])
    count = len(honest["missing_evidence"])
    assert found == f"missing_evidence: {count} in the pack, {count + 1} by the results"


@pytest.mark.slow
def test_other_inputs_are_found_and_nothing_is_computed(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("suite.toml").write_text(SUITE.replace("gain_up_db = 3.0", "gain_up_db = 2.0").replace('2.0"', '1.0"'))
    code, said = _run(capsys, "--check", "pack")
    assert code == 1
    assert {"input: suite: margins", "input: flight two seconds", "input: campaign 1, ksr3"} <= set(_differs(said))
    assert "nothing was derived or computed again: the inputs differ" in said
    assert "flights, computed again" not in said
    _verdict(lambda verdict: verdict["hashes"].update(code="0"))
    assert "code: another version of maxq" in _run(capsys, "--check", "pack")[1]


@pytest.mark.slow
def test_runs_that_were_edited_are_found(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Edited runs are found even after the hashes of the files were computed again."""
    _recompute_only(monkeypatch, "runs")
    (part,) = Path("pack/verdict-runs/1/runs").glob("*.parquet")
    table = pq.read_table(part)
    at = table.schema.get_field_index("max_attitude_error_deg")
    values = [10.0, *table.column(at).to_pylist()[1:]]  # beyond the limit
    pq.write_table(table.set_column(at, table.schema.field(at), [values]), part)
    name = part.relative_to("pack").as_posix()
    _verdict(lambda verdict: verdict["files"].update({name: hashlib.sha256(part.read_bytes()).hexdigest()}))
    code, said = _run(capsys, "--check", "pack", "--sample", "99")
    assert code == 1
    found = _differs(said)
    assert found[0] == 'verdict: "undecided" in the pack, "rejected" by the results'
    assert found[1].startswith("requirements: ksr3: attitude error (campaign): found: ")
    assert found[-1] == "run 0 of ksr3: computed again, it differs"


@pytest.mark.long
def test_success_that_was_edited_is_named_in_every_row(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (part,) = Path("pack/verdict-runs/1/runs").glob("*.parquet")
    table = pq.read_table(part)
    at = table.schema.get_field_index("passed")
    pq.write_table(table.set_column(at, table.schema.field(at), [[False] * 4]), part)
    assert [text for text in _differs(_run(capsys, "--check", "pack", "--sample", "0")[1]) if "`passed`" in text] == [
        f"campaign ksr3: run {run}: `passed` does not follow from its metrics and requirements" for run in range(4)
    ]


@pytest.mark.long
def test_a_verification_waits_for_another_that_flies_its_campaign(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The waiting verification prints a line, and the two share the runs."""
    (folder,) = Path("memory").glob("campaign-*")
    lock = filelock.FileLock(folder / "lock", thread_local=False)
    lock.acquire()
    (folder / "lock").write_text("4242")
    lines = list[str]()

    def heard(_: str, line: str) -> None:
        lines.append(line)
        lock.release()

    monkeypatch.setattr("maxq.tools.verify.run.say", heard)
    code, said = _run(capsys, "ksr3-robust", "--suite", "suite.toml", "--no-pack", "--out", "again", "--sample", "0")
    assert code == 3
    assert "4 of 4 runs of campaign ksr3 recalled from the cache" in said
    assert lines == ["campaign 1: waiting for process 4242, which is flying it"]


@pytest.mark.slow
def test_a_ledger_that_lost_attempts_of_a_pack_is_found(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (own,) = Path("ledger").glob("*.jsonl")
    lines = own.read_text().splitlines()
    own.write_text(lines[0] + "\n")
    assert "ledger of this machine: lacks 1 lines of the pack" in _run(capsys, "--check", "pack", "--sample", "0")[1]
    copy = Path("pack/attempts.jsonl")
    copy.write_text(copy.read_text().replace("undecided", "accepted"))
    _verdict(lambda verdict: verdict.update(verdict="accepted"))
    found = _differs(_run(capsys, "--check", "pack", "--sample", "0")[1])
    assert found[:2] == ["file attempts.jsonl: its SHA-256 differs", "ledger of attempts: line 2 was changed"]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "pack/verdict.json: cannot be read: no such file or directory"),
        ("{", "pack/verdict.json: is not JSON: "),
        ("[]", "pack/verdict.json: no verdict.json that can be checked: it has no asked"),
        (
            '{"asked": {}, "files": {}, "hashes": {}, "attempt": {}, "flights": []}',
            "that can be checked: it has no verdict",
        ),
        (
            '{"asked": {}, "files": {}, "hashes": {}, "attempt": {}, "flights": [], "verdict": "x", "suite": "y"}',
            "of this version of simverify",
        ),
    ],
)
def test_what_cannot_be_read_has_an_exit_code_of_its_own(
    content: str | None, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pack").mkdir()
    if content is not None:
        Path("pack/verdict.json").write_text(content)
    code, text = _run(capsys, "--check", "pack")
    assert (code, len(text.splitlines())) == (2, 1)
    assert said in text


@pytest.mark.long
@pytest.mark.skipif(shutil.which("ssh-keygen") is None, reason="no ssh-keygen")
def test_packs_are_signed_and_their_signers_checked(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("key", "other"):
        subprocess.run(["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", name], check=True)
        Path(f"{name}.allowed").write_text(f"board@example.org {Path(f'{name}.pub').read_text()}")
    code, said = _run(capsys, "--check", "pack", "--sample", "0", "--allowed", "key.allowed")
    assert (code, _differs(said)) == (1, ["signature: the pack has none"])
    words = ["ksr3-robust", "--suite", "suite.toml", "--out", "pack", "--sample", "0"]
    assert _run(capsys, *words, "--sign", "missing")[1].startswith("simverify: missing: cannot sign: ")
    assert _run(capsys, *words, "--sign", "key")[0] == 3
    code, said = _run(capsys, "--check", "pack", "--sample", "0", "--allowed", "key.allowed")
    assert code == 0
    assert 'Good "maxq-verdict" signature for board@example.org' in said
    assert "--allowed FILE names those allowed" in _run(capsys, "--check", "pack", "--sample", "0")[1]
    code, said = _run(capsys, "--check", "pack", "--sample", "0", "--allowed", "other.allowed")
    assert (code, _differs(said)[0][:46]) == (1, "signature: the signer is not in other.allowed:")
    _verdict(lambda verdict: verdict.update(more_runs=0))
    code, said = _run(capsys, "--check", "pack", "--sample", "0", "--allowed", "key.allowed")
    assert (code, len(_differs(said))) == (1, 2)
    assert _differs(said)[1] == "more_runs: 0 in the pack, 1100 by the results"
    assert _run(capsys, *words, "--no-pack")[0] == 3
    code, said = _run(capsys, "--check", "pack", "--sample", "0")
    lacking = "results: the pack has no results.json.gz: nothing was derived or computed again"
    assert _differs(said) == [lacking]  # those in the folder are of another
    assert not Path("pack/verdict.json.sig").exists()  # of what is no longer there


def test_signing_without_ssh_keygen_is_a_one_line_error(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(here / "memory"))
    code, said = _run(capsys, "ksr3-robust", "--suite", "suite.toml", "--sign", "key")
    assert (code, said.splitlines()) == (
        2,
        ["simverify: ssh-keygen is missing: install OpenSSH 8.1 or later to sign packs and check them"],
    )


def _verify(capsys: pytest.CaptureFixture[str], *more: str) -> tuple[int, str]:
    return _run(capsys, "ksr3-robust", "--suite", "suite.toml", "--out", "again", "--no-pack", *more)


@pytest.mark.slow
def test_recalled_results_are_named_and_a_sample_is_computed_again(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, said = _verify(capsys, "--sample", "1")
    assert code == 3
    assert "NOT COMPUTED AFRESH: 7 of 7 parts and 4 of 4 runs of campaign ksr3 recalled from the cache; 2 comp" in said
    recalled = json.loads(Path("again/verdict.json").read_text())["recalled"]
    assert recalled["parts"] == [
        "flight two seconds",
        "margins 20 s, pitch",
        "margins 40 s, pitch",
        "node 30 s, pitch",
        "slosh",
        "uncovered",
        "worst pitch",
    ]
    assert len(recalled["computed_again"]) == len(recalled["runs"]["ksr3"]["flown_again"]) == 1
    Path("suite.toml").write_text(FLIGHT)
    assert "NOT COMPUTED AFRESH: 1 of 1 parts recalled" in _verify(capsys)[1]
    assert "computed afresh" in _verify(capsys, "--afresh")[1]


@pytest.mark.slow
def test_a_forged_part_in_the_cache_is_found_in_the_sample(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """An edited metric of a stored flight with a new checksum is found."""
    Path("suite.toml").write_text(FLIGHT)
    (part,) = Path("memory").glob("flight-*.json")
    _, _, rest = part.read_bytes().partition(b"\n")
    before = json.loads(Path("pack/verdict.json").read_text())["flights"][0]["metrics"]["max_attitude_error_deg"]
    forged = rest.replace(json.dumps(before).encode(), b"0.01")
    assert forged != rest
    part.write_bytes(hashlib.sha256(forged).hexdigest().encode() + b"\n" + forged)
    code, said = _verify(capsys, "--sample", "0")
    assert "none computed again" in said  # and nothing is found
    code, said = _verify(capsys, "--sample", "99")
    assert code == 2
    assert said.splitlines()[-1].endswith(
        "flight two seconds: kept results differ from their computation; verify with --afresh"
    )
    (own,) = Path("ledger").glob("*.jsonl")
    assert ledger.read_lines(own)[0][-1]["verdict"] == "none: recalled results differ from their computation"


@pytest.mark.long
def test_a_forged_run_in_the_cache_is_found_in_the_sample(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (part,) = Path("memory").glob("campaign-*/runs/*.parquet")
    table = pq.read_table(part)
    at = table.schema.get_field_index("max_attitude_error_deg")
    values = [*table.column(at).to_pylist()[:-1], 0.01]
    pq.write_table(table.set_column(at, table.schema.field(at), [values]), part)
    code, said = _verify(capsys, "--sample", "99")
    assert (code, "ksr3 run 3: kept results differ from their computation" in said) == (2, True)


def test_a_sample_of_recalled_parts_is_compared(tmp_path: Path) -> None:
    PartsOnDisk(tmp_path).recall("part", 1.0, lambda: 7, "a")
    memory = PartsOnDisk(tmp_path)
    for _ in range(2):  # a part that is read twice counts once
        memory.recall("part", 1.0, lambda: 8, "a")  # as if the file had been forged
    memory.recall("part", 2.0, lambda: 9, "b")
    assert memory.recall("part", 2.0, lambda: 10, "b") == 9  # of this computation
    assert memory.recalled_names == ("part a",)
    assert memory.recheck(0) == ((), ())
    assert memory.recheck(5) == (("part a",), ("part a",))


@pytest.mark.long
def test_registered_seed_is_on_the_first_page(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree("ledger")  # in which the declared seed was flown
    seed = ("--set", "campaign.0.seed=7")
    by_hand = "seed 7 of campaign.0, not the declared 20021128: "
    assert _run(capsys, "ksr3-robust", "--suite", "suite.toml", "--register")[0] == 2
    code, said = _run(capsys, "ksr3-robust", "--suite", "suite.toml", *seed, "--register")
    assert (code, said) == (0, "registered for KSR-III (reconstruction): seed 7 of campaign.0\n")
    assert f"{by_hand}registered on 20" in _verify(capsys, *seed, "--sample", "0")[1]
    said = _verify(capsys, "--sample", "0")[1]
    replaced = "seed 20021128 of campaign.0 replaced by the registered seed 7"
    assert f"\n{replaced}\n" in said
    assert "attempt 2 for this vehicle; 1 earlier one: UNDECIDED" in said
    verdict = json.loads(Path("again/verdict.json").read_text())
    assert replaced in verdict["missing_evidence"]
    assert [one["seeds"]["campaign.0"] for one in verdict["attempt"]["others"]] == [7]
