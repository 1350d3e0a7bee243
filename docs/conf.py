"""How Sphinx makes the site of the pages that make_pages.py writes; `make docs` calls both.

Sphinx, for it reads numpydoc and its equations as they stand, links each `name` of a docstring to its page, and is kept
up; mkdocs is not any more (Material for MkDocs ends in May 2027). Furo, for it fetches nothing from elsewhere.
"""

import re
from pathlib import Path

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.application import Sphinx
from sphinx.writers.html5 import HTML5Translator

import pneuopt

project, author, copyright = "pneuopt", "the pneuopt developers", "the pneuopt developers"  # noqa: A001 - Sphinx's name
release = pneuopt.__version__
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
suppress_warnings = ["myst.header"]
default_role = "py:obj"  # a name in single backticks, as the docstrings have it, is a link where there is such a page
napoleon_google_docstring = False
napoleon_use_rtype = False
napoleon_use_ivar = True
napoleon_preprocess_types = False
autodoc_member_order = "bysource"
autodoc_typehints = "none"  # the docstrings say them, with shapes and units
python_maximum_signature_line_length = 88
html_theme = "furo"
html_title = f"pneuopt {release}"
html_static_path = [str(Path(__file__).with_name("static"))]
html_css_files = ["site.css"]
html_copy_source = html_show_sphinx = False
html_math_renderer = "mathml"


def _visit_inline(translator: HTML5Translator, node: nodes.math) -> None:
    translator.body.append(convert(node.astext()))
    raise nodes.SkipNode


def _visit_block(translator: HTML5Translator, node: nodes.math_block) -> None:
    translator.body.append(f'<div class="equation">{convert(node.astext(), display="block")}</div>\n')
    raise nodes.SkipNode


def _escape_bars(_app: Sphinx, _what: str, _name: str, _object: object, _options: object, lines: list[str]) -> None:
    """A magnitude between bars is no substitution of reST; code between backticks and equations keep theirs."""
    for k, line in enumerate(lines):
        if not line.lstrip().startswith((">>>", "...", "..")):
            lines[k] = re.sub(r"(`+[^`]*`+)|\|", lambda found: found[1] or "\\|", line)


def setup(app: Sphinx) -> None:
    """Equations are MathML, which browsers draw by themselves, without a script from elsewhere."""
    app.connect("autodoc-process-docstring", _escape_bars)
    app.add_html_math_renderer("mathml", (_visit_inline, None), (_visit_block, None))
