"""`simverify --only PART` keeps the suite's limits, shows measured margins and names omitted parts."""

from __future__ import annotations

import html
import json
from pathlib import Path

import pytest
from flight_code import EXAMPLES, compiled, needs_compiler

from maxq.design.verify.suite import read_suite
from maxq.tools.simverify import main

SMALL = """
schema = 2
[margins]
times_s = [40.0]
cases = 0
corner_sigmas = 0.0
[margins.nominal]
gain_up_db = 12.0
[certificate]
times_s = [40.0]
planes = ["pitch"]
[[flight]]
name = "a second"
set = ["run.duration_s=1.0"]
"""


def test_a_part_alone_keeps_the_limits_and_names_what_is_left_out() -> None:
    whole = read_suite("standard")
    assert whole.suite.margins is not None
    certificate = whole.only("certificate")
    assert certificate.suite.margins is not None
    assert certificate.suite.margins.nominal == whole.suite.margins.nominal
    assert certificate.suite.dispersed_limit == whole.suite.dispersed_limit
    assert certificate.left_out == ("46 flights", "linear margins", "campaign campaigns/ksr3")
    flight = whole.only("limit wind")
    assert flight.suite.dispersed_limit == whole.suite.dispersed_limit
    assert flight.left_out == ("45 flights", "linear margins", "certificate", "campaign campaigns/ksr3")
    designed = read_suite("standard", ["wind_limit_mps=9.0"]).only("as designed")
    assert designed.suite.wind_limit_mps == 9.0
    assert designed.left_out == (
        "46 flights",
        "linear margins but for 'as designed'",
        "certificate",
        "campaign campaigns/ksr3",
    )
    assert "wind that can be trimmed" in read_suite("standard", ["wind_limit_mps=9.0"]).only("worst").left_out


@pytest.mark.long
@needs_compiler
def test_the_certificate_of_flight_code_alone_is_judged_by_the_limits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The upper gain margin is 6.3 dB and misses the suite's limit of 12 dB."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("maxq.design.verify.memory.default_folder", lambda: tmp_path / "memory")
    monkeypatch.setattr("maxq.tools.verify.report.print_page", lambda *_: None)
    library = compiled(tmp_path, EXAMPLES / "pd_law.c", "pd_law")
    Path("small.toml").write_text(SMALL)
    words = [f"./{library.name}", "--suite", "small.toml", "--only", "certificate", "--out", "out"]
    assert main(words) == 1
    lines = capsys.readouterr().out.splitlines()
    table = lines[lines.index("margins measured in flight") :]
    assert table[1].split("  ")[-1] == "remark"
    assert table[2].split()[:5] == ["40", "s", "pitch", "gain", "up"]
    assert "left out: 1 flight" in lines
    assert "left out: linear margins" in lines
    last = next(line for line in reversed(lines) if line)
    assert last.startswith("REJECTED: upper gain margin 6.")
    assert " dB < 12 dB at 40 s (pitch); " in last
    assert last.endswith(" requirements met. A screening can reject, not accept.")
    verdict = json.loads(Path("out/verdict.json").read_text())
    assert (verdict["part"], verdict["left_out"]) == ("certificate", ["1 flight", "linear margins"])
    assert verdict["missing_evidence"] == ["'certificate' was judged alone"]
    page = " ".join(Path("out/review.html").read_text().split())
    reason = last.removeprefix("REJECTED: ")
    shown = f'<div class="outcome bad"><b>REJECTED</b><p>{reason[0].upper()}{reason[1:]}</p></div>'
    assert shown in html.unescape(page)
    assert "This code under test was executed for the review, in a process of its own." in page
