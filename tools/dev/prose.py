"""Check the project's English by program: `python -m maxq.tools.dev.prose`, part of `make lint`.

prose.toml, next to this file, contains the recorded number of findings of each kind, the banned phrases and the allowed
texts. The check fails if a number differs from its record, or if the documentation has more than MOST_WORDS words.
`--record` only lowers recorded numbers; `--list KIND` prints the findings of a kind.
"""

from __future__ import annotations

import argparse
import ast
import gc
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[2]
RECORD = Path(__file__).with_suffix(".toml")
LONGEST_SUBJECT = 72  # characters of the subject of a commit
LONGEST_SENTENCE = 30  # words
MOST_WORDS = 55_000  # of the documentation
_FIRST_WORDS = {"What", "Whether", "Where", "How", "Of", "One", "Behind"}
_DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)
_HISTORY = "CHANGELOG.md"  # contains former names and behaviour
# The parts of Markdown that are not prose: front matter, fenced and indented blocks, formulas, comments, link targets.
_NOT_PROSE = re.compile(r"(?ms)\A---\n.*?^---$|^ *(```|~~~|:::).*?^ *\1 *$|^ {4}[^\n]*$|\$\$.*?\$\$|<!--.*?-->")
_FROM_CODE = re.compile(r"(?s)<!-- from code:.*?<!-- end of code -->")  # help texts and tables of keys
_COMMENT = re.compile(r"(?:^\s*|  )# (.*)")
_STATED = re.compile(r"#|^(?:description|why|source) *=")  # lines of TOML files that contain prose
_MARKUP = re.compile(r"(?s)\{#.*?#\}|\{%.*?%\}|\{\{.*?\}\}|<[^>\n]*>")
_INLINE = re.compile(r"(?s)`+[^`]*`+|\$[^$\n]+\$|(?<=\])\([^)]*\)|<[^>\n]*>|https?://\S+")
_SENTENCE_END = re.compile(r"(?<=[.!?:])\s+(?=[\"'(*]*[A-Z0-9`])|\n\s*\n|\n\s*(?=[-*|#>]|\d+\. )")


@dataclass(frozen=True)
class Finding:
    """A text that breaks a rule, and its place."""

    place: str
    text: str


@dataclass(frozen=True)
class Passage:
    """A piece of prose, its place, and True in `in_sentences` if it consists of sentences."""

    place: str
    words: str
    in_sentences: bool


@dataclass(frozen=True, eq=False)
class Sources:
    """The files of the repository: Markdown pages, Python files with their syntax trees, TOML files and page
    templates.
    """

    pages: dict[str, str]
    modules: dict[str, tuple[str, ast.Module]]
    files: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of_repository(cls) -> Sources:
        """Read every file that git tracks. Raises OSError and SyntaxError."""
        listed = subprocess.run(
            ["git", "ls-files", "--", "*.md", "*.py", "*.toml", "*.j2"],
            cwd=REPOSITORY,
            capture_output=True,
            text=True,
            check=True,
        )
        texts = {
            name: path.read_text(encoding="utf-8")
            for name in listed.stdout.splitlines()
            if (path := REPOSITORY / name).is_file()
        }
        return cls(
            {name: text for name, text in texts.items() if name.endswith(".md") and name != _HISTORY},
            {name: (text, ast.parse(text)) for name, text in texts.items() if name.endswith(".py")},
            {name: text for name, text in texts.items() if name.endswith((".toml", ".j2"))},
        )


@cache
def strings(sources: Sources) -> tuple[tuple[str, str, bool], ...]:
    """Return the place and text of every string, and True for a docstring."""
    found = []
    for name, (_, tree) in sources.modules.items():
        bare: set[int] = set()  # strings that are statements, such as docstrings
        for node in ast.walk(tree):  # a parent comes before its children
            if isinstance(node, _DOCUMENTED) and (text := ast.get_docstring(node)):
                found.append((f"{name}:{node.body[0].lineno}", text, True))
            elif isinstance(node, ast.Expr):
                bare.add(id(node.value))
            elif isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in bare:
                found.append((f"{name}:{node.lineno}", node.value, False))
    return tuple(found)


