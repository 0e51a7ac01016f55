"""Output fits the terminal: no line is too wide, no word is cut, and colours end in pipes."""

from __future__ import annotations

import contextlib
import fcntl
import io
import os
import pty
import re
import struct
import subprocess
import sys
import termios
import threading
import time
from collections import Counter
from types import ModuleType

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len

from maxq.sim.run.quantities import number_text
from maxq.tools import simdesign, simreplay, simrun, simvehicle, simverify
from maxq.tools.cli import terminal
from maxq.tools.cli.terminal import aligned, folded, painted

WIDTHS = (80, 120)
CELLS = st.text("abcdefgh ij", max_size=40).map(lambda text: " ".join(text.split()))
TABLES = st.integers(1, 9).flatmap(lambda n: st.lists(st.lists(CELLS, min_size=n, max_size=n), min_size=1, max_size=6))


def on_a_terminal(code: str, width: int = 80, **environment: str) -> str:
    """Return the output of Python code on a terminal of a given width."""
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, width, 0, 0))
    plain = {key: value for key, value in os.environ.items() if key not in ("COLUMNS", "NO_COLOR")}
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=plain | {"TERM": "xterm"} | environment,
    )
    os.close(theirs)
    shown = b""
    with contextlib.suppress(OSError):  # Linux's way of saying that the other side is closed
        while piece := os.read(ours, 65536):
            shown += piece
    os.close(ours)
    assert process.wait() == 0, shown.decode()
    return shown.decode().replace("\r\n", "\n")


@given(rows=TABLES, width=st.integers(50, 120))
def test_a_table_keeps_every_word_and_fits(rows: list[list[str]], width: int) -> None:
    """A line is wider only if the first column and another one, unbroken, are wider."""
    lines = aligned(rows, "  ", width=width)
    words = Counter(word for row in rows for cell in row for word in cell.split())
    shown = Counter(word for line in lines for word in line.split())
    first = Counter(word for row in rows for word in row[0].split())
    assert set(shown) == set(words)
    assert all(words[w] <= shown[w] for w in words)
    assert all(shown[w] - words[w] <= len(rows[0]) * first[w] for w in words)  # blocks repeat the first column
    longest = [max((len(word) for row in rows for word in row[i].split()), default=0) for i in range(len(rows[0]))]
    assert max(cell_len(line) for line in lines) <= max(width, 2 + longest[0] + 2 + max(longest))


def test_columns_are_dropped_in_order_and_only_where_needed() -> None:
    rows = [("name", "verdict", "value", "spare", "rare"), ("q alpha", "met", "1.0", "x" * 20, "y" * 20)]
    assert "spare" in aligned(rows, drop=(4, 3), width=80)[0]
    assert aligned(rows, drop=(4, 3), width=45)[0].split() == ["name", "verdict", "value", "spare"]
    assert "rare" not in "".join(aligned(rows, drop=(4, 3), width=30))


