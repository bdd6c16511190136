"""Compositions: several steps of a scheme as one, each a list of weights."""

import itertools
import math
from collections.abc import Sequence
from decimal import Decimal, localcontext

import equinox as eqx

from .._compositions import SOFRONIOU_SPALETTA, substeps, SUZUKI_4
from .._system._bound import System
from ._base import AbstractPresymplecticSolver, check_base, Scheme
from ._engine import MoveSequence
from ._frozen import PresymplecticLeapfrog
from ._strong_friction import friction_limit, part_of


class Composition(AbstractPresymplecticSolver):
    """Several steps of a scheme as one, given by weights.

    Order as given. The cost per step is that of the base times the number of weights.
    Uses Hermite interpolation for dense/ts output, in Diffrax's own loop at the cost of
    up to seven more steps.

    With equal weights, `Composition(base, (1 / n,) * n)`, it is `n` steps of the base,
    and what Diffrax's loop does once per step is done `n` times less often.
    """

    base: AbstractPresymplecticSolver
    weights: tuple[float, ...] = eqx.field(static=True)
    composed_order: int = eqx.field(static=True)

    def __init__(self, base, weights: Sequence[float], order: int | None = None):
        """**Arguments:**

        - `base`: a presymplectic solver, symmetric unless all weights are equal; for
            example `PresymplecticLeapfrog`.
        - `weights`: the lengths of the stages in units of the step: real numbers of any
            sign that sum to one.
        - `order`: the order of the composition, which is not computed from the weights.
            Used by adaptive step size controllers. Defaults to that of the base.

        **Raises:**

        `ValueError` if the weights do not sum to one, or the base is not symmetric.
        """
        check_base(base)
        self.base = base
        self.weights = tuple(float(w) for w in weights)
        self.composed_order = 1 if order is None else order
        total = math.fsum(self.weights)
        if not abs(total - 1) < 1e-12:
            raise ValueError(
                f"`weights` must sum to one, but sum to {total}. To scale them, divide "
                "by their sum."
            )
        if type(self.composed_order) is not int or self.composed_order < 1:
            raise ValueError(
                "`Composition(..., order=...)` must be a positive integer, or omitted "
                f"for the order of the base, but got {order!r}."
            )
        if len(set(self.weights)) > 1 and not base.is_symmetric:
            raise ValueError(
                "Compositions need a symmetric base, which "
                f"`{type(base).__name__}` is not. Compose `PresymplecticLeapfrog()` "
                "instead."
            )

    @property
    def is_symmetric(self) -> bool:
        return self.base.is_symmetric and self.weights == self.weights[::-1]

    def order(self, terms) -> int:
        return max(self.composed_order, self.base.order(terms))

    def scheme(self, system: System) -> Scheme:
        scheme = self.base.scheme(system)
        if len(set(self.weights)) > 1 and scheme.not_composable is not None:
            raise ValueError(scheme.not_composable)
        parts = [part_of(scheme.pattern, weight) for weight in self.weights]
        pattern = tuple(itertools.chain(*parts))
        most = scheme.most_friction / max(map(abs, self.weights))
        if most == math.inf:
            most = friction_limit(system, pattern, self.order(None))
        return scheme._replace(
            inner=MoveSequence([scheme.inner], substeps(self.weights)),
            most_friction=most,
            pattern=pattern,
        )


def _leapfrog_if_none(base) -> AbstractPresymplecticSolver:
    return PresymplecticLeapfrog() if base is None else base


def SuzukiYoshida(
    order: int, base: AbstractPresymplecticSolver | None = None
) -> Composition:
    """The triple jump of Suzuki and Yoshida, to any even order.

    Order as given; `3^(r/2 - 1)` force evaluations per step at order `r`. Symmetric.
    Uses Hermite interpolation for dense/ts output, in Diffrax's own loop at the cost of
    up to seven more steps.

    The scheme of the paper. Its error constants are large, and its stages extend beyond
    both ends of the step, by up to 0.35, 0.65 and 0.92 of its length at orders 4, 6 and
    8. The system must be defined there: `LogDamping` is not close to its singularity.

    **Arguments:**

    - `order`: the order, a positive even number. At 2 it is the base itself.
    - `base`: a symmetric presymplectic solver of second order. Defaults to
        `PresymplecticLeapfrog`.

    **Returns:** a `Composition`.

    **Raises:**

    `ValueError` if the order is not a positive even number, or the base is not
    symmetric.

    ??? cite "Reference"

        Equation (yoshida_comp) of França, Jordan and Vidal (2021), after

        ```bibtex
        @article{yoshida1990construction,
            author={Yoshida, Haruo},
            title={Construction of higher order symplectic integrators},
            journal={Physics Letters A}, volume={150}, number={5-7}, pages={262--268},
            year={1990}}
        @article{suzuki1990fractal,
            author={Suzuki, Masuo},
            title={Fractal decomposition of exponential operators with applications to
                many-body theories and {M}onte {C}arlo simulations},
            journal={Physics Letters A}, volume={146}, number={6}, pages={319--323},
            year={1990}}
        ```
    """
    if not isinstance(order, int) or order < 2 or order % 2 != 0:
        raise ValueError(
            "`SuzukiYoshida(order)` needs a positive even integer, for example "
            f"`SuzukiYoshida(4)`, but got {order!r}."
        )
    return Composition(_leapfrog_if_none(base), triple_jump(order), order)


