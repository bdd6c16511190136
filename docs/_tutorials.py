"""Run the code blocks of the tutorials and save their figures.

The blocks of each page are run in order, in a separate process for each page, with
`docs/img` as the working directory. Output is printed.

    python docs/_tutorials.py [pendulum ...]
"""

import pathlib
import re
import subprocess
import sys
import textwrap


DOCS = pathlib.Path(__file__).resolve().parent
FENCE = re.compile(
    r"^(?P<indent> *)```(?P<language>[^\n`]*)\n(?P<code>.*?)^(?P=indent)```$",
    re.DOTALL | re.MULTILINE,
)


def python_blocks(text):
    found = FENCE.finditer(text)
    return [textwrap.dedent(x["code"]) for x in found if x["language"] == "python"]


def main(names):
    pages = sorted((DOCS / "tutorials").glob("*.md"))
    unknown = set(names) - {page.stem for page in pages}
    if unknown:
        raise SystemExit(f"No such tutorial: {', '.join(sorted(unknown))}")
    for page in pages:
        if names and page.stem not in names:
            continue
        print(f"--- {page.stem}", flush=True)
        code = "\n".join(python_blocks(page.read_text()))
        subprocess.run([sys.executable, "-c", code], cwd=DOCS / "img", check=True)


if __name__ == "__main__":
    main(sys.argv[1:])
