"""Render formulas by KaTeX when a page is built, so that a reader needs no script.

Arithmatex marks the formulas in pages and docstrings. KaTeX 0.19.1 and its fonts, from
npm, are in `docs/_static/katex`. A formula that KaTeX cannot read fails the build.
"""

import functools
import html
import pathlib
import re

from mkdocs.exceptions import PluginError
from py_mini_racer import JSEvalException, MiniRacer


KATEX = pathlib.Path(__file__).parent / "_static" / "katex" / "katex.min.js"
FORMULA = re.compile(
    r"(?P<before>\()?"
    r'(?P<open><(?P<tag>span|div) class="arithmatex">)\\[(\[](?P<latex>.*?)\\[)\]]'
    r"(?P<close></(?P=tag)>)(?P<after>[,.;:!?)])?",
    re.DOTALL,
)


@functools.cache
def katex():
    engine = MiniRacer()
    engine.eval(KATEX.read_text() + "; 0")
    return engine


def on_page_content(content, page, **kwargs):
    def render(match):
        latex = html.unescape(match["latex"]).strip()
        options = {"displayMode": match["tag"] == "div", "strict": "error"}
        try:
            formula = katex().call("katex.renderToString", latex, options)
        except JSEvalException as e:
            raise PluginError(f"{page.file.src_uri}: ${latex}$: {e}") from e
        # The search index takes the letters alone, without a copy and the source.
        formula = formula.replace(
            '"katex-mathml"', '"katex-mathml" data-search-exclude="true"'
        )
        formula = f"{match['open']}{formula}{match['close']}"
        # Browsers would break lines between a formula and its punctuation.
        before, after = match["before"] or "", match["after"] or ""
        if before or after:
            formula = f'<span class="punctuated">{before}{formula}{after}</span>'
        return formula

    return FORMULA.sub(render, content)


# Python would wait for an engine that is open.
def on_shutdown(**kwargs):
    katex().close()