def PresymplecticYoshida4(
    base: AbstractPresymplecticSolver | None = None,
) -> Composition:
    """Yoshida's fourth-order scheme, `SuzukiYoshida(4, base)`.

    4th order and symmetric. Three force evaluations per step. Uses Hermite
    interpolation for dense/ts output, in Diffrax's own loop at the cost of another
    step.

    `BlanesMoanRKN4` has errors some three hundred times smaller at equal cost.

    **Arguments:**

    - `base`: a symmetric presymplectic solver of second order. Defaults to
        `PresymplecticLeapfrog`.

    **Returns:** a `Composition`.

    **Raises:**

    `ValueError` if the base is not symmetric.
    """
    return SuzukiYoshida(4, base)


def Suzuki4(base: AbstractPresymplecticSolver | None = None) -> Composition:
    """Suzuki's fourth-order composition of five stages.

    4th order, 5 stages, symmetric: with the default base 5 force evaluations per step.
    Uses Hermite interpolation for dense/ts output, in Diffrax's own loop at the cost of
    another step.

    Its error is several times smaller than that of the triple jump (`SuzukiYoshida`) at
    equal cost, and its stages stay within the step.

    Source: Suzuki (1990), see `SuzukiYoshida`.

    **Arguments:**

    - `base`: a symmetric presymplectic solver of second order. Defaults to
        `PresymplecticLeapfrog`.

    **Returns:** a `Composition`.

    **Raises:**

    `ValueError` if the base is not symmetric.
    """
    return Composition(_leapfrog_if_none(base), SUZUKI_4, 4)


def SofroniouSpaletta(
    order: int = 6, base: AbstractPresymplecticSolver | None = None
) -> Composition:
    """Sofroniou and Spaletta's compositions of 13, 21 and 35 stages.

    6th, 8th or 10th order, symmetric: with the default base 13, 21 or 35 force
    evaluations per step. Uses Hermite interpolation for dense/ts output, in Diffrax's
    own loop at the cost of three more steps.

    The recommended compositions of high order, for any base. If the kinetic part has a
    known flow, a `Splitting` is more accurate at equal cost.

    **Arguments:**

    - `order`: 6, 8 or 10. Defaults to 6. Order 10 is for errors close to rounding.
    - `base`: a symmetric presymplectic solver of second order. Defaults to
        `PresymplecticLeapfrog`.

    **Returns:** a `Composition`.

    **Raises:**

    `ValueError` if the order is not one of these, or the base is not symmetric.

    ??? cite "Reference"

        ```bibtex
        @article{sofroniou2005derivation,
            author={Sofroniou, Mark and Spaletta, Giulia},
            title={Derivation of symmetric composition constants for symmetric
                integrators}, journal={Optimization Methods and Software}, volume={20},
            number={4-5}, pages={597--613}, year={2005}}
        ```
    """
    if order not in SOFRONIOU_SPALETTA:
        raise ValueError(
            f"`SofroniouSpaletta(order)` must be 6, 8 or 10, but got {order!r}. At "
            "order 4 use `Suzuki4()`."
        )
    return Composition(_leapfrog_if_none(base), SOFRONIOU_SPALETTA[order], order)


def triple_jump(order: int) -> tuple[float, ...]:
    """The weights of equation (yoshida_comp), correctly rounded."""
    with localcontext() as context:
        context.prec = 50
        weights = [Decimal(1)]
        for r in range(1, order // 2):
            kappa = Decimal(2) ** (Decimal(1) / (2 * r + 1))
            outer, inner = 1 / (2 - kappa), -kappa / (2 - kappa)
            weights = [j * w for j in (outer, inner, outer) for w in weights]
        return tuple(float(w) for w in weights)
