import math
from decimal import Decimal, localcontext
from typing import ClassVar, Literal, TYPE_CHECKING

import equinox as eqx
import optimistix as optx

from .._compositions import stages
from .._system._bound import System
from ._base import AbstractPresymplecticSolver, check_base, Scheme
from ._engine import Stages
from ._frozen import PresymplecticLeapfrog
from ._tableaus import (
    CompositionTableau,
    SOFRONIOU_SPALETTA_6,
    SOFRONIOU_SPALETTA_8,
    SOFRONIOU_SPALETTA_10,
    SUZUKI_4,
)


if TYPE_CHECKING:
    # To a type checker an abstract field is any kind of field.
    from typing import ClassVar as AbstractVar
else:
    from equinox import AbstractVar


Weights = tuple[float, ...]


class AbstractComposition(AbstractPresymplecticSolver):
    """Several steps of a base scheme as one, with weights that sum to one."""

    base: AbstractVar[AbstractPresymplecticSolver]
    weights: AbstractVar[Weights]

    def __check_init__(self):
        check_base(self.base)
        if len(set(self.weights)) > 1 and not self.base.is_symmetric:
            raise ValueError(
                "Compositions need a symmetric base, which "
                f"`{type(self.base).__name__}` is not. Compose "
                "`PresymplecticLeapfrog()` instead."
            )

    @property
    def is_symmetric(self) -> bool:
        return self.base.is_symmetric and self.weights == self.weights[::-1]

    def scheme(self, system: System) -> Scheme:
        scheme = self.base.scheme(system)
        if len(set(self.weights)) > 1 and scheme.not_composable is not None:
            raise ValueError(scheme.not_composable)
        return scheme._replace(moves=Stages([scheme.moves], stages(self.weights)))


class Composition(AbstractComposition):
    """A composition of a symmetric scheme with itself, given by weights.

    Order as given. The cost per step is that of the base times the number of weights.
    Uses Hermite interpolation for dense/ts output, at the cost of up to three more
    steps.
    """

    base: AbstractPresymplecticSolver
    weights: Weights = eqx.field(static=True)
    composed_order: int | None = eqx.field(static=True)

    def __init__(self, base, weights, order: int | None = None):
        """**Arguments:**

        - `base`: a symmetric presymplectic solver, for example
            [`diffrax_presym.PresymplecticLeapfrog`][].
        - `weights`: the lengths of the stages in units of the step: real numbers of any
            sign that sum to one.
        - `order`: the order of the composition, which is not computed from the weights.
            Used by adaptive step size controllers. Defaults to that of the base.

        **Raises:**

        `ValueError` if the weights do not sum to one, or the base is not symmetric.
        """
        weights = tuple(float(w) for w in weights)
        total = math.fsum(weights)
        if not abs(total - 1) < 1e-12:
            raise ValueError(
                f"`weights` must sum to one, but sum to {total}. To scale them, divide "
                "by their sum."
            )
        if order is not None and (not isinstance(order, int) or order < 1):
            raise ValueError(
                "`Composition(..., order=...)` must be a positive integer, or omitted "
                f"for the order of the base, but got {order!r}."
            )
        self.base = base
        self.weights = weights
        self.composed_order = order

    def order(self, terms) -> int:
        return max(self.composed_order or 1, self.base.order(terms))


