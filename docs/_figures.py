"""A click on a figure opens it alone, where browsers can enlarge it."""

import re


# An image that is the start of a paragraph is no part of a link.
FIGURE = re.compile(r'(?<=<p>)<img [^>]*?src="(?P<source>[^"]+)"[^>]*>')


def on_page_content(content, **kwargs):
    return FIGURE.sub(r'<a class="figure" href="\g<source>">\g<0></a>', content)
