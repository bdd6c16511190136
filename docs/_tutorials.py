"""Run the code blocks of the tutorials and the how-to pages and save their figures.

The blocks of each page are run in order, in a separate process for each page, with
`docs/img` as the working directory. Output and seconds are printed.

    python docs/_tutorials.py [pendulum ...]
"""

import pathlib
import re
import subprocess
import sys
import textwrap
import time


DOCS = pathlib.Path(__file__).resolve().parent
# Each folder of pages with a figure, and how the names of its figures start.
FOLDERS = {"tutorials": "tutorial", "howto": "howto"}
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>[^\n`]*)\n(?P<code>.*?)^(?P=indent)```$",
    re.DOTALL | re.MULTILINE,
)


def python_blocks(text):
    found = FENCE.finditer(text)
    return [textwrap.dedent(x["code"]) for x in found if x["language"] == "python"]


def pages_with_figures():
    """The pages, and the name of the figure of each."""
    return {
        page: f"{prefix}_{page.stem}.png"
        for folder, prefix in FOLDERS.items()
        for page in sorted((DOCS / folder).glob("*.md"))
        if "savefig" in page.read_text()
    }


def main(names):
    pages = {page.stem: page for page in pages_with_figures()}
    unknown = set(names) - set(pages)
    if unknown:
        raise SystemExit(f"No such page: {', '.join(sorted(unknown))}")
    for name in names or pages:
        print(f"--- {name}", flush=True)
        code = "\n".join(python_blocks(pages[name].read_text()))
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], cwd=DOCS / "img", check=True)
        print(f"({time.perf_counter() - start:.0f} s)", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