def comments(source: str) -> Iterator[tuple[int, str]]:
    """Yield the line and text of every comment. The formatter puts comments on their own lines or two spaces after
    code.
    """
    for number, line in enumerate(source.splitlines(), 1):
        if "#" in line and (found := _COMMENT.search(line)):
            yield number, found[1]


@cache
def texts(sources: Sources) -> tuple[Passage, ...]:
    """Return the prose of pages, docstrings, comments, messages, TOML files and templates.

    Messages are strings of at least three words outside tests.
    """
    return tuple(_texts(sources))


def _texts(sources: Sources) -> Iterator[Passage]:
    for name, page in sources.pages.items():
        blanked = _NOT_PROSE.sub(lambda part: "\n" * part[0].count("\n"), page)
        line = 1
        for paragraph in re.split(r"(\n\s*\n)", _INLINE.sub(lambda part: "X" + "\n" * part[0].count("\n"), blanked)):
            if paragraph.strip():
                yield Passage(f"{name}:{line}", paragraph, not paragraph.lstrip().startswith("|"))
            line += paragraph.count("\n")
    for place, text, documents in strings(sources):
        if documents:
            yield Passage(place, _INLINE.sub("X", text), True)
        elif len(text.split()) >= 3 and not place.startswith("tests/"):
            yield Passage(place, text, False)
    for name, (source, _) in sources.modules.items():
        for line, comment in comments(source):
            yield Passage(f"{name}:{line}", comment, False)
    for name, text in sources.files.items():
        plain = _MARKUP.sub(lambda part: "\n" * part[0].count("\n"), text)
        for number, words in enumerate(plain.splitlines(), 1):
            if name.endswith(".j2") or _STATED.search(words):
                yield Passage(f"{name}:{number}", words, False)


def first_words(sources: Sources) -> Iterator[Finding]:
    """Yield the docstrings that begin with a word such as What or Whether in place of a verb."""
    for place, text, documents in strings(sources):
        if documents and text.split()[0].strip(",.:;") in _FIRST_WORDS:
            yield Finding(place, text.splitlines()[0])


def banned_phrases(sources: Sources) -> Iterator[Finding]:
    """Yield the phrases that the record bans, except in the texts that it allows with a reason."""
    record = tomllib.loads(RECORD.read_text(encoding="utf-8"))
    pattern = re.compile(r"\b(?:" + "|".join(record["banned"]) + r")\b", re.IGNORECASE)
    names = re.compile("|".join(re.escape(each["text"]) for each in record["allowed"]))
    for text in texts(sources):
        for found in pattern.finditer(names.sub("X", " ".join(text.words.split()))):
            if not text.place.startswith("tools/dev/prose."):
                yield Finding(text.place, found[0])


def sentences(sources: Sources) -> Iterator[tuple[str, str]]:
    """Yield the place and the words of every sentence in pages and docstrings."""
    for text in texts(sources):
        if text.in_sentences:
            for sentence in _SENTENCE_END.split(text.words):
                if sentence and sentence.strip():
                    yield text.place, " ".join(sentence.split())


def long_sentences(sources: Sources) -> Iterator[Finding]:
    """Yield the sentences with more than LONGEST_SENTENCE words."""
    for place, sentence in sentences(sources):
        if len(re.findall(r"[^\W\d_][\w'-]*", sentence)) > LONGEST_SENTENCE:
            yield Finding(place, sentence)


def type_names(sources: Sources) -> Iterator[Finding]:
    """Yield the names of classes and aliases that have more than one meaning. Aliases with equal definitions are one
    type.
    """
    places: dict[str, dict[str, str]] = defaultdict(dict)  # place of each definition of a name
    for module, (_, tree) in sources.modules.items():
        if not module.startswith(("tests/", "docs/", "examples/")):
            for node in tree.body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    places[node.name][f"class of {module}"] = f"{module}:{node.lineno}"
                elif isinstance(node, ast.Assign) and isinstance(node.value, ast.Subscript):
                    if isinstance(alias := node.targets[0], ast.Name) and re.fullmatch(r"[A-Z][a-z]\w*", alias.id):
                        places[alias.id][ast.unparse(node.value)] = f"{module}:{node.lineno}"
    for name, definitions in sorted(places.items()):
        if len(definitions) > 1:
            first, *others = definitions.values()
            yield Finding(first, f"{name}: also {', '.join(others)}")


