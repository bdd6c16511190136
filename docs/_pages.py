"""Figures that a click opens alone, numbers on one line, and what screen readers need.

The build fails if an image has no description or a heading skips a level.
"""

import itertools
import re

from mkdocs.exceptions import PluginError


# An image that is the start of a paragraph is no part of a link.
FIGURE = re.compile(r'(?<=<p>)<img [^>]*?src="(?P<source>[^"]+)"[^>]*>')
# Browsers break lines after the hyphen of 1e-6. Code and tags are left as they are.
NUMBER = re.compile(
    r"<(?P<tag>pre|code|h\d)\b.*?</(?P=tag)>|<[^>]+>"
    r"|(?P<number>(?<![\w.])-?\d+(?:\.\d+)?e-\d+\b)",
    re.DOTALL,
)
# The text of a link describes an image in it.
UNDESCRIBED = re.compile(r'<img (?![^>]*\balt="[^"]+")[^>]*>(?!\s*<strong>)')
LEVEL = re.compile(r"<h([1-6])\b")
# A section of the navigation that is a page has a label without text.
SECTION = re.compile(
    r'<label class="md-nav__title" for="(__nav_\d+)">\s*<span[^>]*></span>\s*(.*?)\s*</'
)


def keep_together(match):
    number = match["number"]
    return f'<span class="number">{number}</span>' if number else match[0]


def on_page_content(content, page, **kwargs):
    if found := UNDESCRIBED.search(content):
        raise PluginError(f"{page.file.src_uri}: {found[0]} has no description.")
    levels = [int(x) for x in LEVEL.findall(content)]
    if any(after > before + 1 for before, after in itertools.pairwise(levels)):
        raise PluginError(f"{page.file.src_uri}: a heading skips a level: {levels}.")
    content = FIGURE.sub(r'<a class="figure" href="\g<source>">\g<0></a>', content)
    return NUMBER.sub(keep_together, content)


def on_post_page(output, **kwargs):
    names = dict(SECTION.findall(output))
    output = re.sub(
        r'aria-labelledby="(__nav_\d+)_label"',
        lambda match: f'aria-label="{names[match[1]]}"',
        output,
    )
    return output.replace('role="dialog"', 'role="dialog" aria-label="Search"')


def on_post_template(output, template_name, **kwargs):
    return on_post_page(output) if template_name.endswith(".html") else output
