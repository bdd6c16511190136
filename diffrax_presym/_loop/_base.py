"""What the loop asks of the steps of a solve."""

import abc
from collections.abc import Sequence
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree

from .._friction._linear import LinearFriction
from .._numbers import Scalar, State
from .._scheme._base import between, Point, Scheme
from .._scheme._engine import Result, Span
from .._system._bound import System


# The largest friction over a step that polynomials are to follow. With more the motion
# decays, or turns, too fast.
MOST_FRICTION = 0.5
# The same of those over several steps, at a constant rate: no singularity is near.
MOST_CONSTANT = 1.5
# The largest angle by which a drift may turn in a step that polynomials are to follow:
# values between steps are then as accurate as these, also where it grows to twice that.
MOST_TURN = 1.5
# More than any solve takes, in integers of either precision.
MOST_STEPS = 2**30


class Stop(NamedTuple):
    """Where a state is wanted next: at the start of a step, or at a time; `None` where
    all that is wanted is at steps that are known."""

    n: Int[Array, ""]
    time: Float[Array, ""] | None = None


def follows(
    friction: LinearFriction | None, t0: Array, h: Array, most: float = MOST_FRICTION
) -> Any:
    """Whether polynomials can follow the motion over a step with friction `by_rates`:
    the logarithm of a decay, and the angle of a rotation, are small."""
    if friction is None:
        return True
    start, h = jnp.minimum(t0, t0 + h), jnp.abs(h)
    return (friction.growth(start, h) <= most) & friction.is_smooth(start)


class AbstractSteps(eqx.Module):
    """The steps of a solve from `t0` to `t1`: where they end, and how one is taken.

    A step is given by its number and the point it starts from. Of these two, steps that
    are known beforehand use the number, and others the point.
    """

    t0: eqx.AbstractVar[Float[Array, ""]]
    t1: eqx.AbstractVar[Float[Array, ""]]
    are_known: eqx.AbstractClassVar[bool]

    @property
    @abc.abstractmethod
    def total(self) -> Int[Array, ""]:
        """The number of steps, or the largest that there may be."""

    @property
    @abc.abstractmethod
    def kinks(self) -> Int[Array, " kinks"] | None:
        """The steps that start where derivatives jump, if there may be any."""

    @abc.abstractmethod
    def locate(self, ts: Float[Array, " times"]) -> tuple[Array, Array]:
        """The step in which each time is, and whether it is inside of that or at its
        start."""

    @abc.abstractmethod
    def begin(self, n: Array, point: Point) -> Float[Array, ""]:
        """The start of a step."""

    @abc.abstractmethod
    def end(self, n: Array, point: Point) -> Float[Array, ""]:
        """The end of a step."""

    @abc.abstractmethod
    def since_begin(self, n: Array, point: Point, t: Array) -> Float[Array, ""]:
        """The time from the start of a step, which may be known better than that."""

    @abc.abstractmethod
    def previous(self, n: Array, point: Point) -> Float[Array, ""]:
        """The start of the step before, if that is known."""

    @abc.abstractmethod
    def ended(self, n: Array, point: Point) -> Bool[Array, ""]:
        """Whether that is the end of the solve."""

    # How the loop goes from stop to stop.

    @abc.abstractmethod
    def next_stop(self, stops: Sequence[Stop], last: Int[Array, ""]) -> Stop:
        """The first of some stops, and of the end of the last step."""

    @abc.abstractmethod
    def common(self, n: Int[Array, ""], going: Bool[Array, ""]) -> Int[Array, ""]:
        """The least number of those members of a batch that are `going` on, if their
        steps are known."""

    @abc.abstractmethod
    def together(self, left: Bool[Array, ""], soon: Bool[Array, ""]) -> Array:
        """Whether a member of a batch takes another step, of which some are `left` to
        its stop: if steps are not known, until those have none that were to stop
        `soon`, after one step. Otherwise they would wait for all others each time."""

    @abc.abstractmethod
    def before(self, stop: Stop, n: Array, point: Point) -> Bool[Array, ""]:
        """Whether a step from here ends at the stop or before."""

    @abc.abstractmethod
    def at(self, stop: Stop, n: Array, point: Point) -> Bool[Array, ""]:
        """Whether the state here is that of the stop."""

    @abc.abstractmethod
    def number(self, stop: Stop, n: Array) -> Int[Array, ""]:
        """Of the step where the loop came to, on its way to a stop."""

    @abc.abstractmethod
    def is_left(
        self, stop: Stop, last: Array, n: Array, point: Point
    ) -> Bool[Array, ""]:
        """Whether a stop from here on is not later than the end of the last step."""

    # How a step is taken.

    @abc.abstractmethod
    def join(self, carry: PyTree, control: PyTree) -> PyTree:
        """The solver state of the loop, with that of a controller."""

    @abc.abstractmethod
    def split(self, carry: PyTree) -> tuple[PyTree, PyTree]:
        """The two again."""

    @abc.abstractmethod
    def prepare(self, scheme: Scheme, system: System, backward: bool) -> PyTree:
        """What is the same for all steps."""

    @abc.abstractmethod
    def step(
        self, scheme: Scheme, system: System, n: Array, point: Point, data: PyTree
    ) -> tuple[Point, Result]:
        """Take a step."""

    @abc.abstractmethod
    def undo(
        self, scheme: Scheme, system: System, n: Array, point: Point, data: PyTree
    ) -> Point:
        """The inverse of a step, of its number and its end."""

    def shorter(
        self, scheme: Scheme, system: System, n: Array, point: Point, t: Array
    ) -> State:
        """The state at a time within a step."""
        y, carry = point
        times = self.begin(n, point), t, self.since_begin(n, point, t)
        span = Span(*map(system.time, times))
        return between(scheme, system, span, (y, self.split(carry)[0]))

    @abc.abstractmethod
    def explain(
        self,
        scheme: Scheme,
        system: System,
        n: Array,
        ends: tuple[Point, Point],
        result: dfx.RESULTS,
    ) -> dfx.RESULTS:
        """The result of so many steps between two ends, with the reason of a failure,
        unless each step has given it."""

    @abc.abstractmethod
    def growth(self, system: System, last: Array) -> Scalar | None:
        """Of rounding errors backwards in time over all steps, its logarithm."""

    @abc.abstractmethod
    def without_gradient(self) -> "AbstractSteps":
        """The same, where what is differentiated are the functions of a solve."""