def unformatted(sources: Sources) -> Iterator[Finding]:
    """Yield the places that the formatter skips."""
    for name, (source, _) in sources.modules.items():
        for line, comment in comments(source):
            if re.match(r"fmt: (skip|off)", comment):
                yield Finding(f"{name}:{line}", comment)


def long_subjects(sources: Sources) -> Iterator[Finding]:
    """Yield the commits whose subject has more than LONGEST_SUBJECT characters; none without a history."""
    del sources
    log = subprocess.run(["git", "log", "--format=%h %s"], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    for line in log.stdout.splitlines():
        commit, _, subject = line.partition(" ")
        if len(subject) > LONGEST_SUBJECT:
            yield Finding(commit, subject)


CHECKS: dict[str, Callable[[Sources], Iterator[Finding]]] = {
    "first_words": first_words,
    "banned_phrases": banned_phrases,
    "long_sentences": long_sentences,
    "type_names": type_names,
    "unformatted": unformatted,
    "long_subjects": long_subjects,
}


def documentation_words(pages: dict[str, str]) -> int:
    """Return the number of words of README.md and docs/, with tables and code, without the reference made from the
    code.
    """
    shown = (
        _FROM_CODE.sub("", page)
        for name, page in pages.items()
        if name == "README.md" or (name.startswith("docs/") and not name.startswith("docs/reference/"))
    )
    return sum(1 for page in shown for word in page.split() if re.search(r"\w", word))


def complaints(found: dict[str, list[Finding]], recorded: dict[str, int]) -> list[str]:
    """Return a line for each kind whose number of findings differs from its record."""
    lines = []
    for kind, findings in found.items():
        number, before = len(findings), recorded[kind]
        if number > before:
            lines.append(f"{kind}: {number}, and {before} are recorded: mend the new ones (--list {kind})")
        elif number < before:
            lines.append(f"{kind}: {number} of {before} recorded are left: record it (--record)")
    return lines


def lower(record: str, found: dict[str, list[Finding]], recorded: dict[str, int]) -> str:
    """Return the text of the record with the decreased numbers updated."""
    for kind, findings in found.items():
        if len(findings) < recorded[kind]:
            record = re.sub(rf"(?m)^{kind} = \d+", f"{kind} = {len(findings)}", record)
    return record


def main(arguments: list[str] | None = None) -> int:
    """Compare the findings with the record, list the findings of a kind, or lower the record. Return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m maxq.tools.dev.prose", description="Check the project's English.")
    parser.add_argument(
        "--list", choices=CHECKS, metavar="KIND", help=f"print every finding of one of {', '.join(CHECKS)}"
    )
    parser.add_argument("--record", action="store_true", help="write the numbers that are lower than recorded")
    given = parser.parse_args(arguments)
    sources = Sources.of_repository()
    if given.list:
        for finding in CHECKS[given.list](sources):
            print(f"{finding.place}: {finding.text}")
        return 0
    record: dict[str, Any] = tomllib.loads(RECORD.read_text(encoding="utf-8"))
    found = {kind: list(check(sources)) for kind, check in CHECKS.items()}
    if given.record:
        RECORD.write_text(lower(RECORD.read_text(encoding="utf-8"), found, record["counts"]), encoding="utf-8")
        record = tomllib.loads(RECORD.read_text(encoding="utf-8"))
    number = sum(1 for _ in sentences(sources))
    short = 1.0 - len(found["long_sentences"]) / number
    print(f"{short:.1%} of {number} sentences have at most {LONGEST_SENTENCE} words")
    words = documentation_words(sources.pages)
    print(f"{words:,} words in README.md and docs/, at most {MOST_WORDS:,}")
    wrong = complaints(found, record["counts"])
    if words > MOST_WORDS:
        wrong.append(f"documentation: {words:,} words, {MOST_WORDS:,} are allowed: link in place of repeating")
    for line in wrong:
        print(line, file=sys.stderr)
    return 1 if wrong else 0


if __name__ == "__main__":
    gc.disable()  # measured: searching the million nodes of the syntax trees for cycles takes two thirds of the time
    sys.exit(main())
