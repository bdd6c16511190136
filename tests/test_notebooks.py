"""The notebooks of the tutorials are valid and have what their pages have.

Their code is not run here, as `test_docs.py` runs the blocks of the pages.
"""

import ast
import base64
import importlib
import pathlib
import re

import nbformat
import pytest


ROOT = pathlib.Path(__file__).parent.parent
PAGES = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
# A block of the page, not by the expression that makes the notebooks.
BLOCK = re.compile(r"^```(python|text)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


@pytest.fixture
def module(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    return importlib.import_module("_notebooks")


def test_there_are_tutorials():
    assert len(PAGES) >= 10


@pytest.mark.variants(1000)
@pytest.mark.parametrize("page", PAGES, ids=lambda x: x.stem)
def test_notebook_has_the_blocks_of_its_page(page, module):
    text = page.read_text(encoding="utf-8")
    made = nbformat.reads(nbformat.writes(module.notebook(text)), as_version=4)
    nbformat.validate(made)
    cells = [x for x in made.cells if x.cell_type == "code"]
    blocks = BLOCK.findall(text)
    assert [x.source + "\n" for x in cells] == [y for x, y in blocks if x == "python"]
    for cell in cells:
        ast.parse(cell.source)

    # Each printed text belongs to the block before it, and the figure to its code.
    printed, latest = {}, ""
    for language, block in blocks:
        if language == "python":
            latest = block
        else:
            printed[latest] = block
    for cell in cells:
        texts = [x.text for x in cell.outputs if x.output_type == "stream"]
        assert "".join(texts) == printed.get(cell.source + "\n", "")
        images = [x.data["image/png"] for x in cell.outputs if "data" in x]
        names = re.findall(r'savefig\("([^"]+)"', cell.source)
        files = [(ROOT / "docs" / "img" / x).read_bytes() for x in names]
        assert [base64.b64decode(x) for x in images] == files


@pytest.mark.variants(1000)
@pytest.mark.parametrize("page", PAGES, ids=lambda x: x.stem)
def test_notebook_has_the_prose_of_its_page(page, module):
    text = page.read_text(encoding="utf-8")
    cells = [x for x in module.notebook(text).cells if x.cell_type == "markdown"]
    prose = "\n".join(x.source for x in cells)
    assert prose.startswith(text.split("\n", 1)[0])
    # Nothing that only the site understands.
    assert not re.search(r"```|^!!!|^    \S|\]\[|\]\((?!http)", prose, re.MULTILINE)
    # Every word but those of links, figures and marks.
    page_only = r"!\[[^\]]*\]\([^)]*\)|\]\[[^\]]*\]|\]\([^)]*\)|^!!! \w+"
    left = re.sub(page_only, "", BLOCK.sub("", text), flags=re.MULTILINE)
    words = lambda x: re.findall(r"\w+", re.sub(r"\(http[^)]*\)", "", x))
    assert words(prose.replace(module.NEEDS, "")) == words(left)


def test_page_links_to_its_notebook(module):
    class Page:
        class file:
            src_uri = "tutorials/drag.md"

    changed = module.on_page_markdown("# Drag\n\nText.\n", Page)
    assert changed.startswith("# Drag\n\n[Download as a notebook](drag.ipynb)")
    assert changed.endswith("\n\nText.\n")
    Page.file.src_uri = "drag.md"
    assert module.on_page_markdown("# Drag\n", Page) == "# Drag\n"
