"""HTML pages of the commands: Jinja templates (*.html.j2, beside this module) over one skeleton and one style sheet.

    text = render("review.html.j2", found=found, pictures={"margins": png})

A page is one file with nothing outside it. Whatever a template prints is escaped. Templates extend `skeleton.html.j2`
(blocks `title` and `body`) and share the macros of `elements.html.j2`: `table`, `picture`.
"""

from __future__ import annotations

import base64
import math
from functools import cache
from pathlib import Path
from typing import Any

from jinja2 import Environment, FileSystemLoader, StrictUndefined


def render(template: str, **values: Any) -> str:
    """The page; a name that a template uses must be among `values`."""
    return _environment().get_template(template).render(values)


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
