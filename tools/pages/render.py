"""The HTML pages of the commands: Jinja templates (*.html.j2, next to this module) with one skeleton and style sheet.

    text = render("review.html.j2", plots=[Plot(...)], found=found)

A page is one self-contained file. All text that a template prints is escaped. Templates extend `skeleton.html.j2`
(blocks `title` and `body`) and share the macros of `elements.html.j2`: `table`, `plot` (a figure that `plots.js`
draws), and `title_block`.
"""

from __future__ import annotations

import datetime
import itertools
import math
import re
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup, escape

from maxq.sim.run.quantities import number_text
from maxq.tools.plots.figures import Plot, as_json


def render(template: str, plots: Sequence[Plot] = (), **values: Any) -> str:
    """Return the page that a template makes of `values` and `plots`.

    `values` must contain all names that the template uses, except `plots` and `date` (by default today). Headings,
    figures and captioned tables are numbered, and the headings are listed at the mark <!-- contents -->. A first row of
    heads becomes the head of its table, which a print repeats on each page. A head applies to its column unless the
    template states its scope.
    """
    given: dict[str, Any] = {"date": datetime.date.today().isoformat(), "plots": plots, "figures": "", "script": ""}
    if plots:
        given |= {"figures": Markup(as_json(plots)), "script": script_file("plots.js")}  # our own text, escaped
    page = _environment().get_template(template).render(given | values)
    names = re.findall(r"<h2>(.*?)</h2>", page)
    page = _numbered(page, r"<h2>(.*?)</h2>", lambda n, name: f'<h2 id="s{n}">{n} {name}</h2>')
    page = _numbered(page, r"<figcaption>(.*?)", lambda n, _: f"<figcaption><b>Figure {n}.</b> ")
    listed = "".join(f'<li><a href="#s{n}">{name}</a></li>' for n, name in enumerate(names, 1))
    page = page.replace("<!-- contents -->", f'<nav aria-label="contents"><ol>{listed}</ol></nav>')
    page = _numbered(page, r"<caption>(.*?)", lambda n, _: f"<caption><b>Table {n}.</b> ")
    page = re.sub(r"<th(?=[ >])(?! scope)", '<th scope="col"', page)
    head = r'<table>\s*(<caption>.*?</caption>)?\s*(<tr>\s*<th scope="col".*?</tr>)'
    return re.sub(head, r"<table>\1<thead>\2</thead>", page, flags=re.DOTALL)


def _numbered(page: str, pattern: str, form: Callable[[int, str], str]) -> str:
    numbers = itertools.count(1)
    return re.sub(pattern, lambda m: form(next(numbers), m[1]), page)


def script_file(name: str) -> Markup:
    """Return a script of this folder, for a script element."""
    return Markup(_file(name))  # our own text


def _file(name: str) -> str:
    return (Path(__file__).parent / name).read_text(encoding="utf-8")


@cache
def _environment() -> Environment:
    made = Environment(
        loader=FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=_signs,
    )
    made.filters["number"] = number
    made.filters["sentence"] = sentence
    made.filters["command"] = command
    made.filters["in_css"] = _in_css
    made.filters["number_text"] = number_text
    return made


def number(value: float | None, form: str = ".4g") -> str:
    """Return a number in a format, or "" if it is missing, NaN or infinite."""
    return "" if value is None or not math.isfinite(value) else format(value, form)


def sentence(text: str) -> str:
    """Return a text as a sentence: with a capital letter and a full stop. An empty text remains empty."""
    return f"{text[0].upper()}{text[1:]}{'' if text[-1] in '.!?' else '.'}" if text else ""


def command(text: str) -> Markup:
    """Return a command whose options are not broken at their hyphens."""
    return Markup("<code>{}</code>").format(
        Markup(re.sub(r"(?<=\s)--[\w-]+", r"<span>\g<0></span>", str(escape(text))))
    )


def _in_css(text: Any) -> Markup:
    """Return a string for a style sheet, in which every character except letters and digits is replaced by its code."""
    plain = Markup(text).unescape() if isinstance(text, Markup) else str(text)  # already markup
    coded = "".join(c if c.isascii() and c.isalnum() else f"\\{ord(c):x} " for c in " ".join(plain.split()))
    return Markup(coded)  # letters, digits, backslashes and spaces


def _signs(value: Any) -> Any:
    """Return a text with printed comparison signs that are never separated from their number."""
    if not isinstance(value, str) or isinstance(value, Markup):
        return value
    return value.replace("<= ", "≤\u00a0").replace(">= ", "≥\u00a0")
