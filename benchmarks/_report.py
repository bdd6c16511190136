"""The command line of the benchmarks, and the tables that they print."""

import argparse
import functools
import importlib.metadata
import math
import os
import platform
import re
import statistics
import sys

import jax

import diffrax_presym as dps


def command_line(doc):
    """A parser with the options that all benchmarks have."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="a short run, for CI")
    parser.add_argument("--markdown", action="store_true", help="tables as Markdown")
    return parser


@functools.cache
def environment():
    """Print the versions and the device, above the first table of a script."""
    versions = [
        f"Python {platform.python_version()}",
        *(
            f"{name} {importlib.metadata.version(name)}"
            for name in ("jax", "jaxlib", "diffrax", "equinox")
        ),
        f"diffrax_presym {dps.__version__}",
    ]
    kind = jax.devices()[0].device_kind
    print(f"{', '.join(versions)}; {os.cpu_count()} CPU cores, device: {kind}")


def means(rows):
    """The geometric mean and the least of each column, without those not reached."""
    known = [
        [x for x in column if x and 0 < x < math.inf]
        for column in zip(*rows, strict=True)
    ]
    mean = [statistics.geometric_mean(x) if x else None for x in known]
    return mean, [min(x, default=None) for x in known]


class Table:
    """A table that is printed row by row, as aligned text or as Markdown.

    A column is its title and the format of its cells, as in `"error:>9.1e"`. Strings
    are aligned only, and what is `None` or infinite is a dash.
    """

    def __init__(self, caption, *columns):
        columns = [column.rpartition(":") for column in columns]
        self.formats = [spec for _, _, spec in columns]
        self.markdown = "--markdown" in sys.argv[1:]
        environment()
        print(f"\n{caption}" if caption else "")
        if caption and self.markdown:
            print()
        self.row(*(title for title, _, _ in columns))
        if self.markdown:
            print("|" + "---|" * len(columns), flush=True)

    def row(self, *cells):
        texts = []
        for cell, spec in zip(cells, self.formats, strict=True):
            cell = "-" if cell is None or cell == math.inf else cell
            if isinstance(cell, str):
                spec = re.match(r"[<>]\d+", spec).group()  # pyright: ignore
            texts.append(format(cell, spec))
        if self.markdown:
            print("| " + " | ".join(text.strip() for text in texts) + " |", flush=True)
        else:
            print(" ".join(texts).rstrip(), flush=True)