def test_numbers_stay_whole_and_right() -> None:
    rows = [("requirement of a long name indeed", "1.25"), ("b", "1000")]
    lines = aligned(rows, right=(1,), width=24)
    assert all(len(line) <= 24 for line in lines)
    assert lines[0].endswith("1.25")
    assert lines[-1].endswith("1000")


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("command", [simrun, simdesign, simverify, simreplay, simvehicle])
def test_help_fits(command: ModuleType, width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    for shown in command._parser().helps().values():
        assert max(cell_len(line) for line in shown.splitlines()) <= width
        assert not re.search(r"\w-\n +\w", shown)
        assert "examples:" in shown


@pytest.mark.parametrize("width", WIDTHS)
@pytest.mark.parametrize("command", [simrun, simdesign, simverify])
def test_lists_fit_and_begin_with_what_to_begin_with(
    command: ModuleType, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    assert command.main(["--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert max(cell_len(line) for line in lines) <= width
    first = {simrun: "nominal", simdesign: "ksr3-identical", simverify: "standard"}[command]
    assert lines[1].split()[0] == first


def test_sentences_are_folded_at_spaces_and_commands_stay_whole() -> None:
    text = "  missed: " + "word " * 40
    assert all(len(line) <= 80 for line in folded(text, 80).splitlines())
    assert folded(text, 80).startswith(text[:40])
    assert folded(text, 80).split() == text.split()
    command = "  simrun --from " + "runs/" * 30 + " --run 17"
    assert folded(command, 80) == command


def test_verdicts_are_coloured_as_cells_and_heads_of_lines_only() -> None:
    shown = on_a_terminal(
        "from maxq.tools.cli.terminal import tell\n"
        "tell('  q alpha  met     1  <= 2', '  lateral  MISSED  3', 'FAILED: 2 requirements missed', 'it met with')"
    )
    assert "\x1b[32mmet\x1b[0m     1" in shown
    assert "\x1b[1;31mMISSED\x1b[0m  3" in shown
    assert shown.splitlines()[2] == "\x1b[1;31mFAILED\x1b[0m: 2 requirements missed"
    assert shown.splitlines()[3] == "it met with"


def test_no_color_dumb_terminals_and_pipes_have_no_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    code = "from maxq.tools.cli.terminal import tell; tell('FAILED: x')"
    assert "\x1b" not in on_a_terminal(code, NO_COLOR="1")
    assert "\x1b" not in on_a_terminal(code, TERM="dumb")
    monkeypatch.delenv("NO_COLOR", raising=False)
    assert painted("FAILED: x", io.StringIO()) == "FAILED: x"


def test_a_pipe_gets_whole_lines_unless_columns_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    long = " ".join(["word"] * 60)
    monkeypatch.delenv("COLUMNS", raising=False)
    assert aligned([("a", long)], width=None) == [f"a  {long}"]
    monkeypatch.setenv("COLUMNS", "80")
    assert max(map(len, aligned([("a", long)]))) <= 80


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (49820.6, "49820"),
        (1341719.0, "1342000"),
        (852.139, "852.1"),
        (0.00630254, "0.006303"),
        (-1.31316e-07, "0"),
        (0.0, "0"),
        (-4.25, "-4.250"),
        (float("nan"), "-"),
        (float("inf"), "inf"),
        (3.6e9, "3.6e+09"),
        (2.5e-5, "2.5e-05"),
    ],
)
def test_four_significant_digits(value: float, text: str) -> None:
    assert number_text(value) == text


def test_many_threads_move_one_bar_that_goes_away() -> None:
    """Two threads that open a bar at once share one bar, which disappears at the end."""
    shown = on_a_terminal(
        "import threading\n"
        "from maxq.tools.cli import terminal\n"
        "terminal._PATIENCE_S = 0.0\n"
        "with terminal.Progress() as progress:\n"
        "    ts = [threading.Thread(target=lambda k=k: [progress.show('margins', n, 50, f'{k}') for n in range(50)])"
        " for k in range(8)]\n"
        "    [t.start() for t in ts], [t.join() for t in ts]\n"
        "progress.show('margins', 50, 50)\n"
        "print('END')"
    )
    assert shown.rstrip().endswith("END")
    assert shown.count("\x1b[?25l") == 1  # the cursor is hidden once, by one bar
    assert shown.count("\x1b[?25h") == 1
    assert shown.rindex("margins") < shown.rindex("\x1b[2K") < shown.rindex("END")  # wiped before the end
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "\r", shown)
    assert max(cell_len(part) for part in re.split(r"[\r\n]", plain)) <= 77  # there is room for the "^C" of a terminal


def test_compiling_names_the_vehicle_and_its_share_and_gives_the_bar_back() -> None:
    shown = on_a_terminal(
        "from maxq.control.kernel.progress import compilation\n"
        "from maxq.control.kernel.jit import entry, kernel\n"
        "from maxq.tools.cli import terminal\n"
        "terminal._PATIENCE_S = 0.0\n"
        "@kernel\ndef circumference(x): return x * 3.0\n"
        "def twice(x): return circumference(x) * 2.0\n"
        "with terminal.Progress() as progress:\n"
        "    progress.show('flying', 1, 2)\n"
        "    with compilation('ksr3', twice):\n"
        "        entry(twice)(1.0)\n"
        "    progress._bar.refresh()\n",
        width=120,
    )
    assert "compiling for ksr3, once" in shown
    assert "circumference" not in shown
    shares = [int(share) for share in re.findall(r" (\d+)%", shown)]
    assert 0 < shares[0] < 100  # 100 % ends the display
    assert shown.rindex("flying") > shown.rindex("compiling for ksr3")


def test_a_bar_is_never_without_a_name() -> None:
    """Before the first step the bar reads that it prepares; `at_once` shows it without a second step."""
    shown = on_a_terminal(
        "from maxq.tools.cli import terminal\n"
        "with terminal.Progress(at_once=True) as progress:\n"
        "    progress.compiling('ksr3', 0.5)\n"
        "    progress._compiling_s = 0.0\n"
        "    progress.compiling('ksr3', 0.5)\n"
        "    progress.compiling('ksr3', 1.0)\n"
        "    progress._bar.refresh()\n"
        "    progress.show('drawing', 0, 0)\n"
        "    progress._bar.refresh()\n"
        "    print('x' * 40 + ' ' + 'y' * 39)\n"
    )
    assert "x" * 40 + " " + "y" * 39 in shown  # text printed next to it has the whole width
    lines = [re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", part).strip() for part in re.split(r"[\r\n]", shown)]
    bars = [line for line in lines if "\u2501" in line]
    assert len(bars) > 2
    assert all(re.match(r"(preparing|compiling|drawing) ", bar) for bar in bars), bars


def test_a_stage_is_named_before_its_bar_is_due_and_a_single_step_has_no_number() -> None:
    shown = on_a_terminal(
        "from maxq.tools.cli import terminal\n"
        "with terminal.Progress() as progress:\n"
        "    progress.show('linearising', 0, 7)\n"
        "    progress.show('linearising', 1, 7)\n"
        "    progress._last_s = 0.0\n"
        "    progress.show('writing the page', 0, 1)\n"
        "    progress._bar.refresh()\n"
        "terminal.tell('END')\n"
    )
    assert shown.startswith("linearising\r\x1b[2K")  # once, and wiped by the bar
    assert shown.count("linearising") == 1
    assert "writing the page" in shown
    assert "0 of 1" not in shown


def test_a_number_is_never_cut_and_the_clock_of_a_complete_bar_runs_on() -> None:
    shown = on_a_terminal(
        "from maxq.tools.cli import terminal\n"
        "with terminal.Progress(at_once=True) as progress:\n"
        "    progress.show('optimising (round 2): starts', 2, 2, 'best so far -10.93 dB')\n"
        "    progress._bar.refresh()\n"
        "    assert not progress._bar.finished\n"
        "print('END')\n"
    )
    assert "2 of 2" in shown
    assert "best" not in shown  # it does not fit 80 columns
    assert shown.rstrip().endswith("END")


def test_a_bar_after_its_block_shows_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "_PATIENCE_S", 0.0)
    with terminal.Progress(0.0) as progress:
        pass
    progress._terminal = False
    before = threading.active_count()
    progress.show("late", 1, 2)
    time.sleep(0.01)
    assert threading.active_count() == before


def test_a_command_shows_at_once_that_it_has_begun_and_wipes_it() -> None:
    code = "from maxq.tools import {0}; {0}.main({1})"
    shown = on_a_terminal(code.format("simrun", "['nowhere']"))
    assert shown.startswith("simrun: loading\r\x1b[2Ksimrun: nowhere: neither a file nor ")
    assert "loading" not in on_a_terminal(code.format("simrun", "['--list']"))
    assert "loading" not in on_a_terminal(code.format("simrun", "['nowhere']"), TERM="dumb")


@pytest.mark.parametrize(("width", "parts"), [(80, 2), (120, 3), (60, 1)])
def test_a_note_beside_a_bar_is_shortened_by_whole_parts(width: int, parts: int) -> None:
    notes = ("0 failed", "rate 98 % used", "another of a long name 97 % used")
    shown = on_a_terminal(
        "from maxq.tools.cli import terminal\n"
        "with terminal.Progress(at_once=True) as progress:\n"
        f"    progress.show('flying', 37, 100, {'; '.join(notes)!r}, '37 of 100, 12.3/s')\n",
        width=width,
    )
    assert "; ".join(notes[:parts]) in shown
    assert "\u2026" not in shown
    assert parts == len(notes) or notes[parts] not in shown
