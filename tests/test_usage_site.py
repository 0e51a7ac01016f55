"""The documentation site builds without warnings, broken links and external content, and its examples are valid."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from functools import cache
from html.parser import HTMLParser
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import pytest

from maxq.tools.schemas import KINDS, json_schema

jsonschema = pytest.importorskip("jsonschema", reason="pip install 'maxq[docs]'")
ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
SOURCES = [page for page in sorted(DOCS.rglob("*.md")) if "build" not in page.parts]


class Page(HTMLParser):
    """The anchors, links and fetched resources of a page."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.ids: set[str] = set()
        self.links: list[str] = []
        self.fetched: list[str] = []
        self.tags: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        self.tags.add(tag)
        self.ids |= {given[name] for name in ("id", "name") if name in given}
        if tag == "a" and "href" in given:
            self.links.append(given["href"])
        elif "src" in given:
            self.fetched.append(given["src"])
        elif tag == "link" and given.get("rel") != "canonical":
            self.fetched.append(given.get("href", ""))


def built(folder: Path, *settings: str) -> Path:
    """Build the site with warnings as errors and extra Sphinx settings, and return the folder of its pages."""
    changes = [word for setting in settings for word in ("-D", setting)]
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", *changes, "-d", folder / "trees"]
    done = subprocess.run([*command, DOCS, folder / "html"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]
    return folder / "html"


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the pages of the site with notebooks shown but not executed."""
    return built(tmp_path_factory.mktemp("site"), "nb_execution_mode=off", "suppress_warnings=myst-nb.lexer")


@pytest.mark.long
def test_notebooks_run_and_show_their_results(tmp_path: Path) -> None:
    site = built(tmp_path, f"nb_execution_cache_path={tmp_path / 'notebooks'}")
    executed = {"first-flight": "9 of 9 requirements", "own-vehicle": "scenario.toml", "design": "all limits met"}
    for name, shown in executed.items():
        text = (site / "notebooks" / f"{name}.html").read_text(encoding="utf-8")
        assert shown in text
        assert "data:image/png" in text or ".png" in text


@pytest.mark.slow
def test_the_site_stands_by_itself(site: Path) -> None:
    pages = {path: Page(path) for path in site.rglob("*.html")}
    assert len(pages) > 35
    for path, page in pages.items():
        for target in page.fetched:
            assert not re.match(r"(https?:)?//", target), f"{path.name} fetches {target}"
        for target in page.links + page.fetched:
            if re.match(r"(https?:|mailto:|data:|javascript:)", target):
                continue
            place, _, anchor = unquote(target.partition("?")[0]).partition("#")
            there = (path.parent / place).resolve() if place else path
            assert there.exists(), f"{path.name}: {target}"
            if anchor and there.suffix == ".html":
                assert anchor in pages[there].ids | {""}, f"{path.name}: {target}"
    model = pages[site / "model.html"]
    assert {"math", "svg"} <= model.tags
    assert {"eq-1.1", "eq-14.4"} <= model.ids
    assert "merror" not in (site / "model.html").read_text(encoding="utf-8")


def test_links_between_sources_lead_somewhere() -> None:
    """Links between sources work for readers of the repository."""
    for page in [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *SOURCES]:
        text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for target in re.findall(r"\]\(([^)\s]+)\)", text):
            if not re.match(r"https?:|#", target) and not target.endswith(".ipynb"):
                assert (page.parent / target.partition("#")[0]).exists(), f"{page.relative_to(ROOT)}: {target}"


def _lenient(node: Any) -> Any:
    """Return a schema without required keys, because examples show parts of files."""
    if isinstance(node, list):
        return [_lenient(item) for item in node]
    if not isinstance(node, dict):
        return node
    kept = {key: _lenient(value) for key, value in node.items() if key != "required"}
    if isinstance(kept.get("anyOf"), list) and {} in kept["anyOf"]:
        del kept["anyOf"]
    return kept


@cache
def _validator(kind: str) -> Any:
    schema = _lenient(json_schema(kind))
    return jsonschema.validators.validator_for(schema)(schema)


def _examples() -> Iterator[tuple[str, str]]:
    for page in SOURCES:
        for number, text in enumerate(re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)):
            yield f"{page.relative_to(DOCS)} {number + 1}", text


@pytest.mark.slow
@pytest.mark.parametrize(("name", "text"), list(_examples()))
def test_examples_of_files_have_keys_that_exist(name: str, text: str) -> None:
    """Each example fits one schema; a section of a list may appear as a single one."""
    data = tomllib.loads(text)
    if isinstance(data.get("stage"), dict):
        data["stage"] = [data["stage"]]
    reasons = {}
    for kind in KINDS:
        try:
            _validator(kind).validate(json.loads(json.dumps(data)))
        except jsonschema.ValidationError as error:
            reasons[kind] = error.message[:200]
        else:
            return
    pytest.fail(f"{name}: {reasons}")
