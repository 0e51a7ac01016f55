"""HTML pages of the commands: Jinja templates (*.html.j2, beside this module) over one skeleton and one style sheet.

    text = render("review.html.j2", found=found, pictures={"margins": png})

A page is one file with nothing outside it. Whatever a template prints is escaped. Templates extend `skeleton.html.j2`
(blocks `title` and `body`) and share the macros of `elements.html.j2`: `table`, `picture`.
"""

from __future__ import annotations

import base64
import datetime
import math
import re
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined


def render(template: str, **values: Any) -> str:
    """The page; a name that a template uses must be among `values`, or `today`.

    Headings are numbered and listed where a template says <!-- contents -->; the first row of a table of heads is its
    head, which a print repeats on each page.
    """
    today = datetime.date.today().isoformat()
    page = _environment().get_template(template).render({"today": today} | values)
    names = re.findall(r"<h2>(.*?)</h2>", page)
    numbers = iter(range(1, len(names) + 1))
    page = re.sub(r"<h2>(.*?)</h2>", lambda h: f'<h2 id="s{(n := next(numbers))}">{n} {h[1]}</h2>', page)
    listed = "".join(f'<li><a href="#s{n}">{name}</a></li>' for n, name in enumerate(names, 1))
    page = page.replace("<!-- contents -->", f"<nav><ol>{listed}</ol></nav>")
    return re.sub(r"<table>\s*(<tr>\s*<th\b.*?</tr>)", r"<table><thead>\1</thead>", page, flags=re.DOTALL)


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
    made.filters["base64"] = lambda content: base64.b64encode(content).decode()
    return made


def number(value: float | None, form: str = ".4g") -> str:
    """A number in that format; nothing for what is missing, NaN or infinite."""
    return "" if value is None or not math.isfinite(value) else format(value, form)


def _signs(value: Any) -> Any:
    """Comparison signs as they are printed, never apart from their number."""
    return value.replace("<= ", "≤\u00a0").replace(">= ", "≥\u00a0") if isinstance(value, str) else value
