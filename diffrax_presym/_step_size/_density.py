import functools
from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.lax as lax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike

from .. import _tree as tree
from .._checks import as_positive, describe
from .._numbers import as_time, cast_to, Scalar, State
from .._results import STEP_DENSITY_INVALID, STEP_DENSITY_MISSED
from .._system._base import AbstractSystem


class StepDensityController(dfx.AbstractStepSizeController):
    """Reversible variable steps, `h ≈ ε σ(t, y)`.

    With steps chosen by an error estimate, the energy error of a symmetric scheme grows
    with time. Here two successive steps satisfy, at their common end,

    `1 / h_{n+1/2} + 1 / h_{n-1/2} = 2 / (ε σ(t_n, y_n))`

    (adaptive Verlet), which is the same in both directions of time. A solve backwards
    from its end then takes the same steps, and energy errors stay bounded as with
    constant steps. The first step extends this symmetry to the start,

    `1 / h_{1/2} = 1 / (ε σ) - (dσ/dt) / (2 σ)` at `(t0, y0)`,

    with the derivative along the motion. Steps are never rejected.

    For very uneven motion, such as close encounters; with every symmetric one-step
    scheme of this package and any solver of Diffrax. Not for smooth motion, where
    constant steps are cheaper. With `FixedStepAdjoint` values within steps are
    interpolated, at the cost of three derivatives of the force along the motion in each
    such step, and gradients are those of the discrete solution, with the dependence of
    the steps on the states.

    The density may be the system itself. Its time scale is then taken,

    `σ = (Σ_ij (∂q''_i / ∂q_j)^2)^(-1/4)`

    with the accelerations `q''` of all but linear friction: of an oscillation `1 / ω`,
    of bodies that attract each other a power 3/2 of the distance, as in Kepler's third
    law, so that a close encounter takes as many steps as a distant one. It costs at
    most four directional derivatives of the force per step: for more than four
    positions the sum is estimated from four fixed random directions, with which the
    time scale is mostly within a quarter of itself. `epsilon` of 0.1 is about 63 steps
    for each period. Of a single position the slope may vanish, at an inflection of the
    potential: the next two derivatives along the motion are added to it there,
    `σ = (s^6 + (ds/dt)^4 + |d²s/dt²|^3)^(-1/12)` with `s` the slope.

    Requires `dt0=None`. A solve fails with `RESULTS.step_density_missed` if a step
    differs from `ε σ` at one of its ends by more than a factor of four, as `epsilon` is
    then too large; with `RESULTS.step_density_invalid` where the density is not
    positive and finite; and with `RESULTS.dt_min_reached` if a step vanishes.

    ??? cite "Reference"

        ```bibtex
        @article{huang1997adaptive,
            author={Huang, Weizhang and Leimkuhler, Benedict},
            title={The adaptive {V}erlet method},
            journal={SIAM Journal on Scientific Computing}, volume={18}, number={1},
            pages={239--256}, year={1997}}

        @article{hutchinson1990stochastic,
            author={Hutchinson, M. F.},
            title={A stochastic estimator of the trace of the influence matrix for
                {L}aplacian smoothing splines},
            journal={Communications in Statistics - Simulation and Computation},
            volume={19}, number={2}, pages={433--450}, year={1990}}
        ```
    """

    epsilon: Scalar
    density: Callable
    direction: ArrayLike

    def __init__(self, epsilon: ArrayLike, density: Callable | AbstractSystem):
        """**Arguments:**

        - `epsilon`: the step size `ε` where the density is one; a positive number, in
            units of time if the density has none.
        - `density`: the step density `σ`, larger where steps are longer: the system,
            whose time scale it is; or a function `density(t, y, args)` that returns a
            positive scalar, as `lambda t, y, args: jnp.linalg.norm(y[0]) ** 1.5`.

        **Raises:**

        `ValueError` if `epsilon` is known not to be positive, and when the solve is
        traced if `dt0` is given or the density is not a scalar.
        """
        self.epsilon = as_positive(epsilon, "`StepDensityController(epsilon=...)`")
        if isinstance(density, AbstractSystem):
            density = TimeScale(density)
        if not callable(density):
            raise ValueError(
                "`StepDensityController(density=...)` must be a system or a function "
                f"`density(t, y, args)`, but got {density!r}. Write for example "
                "`lambda t, y, args: jnp.linalg.norm(y[0]) ** 1.5`."
            )
        self.density = density
        self.direction = 1

    def wrap(self, direction):
        return eqx.tree_at(lambda self: self.direction, self, direction)

    # The state is 1 / h of the next step.

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        if dt0 is not None:
            raise ValueError(
                "`StepDensityController` also chooses the first step. Write "
                "`diffeqsolve(..., dt0=None)`, and scale all steps by its `epsilon`."
            )
        t0 = as_time(t0)
        slope = func(terms, t0, y0, args)
        slope = jax.tree.map(
            lambda y, dy: cast_to(self.direction, y) * cast_to(dy, y), y0, slope
        )
        length = lambda t, y: self._length(t, y, args)
        h, rate = jax.jvp(length, (t0, y0), (jnp.ones_like(t0), slope))
        # Where the rate is not defined, a start without it is as symmetric.
        ratio = 1 - jnp.nan_to_num(rate) / 2
        state = jnp.where(_follows(ratio), ratio, 0) / h
        return t0 + self.step_size(state), state

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        h = self._length(t1, y1_candidate, args)
        state = 2 / h - controller_state
        t2 = t1 + self.step_size(state)
        select, result = dfx.RESULTS.where, dfx.RESULTS.successful
        result = select(t2 > t1, result, dfx.RESULTS.dt_min_reached)
        follows = _follows(controller_state * h)
        result = select(follows, result, STEP_DENSITY_MISSED)
        result = select((h > 0) & (h < jnp.inf), result, STEP_DENSITY_INVALID)
        return True, t1, t2, False, state, result

    def step_size(self, controller_state):
        """The size of the next step, a positive number.

        To continue a solve pass it as `dt0`, along with the `controller_state`; with a
        minus sign if the solve is backwards in time.

        **Arguments:**

        - `controller_state`: the state at the end of a solve, from
            `SaveAt(controller_state=True)`.
        """
        # Zero if it fails.
        return 1 / jnp.where(controller_state > 0, controller_state, jnp.inf)

    def reverse(self, t, y, args, controller_state):
        """The `controller_state` for a solve back along the same steps.

        The last step was cut off at `t1`, and is the first one back: pass its length
        too, as `dt0`.

        !!! example

            ```python
            weight = lambda t, q, args: -1 / jnp.linalg.norm(q)
            system = MechanicalSystem(QuadraticKinetic(), weight)
            controller = StepDensityController(0.2, system)
            options = dict(
                stepsize_controller=controller,
                saveat=SaveAt(steps=True, controller_state=True),
                adjoint=FixedStepAdjoint(),
                max_steps=200,
            )
            y0 = jnp.array([1.5, 0.0]), jnp.array([0.0, 0.6])
            sol = diffeqsolve(system, Strang(), 0.0, 5.0, None, y0, **options)
            n = sol.stats["num_steps"]
            t1, y1 = sol.ts[n - 1], jax.tree.map(lambda y: y[n - 1], sol.ys)
            state = controller.reverse(t1, y1, None, sol.controller_state)
            back = diffeqsolve(
                *(system, Strang(), t1, 0.0, sol.ts[n - 2] - t1, y1),
                controller_state=state,
                **options,
            )
            ```

        **Arguments:**

        - `t`, `y`: the time and state at the end of the solve.
        - `args`: as in `diffeqsolve`.
        - `controller_state`: the state at the end of the solve, from
            `SaveAt(controller_state=True)`.
        """
        return 2 / self._length(t, y, args) - controller_state

    def _length(self, t, y, args):
        """`ε σ`."""
        t = as_time(t)
        if jnp.shape(self.epsilon) != ():
            raise ValueError(
                "`StepDensityController(epsilon=...)` must be a number, but got the "
                f"shape {jnp.shape(self.epsilon)}. Solve for each by `jax.vmap`."
            )
        sigma = self.density(self.direction * t, y, args)
        if jnp.shape(sigma) != () or not jnp.isrealobj(sigma):
            raise ValueError(
                "The density of `StepDensityController` must return a real scalar, "
                f"but returned {describe(sigma)}. Write for example "
                "`lambda t, y, args: jnp.linalg.norm(y[0]) ** 1.5`."
            )
        return cast_to(self.epsilon, t) * cast_to(sigma, t)