class SuzukiYoshida(AbstractComposition):
    r"""The triple jump of Suzuki and Yoshida, to any even order.

    Order as given; $3^{r/2 - 1}$ force evaluations per step at order $r$. Symmetric.
    Uses Hermite interpolation for dense/ts output, at the cost of up to three more
    steps.

    The scheme of the paper. Its error constants are large, and its stages extend beyond
    both ends of the step, by up to 0.35, 0.65 and 0.92 of its length at orders 4, 6 and
    8. A system that is singular at the initial time, such as with
    [`diffrax_presym.LogDamping`][] without a shift, is then evaluated outside its
    domain.

    ??? cite "Reference"

        Equation (yoshida_comp) of França, Jordan and Vidal (2021), after

        ```bibtex
        @article{yoshida1990construction,
            author={Yoshida, Haruo},
            title={Construction of higher order symplectic integrators},
            journal={Physics Letters A},
            volume={150},
            number={5-7},
            pages={262--268},
            year={1990},
        }

        @article{suzuki1990fractal,
            author={Suzuki, Masuo},
            title={Fractal decomposition of exponential operators with applications to
                   many-body theories and {M}onte {C}arlo simulations},
            journal={Physics Letters A},
            volume={146},
            number={6},
            pages={319--323},
            year={1990},
        }
        ```
    """

    base: AbstractPresymplecticSolver
    weights: Weights = eqx.field(static=True)
    composed_order: int = eqx.field(static=True)

    def __init__(
        self,
        order: int,
        base: AbstractPresymplecticSolver = PresymplecticLeapfrog(),  # noqa: B008
    ):
        """**Arguments:**

        - `order`: the order, a positive even number. At 2 it is the base itself.
        - `base`: a symmetric presymplectic solver of second order. Defaults to
            [`diffrax_presym.PresymplecticLeapfrog`][].

        **Raises:**

        `ValueError` if the order is not a positive even number, or the base is not
        symmetric.
        """
        if not isinstance(order, int) or order < 2 or order % 2 != 0:
            raise ValueError(
                "`SuzukiYoshida(order)` needs a positive even integer, for example "
                f"`SuzukiYoshida(4)`, but got {order!r}."
            )
        self.base = base
        self.weights = triple_jump(order)
        self.composed_order = order

    def order(self, terms) -> int:
        return max(self.composed_order, self.base.order(terms))


class PresymplecticYoshida4(AbstractComposition):
    """The fourth-order method of Creutz and Gocksch, Forest and Ruth, Suzuki, Yoshida.

    4th order and symmetric. Three force evaluations per step. Uses 3rd order Hermite
    interpolation for dense/ts output, at the cost of another step.

    The fourth-order scheme of the paper, the same as
    [`diffrax_presym.SuzukiYoshida`][]`(4)`; see there for its limitations.

    ??? cite "Reference"

        Equation (yoshida_comp) with `r = 1` of França, Jordan and Vidal (2021), after

        ```bibtex
        @article{forest1990fourth,
            author={Forest, Etienne and Ruth, Ronald D.},
            title={Fourth-order symplectic integration},
            journal={Physica D: Nonlinear Phenomena},
            volume={43},
            number={1},
            pages={105--117},
            year={1990},
        }
        ```
    """

    base: AbstractPresymplecticSolver
    weights: Weights = eqx.field(static=True)

    def __init__(
        self,
        first: Literal["momentum", "position"] = "momentum",
        root_finder: optx.AbstractRootFinder | None = None,
        root_find_max_steps: int = 32,
    ):
        self.base = PresymplecticLeapfrog(first, root_finder, root_find_max_steps)
        self.weights = triple_jump(4)

    def order(self, terms) -> int:
        return 4


PresymplecticYoshida4.__init__.__doc__ = PresymplecticLeapfrog.__init__.__doc__


class AbstractTabulated(AbstractComposition):
    """A composition with known weights."""

    tableau: AbstractVar[CompositionTableau]

    @property
    def weights(self) -> Weights:
        return self.tableau.weights

    def order(self, terms) -> int:
        return max(self.tableau.order, self.base.order(terms))


_BASE = """**Arguments:**

- `base`: a symmetric presymplectic solver of second order. Defaults to
    [`diffrax_presym.PresymplecticLeapfrog`][].

**Raises:**

`ValueError` if the base is not symmetric.
"""


class Suzuki4(AbstractTabulated):
    """Suzuki's fourth-order composition of five stages.

    4th order, 5 stages, symmetric if its base is: with the default base 5 force
    evaluations per step. Uses Hermite interpolation for dense/ts output, at the cost
    of another step.

    Its error is several times smaller than that of the triple jump
    ([`diffrax_presym.PresymplecticYoshida4`][]) at equal cost, and its stages stay
    within the step.

    Source: Suzuki (1990), see [`diffrax_presym.SuzukiYoshida`][].
    """

    base: AbstractPresymplecticSolver = PresymplecticLeapfrog()
    tableau: ClassVar[CompositionTableau] = SUZUKI_4


Suzuki4.__init__.__doc__ = _BASE


