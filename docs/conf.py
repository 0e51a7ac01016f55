"""The documentation site: `make docs` builds it into docs/build/html, as static files that need no network."""

from __future__ import annotations

import os
import re
from importlib.metadata import version as version_of
from pathlib import Path
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx

from maxq.tools.dev.documents.reference import fill

os.environ["MPLBACKEND"] = "module://matplotlib_inline.backend_inline"  # of the notebooks: figures are shown
project = "maxq"
author = "the maxq authors"
version = release = version_of("maxq")
copyright = "the maxq authors, Apache-2.0"  # Sphinx's name
extensions = ["myst_nb", "sphinx.ext.autodoc", "sphinx_copybutton", "sphinx.ext.viewcode"]
exclude_patterns = ["build"]
default_role = "code"  # one backtick in a docstring is code, as in Markdown
highlight_language = "text"
smartquotes = False  # texts of keys quote values as they are written

myst_enable_extensions = ["dollarmath", "deflist", "attrs_block"]
myst_dmath_double_inline = True
myst_heading_anchors = 4
nb_execution_mode = "cache"  # notebooks are executed again when they have changed
nb_execution_cache_path = "build/notebooks"
nb_execution_timeout = 1800
nb_execution_in_temp = True
nb_execution_raise_on_error = True
nb_merge_streams = True
copybutton_prompt_text = "$ "
copybutton_exclude = ".linenos, .gp, .go"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_preserve_defaults = True
python_use_unqualified_type_names = True

html_theme = "furo"
html_title = f"maxq {version}"
html_static_path = ["static"]
html_css_files = ["site.css"]
html_math_renderer = "mathml"
html_copy_source = False
html_theme_options = {"footer_icons": [], "top_of_page_buttons": []}


# what latex2mathml has by other names
_DIALECT = {"{aligned}": "{align*}", "{gathered}": "{matrix}", r"\mathrel{+}=": r"\;\text{+=}\;"}


def _fill(_app: Sphinx, _page: str, source: list[str]) -> None:
    source[0] = fill(source[0])


def _drawings(_app: Sphinx, tree: nodes.document, _page: str) -> None:
    """SVG of docs/figures goes into the page, where its text takes the page's colour, light or dark."""
    for image in list(tree.findall(nodes.image)):
        if re.match(r"figures/.*\.svg$", image["uri"]):
            drawing = (Path(__file__).parent / image["uri"]).read_text(encoding="utf-8")
            drawing = re.sub(r"<style>.*?</style>", "", drawing, flags=re.DOTALL)
            image.replace_self(nodes.raw("", f'<div class="drawing">{drawing}</div>', format="html"))


def _inline_math(writer: Any, node: nodes.math) -> None:
    writer.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _block_math(writer: Any, node: nodes.math_block) -> None:
    """MathML, which browsers draw by themselves; `\\tag{4.1}` becomes the number at the right and an anchor."""
    tag = re.search(r"\\tag\{(.*?)\}", node.astext())
    latex = re.sub(r"\\tag\{.*?\}", "", node.astext())
    for standard, known in _DIALECT.items():
        latex = latex.replace(standard, known)
    number = f'<span class="eqno" id="eq-{tag[1]}">({tag[1]})</span>' if tag else ""
    writer.body.append(f'<div class="math"><div>{convert(latex, display="block")}</div>{number}</div>')
    raise nodes.SkipNode


def _no_constructor(_app: Sphinx, what: str, *_: Any) -> tuple[str, None] | None:
    """Nobody makes a flight by its constructor."""
    return ("", None) if what == "class" else None


def setup(app: Sphinx) -> None:
    app.connect("autodoc-process-signature", _no_constructor)
    app.add_html_math_renderer("mathml", (_inline_math, None), (_block_math, None))
    app.connect("source-read", _fill)
    app.connect("doctree-resolved", _drawings)