# So many derivatives of accelerations are taken.
_DIRECTIONS = 4


class TimeScale(eqx.Module):
    """The time scale of a system, of the derivatives of accelerations."""

    system: AbstractSystem

    def __call__(self, t, y: State, args) -> Scalar:
        found: list[Callable] = [functools.partial(self._slopes, args)]
        if ravel_pytree(y[0])[0].size == 1:
            # Also the next two derivatives in time: the slope may vanish.
            for _ in range(2):
                found.append(self._rate(args, found[-1]))
        powers = {k: fn(as_time(t), *y) for k, fn in enumerate(found, start=2)}
        # In units of the largest rate, so that nothing overflows.
        rates = [tree.largest(x) ** (1 / k) for k, x in powers.items()]
        unit = lax.stop_gradient(functools.reduce(jnp.maximum, rates))
        unit = jnp.where(unit > 0, unit, 1)
        squares = {k: jnp.sum((x / unit**k) ** 2) for k, x in powers.items()}
        total = sum(square ** (6 / k) for k, square in squares.items())
        return total ** (-1 / 12) / unit

    def _motion(self, args, t, q, p) -> State:
        velocity = self.system.velocity(t, q, p, args)
        return velocity, self.system.force(t, q, p, args)

    def _rate(self, args, fn: Callable) -> Callable:
        """The derivative of `fn(t, q, p)` along the motion."""

        def rate(t, q, p):
            along = jnp.ones_like(t), *self._motion(args, t, q, p)
            return jax.jvp(fn, (t, q, p), along)[1]

        return rate

    def _slopes(self, args, t, q, p) -> Array:
        """Derivatives of the accelerations by the positions, in some directions."""
        flat, structure = ravel_pytree(q)

        def acceleration(x):
            velocity = lambda q, p: self.system.velocity(t, q, p, args)
            at = structure(x), p
            return ravel_pytree(jax.jvp(velocity, at, self._motion(args, t, *at))[1])[0]

        along = lambda x: jax.jvp(acceleration, (flat,), (x,))[1]
        return jax.vmap(along)(cast_to(_directions(flat.size), flat))


@functools.cache
def _directions(number: int) -> np.ndarray:
    """Vectors `x` of which the sum of `|J x|^2` is that of the squares of all entries
    of `J`: exactly if there are as many as columns, and as an estimate with random
    vectors, the same in each call, if there are more columns (Hutchinson, 1990)."""
    if number <= _DIRECTIONS:
        return np.eye(number)
    # The entries of four columns are orthogonal.
    blocks = -(-number // _DIRECTIONS), _DIRECTIONS, _DIRECTIONS
    frames = np.linalg.qr(np.random.default_rng(0).standard_normal(blocks))[0]
    return frames.reshape(-1, _DIRECTIONS)[:number].T


def _follows(ratio):
    """Whether two steps with the common end are within a factor of four of `ε σ`
    there, of which the one is `ε σ` over `ratio`."""
    return jnp.abs(ratio - 1) <= 0.75
