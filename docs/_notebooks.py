"""Make a Jupyter notebook of each tutorial when the site is built.

A page is the only source of its notebook: blocks of Python are cells, and the printed
text and the figure that follow a block are the outputs of its cell. Links to other
pages are replaced by their text, since a notebook is opened outside of the site.
"""

import base64
import pathlib
import re

import nbformat
from _tutorials import FENCE
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook, new_output


IMAGES = pathlib.Path(__file__).parent / "img"
FOLDER = "tutorials/"
NEEDS = "*This notebook needs `diffrax_presym` with the extra `examples`.*"
LINK = re.compile(r"(?<!!)\[([^\[\]]+)\](?:\[diffrax_presym[\w.]*\]|\((?!http)[^)]*\))")
FIGURE = re.compile(r"!\[(?P<alt>[^\]]*)\]\(\.\./img/(?P<name>[^)]+)\)")
ADMONITION = re.compile(
    r'^!!! \w+ "(?P<title>[^"]+)"\n(?P<body>(?:\n| {4}.*\n)+)', re.MULTILINE
)


def quote(match):
    lines = re.sub("^ {4}", "", match["body"].strip("\n"), flags=re.MULTILINE)
    lines = f"**{match['title']}**\n\n{lines.lstrip()}".split("\n")
    return "\n".join(f"> {x}".rstrip() for x in lines) + "\n\n"


def prose(text):
    text = ADMONITION.sub(quote, LINK.sub(r"\1", FIGURE.sub("", text)))
    return re.sub(r"(?<=\w)--(?=\w)", "–", re.sub(r"\n{3,}", "\n\n", text)).strip()


def figure(match):
    image = base64.b64encode((IMAGES / match["name"]).read_bytes()).decode()
    description = {"image/png": {"alt": match["alt"].replace("\n", " ")}}
    return new_output("display_data", {"image/png": image}, metadata=description)


def notebook(page):
    """The notebook of the Markdown text of a page."""
    title, page = page.split("\n", 1)
    page = f"{title}\n\n{NEEDS}\n{page}"
    cells, end = [], 0
    for block in [*FENCE.finditer(page), None]:
        between = page[end : block.start() if block else None]
        for found in FIGURE.finditer(between):
            cells[-1].outputs.append(figure(found))
        if text := prose(between):
            cells.append(new_markdown_cell(text))
        if block is None:
            break
        end = block.end()
        if block["language"] == "python":
            cells.append(new_code_cell(block["code"].rstrip("\n")))
        elif cells[-1].cell_type == "code":
            cells[-1].outputs.append(new_output("stream", text=block["code"]))
        else:
            cells.append(new_markdown_cell(block[0]))
    # By default the names are random.
    for number, cell in enumerate(cells):
        cell.id = f"cell-{number}"
    kernel = {"name": "python3", "display_name": "Python 3", "language": "python"}
    made = new_notebook(cells=cells, metadata={"kernelspec": kernel})
    nbformat.validate(made)
    return made


def on_files(files, config):
    from mkdocs.structure.files import File

    for file in files.documentation_pages():
        if file.src_uri.startswith(FOLDER):
            name = file.src_uri.removesuffix(".md") + ".ipynb"
            content = nbformat.writes(notebook(file.content_string))
            files.append(File.generated(config, name, content=content))
    return files


def on_page_markdown(markdown, page, **kwargs):
    if not page.file.src_uri.startswith(FOLDER):
        return markdown
    title, rest = markdown.split("\n", 1)
    name = pathlib.PurePosixPath(page.file.src_uri).stem + ".ipynb"
    attributes = f'.notebook download="{name}" data-search-exclude=""'
    link = f"[Download as a notebook]({name}){{ {attributes} }}"
    return f"{title}\n\n{link}\n{rest}"
