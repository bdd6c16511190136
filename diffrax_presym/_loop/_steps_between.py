"""Steps that end at given times, as a controller of Diffrax."""

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from .._checks import as_finite
from .._numbers import cast_to
from ._steps import Steps


class StepsBetween(dfx.AbstractStepSizeController):
    """Equal steps between given times, each no longer than `dt0`.

    For a force or friction with kinks or jumps at known times, such as a table read by
    `jax.numpy.interp`: a step across a kink has order two at most, and one across a
    jump one, steps that end there keep the order of the scheme. Only the stages of
    `SuzukiYoshida` go beyond the step, and see a jump too early; and in Diffrax's loop,
    whose last step ends at `t1` whatever a controller says, schemes that end with a
    kick see a jump at `t1` itself, in the last momentum. The steps between two
    of the times are equal, and as few as are not longer than `dt0`. In `float32` the
    times are rounded: shorter spans are wrong by as much, late in a long solve.

    !!! example

        ```python
        times = jnp.array([0.0, 3.0, 4.0, 10.0])
        forces = jnp.array([0.0, 1.0, -1.0, 0.0])
        force = ForceField(lambda t, q, args: jnp.interp(t, times, forces) - q)
        sol = diffeqsolve(
            MechanicalSystem(QuadraticKinetic(), force),
            *(TunedRKN6(), 0.0, 10.0, 1.0, (jnp.ones(1), jnp.zeros(1))),
            stepsize_controller=StepsBetween(times), adjoint=FixedStepAdjoint(),
        )
        ```
    """

    times: Float[Array, " times"]  # sorted

    def __init__(self, times):
        """**Arguments:**

        - `times`: the times at which steps end, in any order. Those that are not
            between `t0` and `t1` are ignored.

        **Raises:**

        `ValueError` if they are not a vector of finite numbers.
        """
        given = jnp.atleast_1d(as_finite(times, "`StepsBetween(times)`"))
        if given.ndim > 1:
            raise ValueError(
                "`StepsBetween(times)` must be a vector, but got the shape "
                f"{given.shape}."
            )
        if isinstance(times, Tracer):
            # Those that are not a number are known now only to be ignored.
            self.times = jnp.sort(jnp.where(jnp.isnan(given), jnp.inf, given))
        else:  # Once, rather than in each solve.
            self.times = jnp.asarray(np.sort(np.atleast_1d(times)), given.dtype)

    def wrap(self, direction):
        times = self.times * cast_to(direction, self.times)
        times = jnp.where(direction < 0, times[::-1], times)
        return eqx.tree_at(lambda self: self.times, self, times)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        if dt0 is None:
            raise ValueError(
                "`StepsBetween` needs the longest step. Write "
                "`diffeqsolve(..., dt0=...)`."
            )
        steps = Steps(t0, t1, dt0, self.times)
        first = jnp.ones((), int)
        return self._end(steps, first), (first, steps)

    def _end(self, steps: Steps, n: Array) -> Array:
        """That of a step before step `n`, in Diffrax's loop before a kink."""
        kink = steps.is_kink(n) & (n < steps.total)
        return jnp.where(kink, eqxi.prevbefore(steps.time(n)), steps.time(n))

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        n, steps = controller_state
        times, state = (steps.time(n), self._end(steps, n + 1)), (n + 1, steps)
        return True, *times, steps.is_kink(n), state, dfx.RESULTS.successful


def known_steps(controller: dfx.AbstractStepSizeController, t0, t1, dt0) -> Steps:
    """The steps of a controller that are known before the solve."""
    if isinstance(controller, dfx.StepTo):
        return Steps(t0, t1, dt0, ts=controller.ts)
    times = controller.times if isinstance(controller, StepsBetween) else None
    return Steps(t0, t1, dt0, times)
