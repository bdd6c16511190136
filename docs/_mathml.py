"""Render formulas as MathML, which browsers support without scripts, fonts or network.

Arithmatex marks the formulas in pages and docstrings; this MkDocs hook converts them to
MathML when a page is built. A formula that cannot be converted fails the build.
"""

import html
import re
import xml.etree.ElementTree as ElementTree

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError


FORMULA = re.compile(
    r'<(?P<tag>span|div) class="arithmatex">\\[(\[](?P<latex>.*?)\\[)\]]</(?P=tag)>',
    re.DOTALL,
)


def on_page_content(content, page, **kwargs):
    def to_mathml(match):
        latex = html.unescape(match["latex"]).strip()
        block = match["tag"] == "div"
        try:
            formula = convert(latex, display="block" if block else "inline")
            words = [x.text or "" for x in ElementTree.fromstring(formula).iter()]
        except Exception as e:
            raise PluginError(f"{page.file.src_uri}: cannot read ${latex}$: {e}") from e
        # The converter copies unknown commands unchanged.
        unknown = [word for word in words if "\\" in word]
        if unknown:
            raise PluginError(
                f"{page.file.src_uri}: {unknown} in ${latex}$ is not understood."
            )
        return f'<div class="formula">{formula}</div>' if block else formula

    return FORMULA.sub(to_mathml, content)
