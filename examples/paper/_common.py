"""What the experiments share: options, pictures, tables, and Nesterov's method."""

import argparse
import pathlib
import re

import jax
import jax.numpy as jnp
import matplotlib
from PIL import Image

import diffrax_presym as dps


matplotlib.use("Agg")
jax.config.update("jax_enable_x64", True)

DOCS = pathlib.Path(__file__).parents[2] / "docs"


def parser(description) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--quick", action="store_true", help="a smaller run, for CI")
    parser.add_argument(
        "--docs",
        action="store_true",
        help="put picture and table into docs/, not the picture into this directory",
    )
    return parser


def report(name, fig, rows, options) -> None:
    """Save the picture; print the table, and put it into docs/reproduction.md.

    Each row says what it is about, what the paper says of it, and what was measured.
    """
    path = (DOCS / "img" if options.docs else pathlib.Path()) / f"paper_{name}.png"
    fig.savefig(path, dpi=100)
    # A palette is enough for lines, and takes a third of the space.
    Image.open(path).quantize(256).save(path, optimize=True)
    print(f"\nPicture saved to {path}\n")
    for what, paper, measured in rows:
        print(f"{what}\n    paper says  {paper}\n    we measure  {measured}")
    if options.docs:
        lines = ["| | paper says | we measure |", "|---|---|---|"]
        lines += [f"| {' | '.join(row)} |" for row in rows]
        page = DOCS / "reproduction.md"
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        pattern = re.compile(f"(?<={begin}\n).*?(?={end})", re.DOTALL)
        text, found = pattern.subn(
            lambda _: "\n".join(["", *lines, "", ""]), page.read_text()
        )
        assert found == 1, f"{page} has no place for the table of {name}"
        page.write_text(text)


class Nesterov(dps.AbstractPresymplecticSolver[None]):
    """Nesterov's method as a solver of first order, with mu = exp(eta(t) - eta(t + h)).

    It differs from position-first Euler in one thing: once the momentum is kicked, the
    drift is taken again. That costs it the presymplectic structure.
    """

    @property
    def is_symmetric(self) -> bool:
        return False

    def order(self, terms):
        return 1

    def start(self, view, t, y):
        return None

    def advance(self, view, t0, t1, h, y, carry):
        q, p = y
        h = h.astype(q.dtype)
        p = view.move_frame(t0, h, p)
        ahead = q + h * view.velocity(t1, (q, p))
        p = p + h * view.force(t1, (ahead, p))
        return (q + h * view.velocity(t1, (q, p)), p), None, None

    def slope(self, view, t, y, carry):
        return view.slope(t, y)


def growth(ts, errors, first, last) -> float:
    """How much larger the largest error up to `last` is than that up to `first`."""
    return float(jnp.max(errors[ts <= last]) / jnp.max(errors[ts <= first]))
