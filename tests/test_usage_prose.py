"""`make lint` counts faults of English in pages, docstrings, comments and messages, and accepts no new ones."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from maxq.tools.dev import prose
from maxq.tools.dev.prose import CHECKS, Finding, Sources, complaints, documentation_words, lower

PAGE = """# Title

This sentence is short. The gyro stands in the nose, `which lies in code`.

```console
$ it stands in the code
```

    it lies in an indented block

| a cell beside another |
"""
MODULE = '''"""Whether a thing is so."""

Pair = tuple[int, int]

class Plane:
    """Return what a sentence of thirty-one words needs: {words}."""

    text = "this lies between two nodes"
    short = "anew"
    table = (1,
                          2)  # FMT: skip  # it is KNOWN
'''
MODULE = MODULE.replace("FMT", "fmt").replace("KNOWN", "told")  # the check reads this file, too
OTHER = "Pair = tuple[int, int]\n\nPlane = dict[str, float]\n"


def found(kind: str, **files: str) -> list[Finding]:
    """Return the findings of a check in a page and two modules."""
    modules = {f"{name}.py": (text, ast.parse(text)) for name, text in files.items() if name != "page"}
    pages = {"page.md": files["page"]} if "page" in files else {}
    return list(CHECKS[kind](Sources(pages, modules)))


def test_a_docstring_begins_with_a_verb() -> None:
    assert found("first_words", module=MODULE) == [Finding("module.py:1", "Whether a thing is so.")]


def test_banned_phrases_are_found_in_prose_comments_and_messages_but_not_in_code() -> None:
    assert found("banned_phrases", page=PAGE, module=MODULE) == [
        Finding("page.md:3", "stands in"),
        Finding("page.md:11", "beside"),
        Finding("module.py:8", "lies between"),
        Finding("module.py:11", "is told"),
    ]


def test_banned_phrases_are_found_in_toml_files_and_templates() -> None:
    files = {
        "a.toml": 'name = "beside"\ndescription = "an engine beside a tank"\nx = 1  # is KNOWN\n'.replace(
            "KNOWN", "told"
        ),
        "b.j2": "{# it stands\nin it #}\n<p class='beside'>{{ beside }} lies in</p>\n",
    }
    assert list(CHECKS["banned_phrases"](Sources({}, {}, files))) == [
        Finding("a.toml:2", "beside"),
        Finding("a.toml:3", "is " + "told"),
        Finding("b.j2:3", "lies in"),
    ]


@pytest.mark.parametrize(("words", "number"), [(22, 0), (23, 1)])
def test_a_sentence_has_at_most_thirty_words(words: int, number: int) -> None:
    text = MODULE.format(words=" ".join(["word"] * words))
    assert len(found("long_sentences", module=text)) == number


def test_code_may_begin_a_sentence() -> None:
    words = " ".join(["word"] * 20)
    page = f"This has {words}. `code` begins this sentence with {words}.\n"
    assert found("long_sentences", page=page) == []
    assert len(found("long_sentences", page=page.replace(". `", " and `"))) == 1


def test_a_text_may_be_allowed_with_its_reason() -> None:
    assert found("banned_phrases", page="The law `x` and incidence-relief, at an incidence.\n") == [
        Finding("page.md:1", "incidence")
    ]


def test_a_type_name_means_one_type() -> None:
    assert found("type_names", module=MODULE, other=OTHER) == [Finding("module.py:5", "Plane: also other.py:3")]


def test_places_that_the_formatter_skips_are_counted() -> None:
    assert found("unformatted", module=MODULE) == [Finding("module.py:11", "fmt: skip  # it is " + "told")]


def test_a_number_must_equal_its_record_and_only_falls() -> None:
    findings = {"up": [Finding("a", "b")] * 3, "down": [Finding("a", "b")], "equal": []}
    recorded = {"up": 2, "down": 2, "equal": 0}
    assert complaints(findings, recorded) == [
        "up: 3, and 2 are recorded: mend the new ones (--list up)",
        "down: 1 of 2 recorded are left: record it (--record)",
    ]
    assert lower("up = 2\ndown = 2\nequal = 0\n", findings, recorded) == "up = 2\ndown = 1\nequal = 0\n"


def test_words_of_the_documentation_are_bounded(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    """Words of tables and code count, without their bars and signs; generated text does not count."""
    page = "# Title\n\n| a | b2 |\n|---|---|\n\n    x <= 3\n<!-- from code: keys -->\nno word\n<!-- end of code -->\n"
    pages = {"README.md": page, "docs/howto/a.md": page, "docs/reference/b.md": page, "CONTRIBUTING.md": page}
    assert documentation_words(pages) == 2 * 5
    monkeypatch.setattr(prose, "MOST_WORDS", 9)
    (record := tmp_path / "prose.toml").write_text("[counts]\nlong_sentences = 0\n")
    monkeypatch.setattr(prose, "RECORD", record)
    monkeypatch.setattr(prose, "CHECKS", {"long_sentences": CHECKS["long_sentences"]})
    monkeypatch.setattr(Sources, "of_repository", lambda: Sources(pages, {}))
    assert prose.main([]) == 1
    assert "documentation: 10 words, 9 are allowed" in capsys.readouterr().err
    monkeypatch.setattr(prose, "MOST_WORDS", 10)
    assert prose.main([]) == 0
