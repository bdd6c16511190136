"""Shared code of the experiments: options, figures, tables, Nesterov's method."""

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
        help="save figure and table in docs/, instead of the figure in this directory",
    )
    return parser


def report(name, fig, rows, options) -> None:
    """Save the figure; print the table, and insert it into docs/reproduction.md.

    Each row consists of a topic, the statement of the paper, and the measurement.
    """
    path = (DOCS / "img" if options.docs else pathlib.Path()) / f"paper_{name}.png"
    fig.savefig(path, dpi=100)
    # A palette is sufficient for line plots, and takes a third of the space.
    Image.open(path).quantize(256).save(path, optimize=True)
    print(f"\nFigure saved to {path}\n")
    for what, paper, measured in rows:
        print(f"{what}\n    paper says  {paper}\n    we measure  {measured}")
    if options.docs:
        lines = ["| experiment | paper says | we measure |", "|---|---|---|"]
        lines += [f"| {' | '.join(row)} |" for row in rows]
        page = DOCS / "reproduction.md"
        begin, end = f"<!-- begin {name} -->", f"<!-- end {name} -->"
        pattern = re.compile(f"(?<={begin}\n).*?(?={end})", re.DOTALL)
        text, found = pattern.subn(
            lambda _: "\n".join(["", *lines, "", ""]), page.read_text()
        )
        assert found == 1, f"{page} has no markers for the table of {name}"
        page.write_text(text)


class NesterovMove(dps.extend.AbstractMove):
    """After the kick of position-first Euler, the drift again with the new momentum."""

    def prepare(self, system, span):
        return system.prepare_decay(span.t0, span.h)

    def apply(self, system, span, data, stage):
        (y, carry), (_, t1, h) = stage, span
        drift = lambda y: system.add(y, (h * system.velocity(t1, y), None))
        y = system.decay(data, y)
        y = system.add(y, (None, h * system.force(t1, drift(y))))
        return (drift(y), carry), None

    def undo(self, system, span, data, stage):
        raise NotImplementedError


class Nesterov(dps.extend.AbstractPresymplecticSolver):
    """Nesterov's method as a solver of order one, with mu = exp(eta(t) - eta(t + h)).

    It differs from position-first Euler in one respect: after the kick, the drift is
    repeated with the new momentum. So it is not presymplectic.
    """

    @property
    def is_symmetric(self) -> bool:
        return False

    def order(self, terms):
        return 1

    def scheme(self, system):
        return dps.extend.Scheme(NesterovMove(), is_invertible=False)


def growth(ts, errors, first, last) -> float:
    """The ratio of the largest error up to `last` to that up to `first`."""
    return float(jnp.max(errors[ts <= last]) / jnp.max(errors[ts <= first]))