class SofroniouSpaletta6(AbstractTabulated):
    """Sofroniou and Spaletta's sixth-order composition of thirteen stages.

    6th order, 13 stages, symmetric if its base is: with the default base 13 force
    evaluations per step. Uses Hermite interpolation for dense/ts output, at the cost
    of three more steps.

    The recommended composition of sixth order, for any base. If the kinetic part has a
    known flow, a [`diffrax_presym.Splitting`][] is more accurate at equal cost.

    ??? cite "Reference"

        ```bibtex
        @article{sofroniou2005derivation,
            author={Sofroniou, Mark and Spaletta, Giulia},
            title={Derivation of symmetric composition constants for symmetric
                   integrators},
            journal={Optimization Methods and Software},
            volume={20},
            number={4-5},
            pages={597--613},
            year={2005},
        }
        ```
    """

    base: AbstractPresymplecticSolver = PresymplecticLeapfrog()
    tableau: ClassVar[CompositionTableau] = SOFRONIOU_SPALETTA_6


SofroniouSpaletta6.__init__.__doc__ = _BASE


class SofroniouSpaletta8(AbstractTabulated):
    """Sofroniou and Spaletta's eighth-order composition of twenty-one stages.

    8th order, 21 stages, symmetric if its base is: with the default base 21 force
    evaluations per step. Uses Hermite interpolation for dense/ts output, at the cost
    of three more steps.

    The recommended composition of eighth order, for any base.

    Source: Sofroniou and Spaletta (2005), see [`diffrax_presym.SofroniouSpaletta6`][].
    """

    base: AbstractPresymplecticSolver = PresymplecticLeapfrog()
    tableau: ClassVar[CompositionTableau] = SOFRONIOU_SPALETTA_8


SofroniouSpaletta8.__init__.__doc__ = _BASE


class SofroniouSpaletta10(AbstractTabulated):
    """Sofroniou and Spaletta's tenth-order composition of thirty-five stages.

    10th order, 35 stages, symmetric if its base is: with the default base 35 force
    evaluations per step. Uses Hermite interpolation for dense/ts output, at the cost
    of three more steps.

    For errors close to rounding, which lower orders do not reach with fewer stages.

    Source: Sofroniou and Spaletta (2005), see [`diffrax_presym.SofroniouSpaletta6`][].
    """

    base: AbstractPresymplecticSolver = PresymplecticLeapfrog()
    tableau: ClassVar[CompositionTableau] = SOFRONIOU_SPALETTA_10


SofroniouSpaletta10.__init__.__doc__ = _BASE


class Substeps(AbstractComposition):
    """Several equal steps of a scheme as one step of the solve.

    Order and accuracy at the ends of steps are those of the base; the cost per step is
    `n` times its cost. Dense/ts output interpolates over all `n` steps at once, and is
    less accurate.

    What `diffeqsolve` does once per step (`SaveAt(ts=...)`, events, `SaveAt(steps=...)`
    of every `n`-th step, progress meters) is done `n` times less often.
    """

    base: AbstractPresymplecticSolver
    weights: Weights = eqx.field(static=True)

    def __init__(self, base: AbstractPresymplecticSolver, n: int):
        """**Arguments:**

        - `base`: any presymplectic solver.
        - `n`: the number of steps of the base in one step, a positive integer. The
            `dt0` of the solve is `n` times the step of the base.

        **Raises:**

        `ValueError` if `n` is not a positive integer.
        """
        if not isinstance(n, int) or n < 1:
            raise ValueError(
                "`Substeps(base, n)` needs a positive Python integer `n`, for example "
                f"`Substeps(PresymplecticLeapfrog(), 10)`, but got {n!r}."
            )
        self.base = base
        self.weights = (1 / n,) * n

    def order(self, terms) -> int:
        return self.base.order(terms)


def triple_jump(order: int) -> Weights:
    """The weights of equation (yoshida_comp), correctly rounded."""
    with localcontext() as context:
        context.prec = 50
        weights = [Decimal(1)]
        for r in range(1, order // 2):
            kappa = Decimal(2) ** (Decimal(1) / (2 * r + 1))
            outer, inner = 1 / (2 - kappa), -kappa / (2 - kappa)
            weights = [j * w for j in (outer, inner, outer) for w in weights]
        return tuple(float(w) for w in weights)
