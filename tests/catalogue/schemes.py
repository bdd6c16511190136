"""The list of schemes, and what each claims. A new scheme is added as one line."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any

import optimistix as optx
import own
import pytest
from diffrax import AbstractSolver
from helpers import substeps

import diffrax_presym as dps


@dataclasses.dataclass(frozen=True)
class Scheme:
    """A scheme, the split that it needs, and its claimed order."""

    name: str
    make: Callable[..., AbstractSolver]
    order: int
    needs: str | None
    symmetric: bool = True
    composable: bool = (
        True  # a base of compositions: symmetric, errors even in the step
    )
    inside: bool = True  # whether it starts at a singularity of the friction
    implicit: bool = False  # whether `make` takes a root finder

    def __repr__(self):
        return self.name

    @property
    def solver(self) -> Any:
        return self.for_precision("float64")

    def for_precision(self, precision: str):
        tolerance = 1e-12 if precision == "float64" else 3e-6
        finder = optx.Newton(rtol=tolerance, atol=tolerance)
        return self.make(finder) if self.implicit else self.make()


Euler, Leapfrog = dps.PresymplecticEuler, dps.PresymplecticLeapfrog
Triple, Spaletta = dps.SuzukiYoshida, dps.SofroniouSpaletta
Gauss, Multistep = dps.PresymplecticGauss, dps.SymmetricMultistep
_separable, _split, _nystrom, _linear, _shared, _any = (
    partial(Scheme, needs=kind)
    for kind in ("separable", "any", "nystrom", "linear", "shared", None)
)
_euler = partial(_separable, order=1, symmetric=False, composable=False)
_tao4 = lambda: Triple(4, dps.PresymplecticTao(4.0))

SCHEMES = [
    _euler("Euler", Euler),
    _euler("Euler, position first", partial(Euler, "position")),
    _separable("leapfrog", Leapfrog, 2),
    _separable("leapfrog, position first", partial(Leapfrog, "position"), 2),
    _separable("Suzuki-Yoshida 4", partial(Triple, 4), 4, inside=False),
    _separable("Suzuki-Yoshida 6", partial(Triple, 6), 6, inside=False),
    _separable("Suzuki4", dps.Suzuki4, 4),
    _separable("Sofroniou-Spaletta 6", partial(Spaletta, 6), 6),
    _separable("Sofroniou-Spaletta 8", partial(Spaletta, 8), 8),
    _separable("Sofroniou-Spaletta 10", partial(Spaletta, 10), 10),
    _split("Strang", dps.Strang, 2),
    _split("Blanes-Moan 4", dps.BlanesMoan4, 4),
    _split("Blanes-Moan 6", dps.BlanesMoan6, 6),
    _split("own moves", own.DrivenLeapfrog, 2),
    _split("Suzuki4 of Strang", lambda: dps.Suzuki4(dps.Strang()), 4),
    _nystrom("RKN4", dps.BlanesMoanRKN4, 4),
    _nystrom("RKN6", dps.BlanesMoanRKN6, 6),
    _nystrom("TunedRKN6", dps.TunedRKN6, 6),
    _nystrom("RKN8", dps.BlanesCasasRKN8, 8),
    _linear("TunedLinear8", dps.TunedLinear8, 8),
    _shared("multistep 8", partial(Multistep, 8), 8, composable=False),
    _shared("multistep 10", partial(Multistep, 10), 10, composable=False),
    _any("Tao", dps.PresymplecticTao, 2, composable=False),
    _any("Tao 4", _tao4, 4, inside=False),
    _any("midpoint", partial(Gauss, 1), 2, implicit=True),
    _any("Gauss 2", partial(Gauss, 2), 4),
    _any("Gauss 4", partial(Gauss, 4), 8),
    _any("Gauss 3, root finder", partial(Gauss, 3), 6, implicit=True),
]


# Wrappers and nestings: the wrapped scheme, how many of its steps are one, and the
# order of a composition.


@dataclasses.dataclass(frozen=True)
class Wrapper:
    name: str
    wrap: Callable
    steps: int | None = 1  # of the bare scheme; `None` if it is another scheme
    order: int | None = None  # of a composition of a scheme of order two
    inside: bool = True

    def __repr__(self):
        return self.name

    @property
    def composes(self) -> bool:
        return self.order is not None


_triple = 1 / (2 - 2 ** (1 / 3))
_weights = _triple, 1 - 2 * _triple, _triple
_composition = lambda base: dps.Composition(base, _weights, order=4)
_kept = dps.Compensated
_composed = partial(Wrapper, steps=None)

WRAPPERS = [
    Wrapper("bare", lambda base: base),
    Wrapper("Compensated", _kept),
    Wrapper("substeps", lambda base: substeps(base, 2), 2),
    Wrapper("substeps(Compensated)", lambda base: substeps(_kept(base), 3), 3),
    Wrapper("Compensated(substeps)", lambda base: _kept(substeps(base, 2)), 2),
    _composed("Suzuki4", dps.Suzuki4, order=4),
    _composed("Sofroniou-Spaletta 6", partial(Spaletta, 6), order=6),
    _composed(
        "Compensated(Composition)",
        lambda base: _kept(_composition(base)),
        order=4,
        inside=False,
    ),
    _composed("Suzuki4(Compensated)", lambda x: dps.Suzuki4(_kept(x)), order=4),
]


def pick(*names: str) -> list[Scheme]:
    return [scheme for name in names for scheme in SCHEMES if scheme.name == name]


# One for each kind of solver state: none, a force, a copy. Diffrax does not depend on
# anything else.
STATES = pick("leapfrog, position first", "Suzuki-Yoshida 4", "Tao 4")
# One for each code path; the others differ only in their coefficients.
PATHS = [*STATES, *pick("Euler, position first", "leapfrog", "Strang", "RKN4")]


def each(chosen=SCHEMES):
    """Parametrise a test over schemes."""
    return pytest.mark.parametrize("scheme", chosen, ids=repr)
