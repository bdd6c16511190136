from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import ArrayLike

from .._checks import as_positive, describe
from .._numbers import as_time, cast_to, Scalar
from .._system._base import AbstractSystem


class StepDensityController(dfx.AbstractStepSizeController):
    r"""Reversible variable steps, $h \approx \epsilon \sigma(t, y)$.

    With steps chosen by an error estimate, the energy error of a symmetric scheme grows
    with time. Here the logarithm of the step is integrated along with the motion,

    $$z_{n+1/2} = z_{n-1/2} - \epsilon \sigma \frac{\mathrm d}{\mathrm dt} \log \sigma,
    \qquad h_{n+1/2} = \epsilon e^{-z_{n+1/2}},$$

    with $\sigma$ and its derivative along the motion at step $n$; the first change,
    from $z_0 = -\log \sigma(t_0, y_0)$, is half of it. A solve backwards from its end
    then takes the same steps, and energy errors stay bounded as with constant steps.
    Steps are never rejected and never negative.

    For very uneven motion, such as close encounters; with every symmetric one-step
    scheme of this package and any solver of Diffrax. Not for smooth motion, where
    constant steps are cheaper. For attraction that is unbounded as bodies approach each
    other take the distance to the power 3/2, by Kepler's third law: a close encounter
    takes as many steps as a distant one. Of several distances take
    $\big( \sum_k r_k^{-3} \big)^{-1/2}$. Steps of equal length in phase space have the
    density $|(\dot q, \dot p)|^{-1}$. Requires `dt0=None`; a solve fails with
    `RESULTS.dt_min_reached` if a step vanishes, as it does where the density is
    infinite.

    ??? cite "Reference"

        ```bibtex
        @article{hairer2005explicit,
            author={Hairer, Ernst and S{\"o}derlind, Gustaf},
            title={Explicit, time reversible, adaptive step size control},
            journal={SIAM Journal on Scientific Computing}, volume={26}, number={6},
            pages={1838--1851}, year={2005}}
        ```
    """

    system: AbstractSystem
    epsilon: Scalar
    density: Callable
    direction: ArrayLike

    def __init__(self, system: AbstractSystem, epsilon: ArrayLike, density: Callable):
        r"""**Arguments:**

        - `system`: the system of the solve, for the derivative along the motion.
        - `epsilon`: the step size $\epsilon$ where the density is one; a positive
            number, in units of time if the density has none.
        - `density`: the step density $\sigma$, a function `density(t, y, args)` that
            returns a positive scalar; for example
            `lambda t, y, args: jnp.linalg.norm(y[0]) ** 1.5`.

        **Raises:**

        `ValueError` if `epsilon` is known not to be positive, if the system is not
        one of this package, and when the solve is traced if `dt0` is
        given or the density is not a scalar.
        """
        if not isinstance(system, AbstractSystem):
            raise ValueError(
                "`StepDensityController(system, ...)` needs the system of the solve, "
                f"such as a `MechanicalSystem`, but got {system!r}."
            )
        self.system = system
        self.epsilon = as_positive(epsilon, "`StepDensityController(epsilon=...)`")
        if not callable(density):
            raise ValueError(
                "`StepDensityController(density=...)` must be a function `density(t, "
                f"y, args)`, but got {density!r}. Write for example `lambda t, y, "
                "args: jnp.linalg.norm(y[0]) ** 1.5`."
            )
        self.density = density
        self.direction = 1

    def wrap(self, direction):
        return eqx.tree_at(lambda self: self.direction, self, direction)

    def init(self, terms, t0, t1, y0, dt0, args, func, error_order):
        if dt0 is not None:
            raise ValueError(
                "`StepDensityController` also chooses the first step. Write "
                "`diffeqsolve(..., dt0=None)`, and scale all steps by its `epsilon`."
            )
        log_density, change = self._density(t0, y0, args)
        z = change / 2 - log_density
        return t0 + self.step_size(z), z

    def adapt_step_size(
        self, t0, t1, y0, y1_candidate, args, y_error, error_order, controller_state
    ):
        _, change = self._density(t1, y1_candidate, args)
        z = controller_state + change
        t2 = t1 + self.step_size(z)
        moves = jnp.isfinite(t2) & (t2 > t1)
        result = dfx.RESULTS.where(
            moves, dfx.RESULTS.successful, dfx.RESULTS.dt_min_reached
        )
        return True, t1, t2, False, z, result

    def step_size(self, controller_state):
        """The size of the next step.

        To continue a solve pass it as `dt0`, along with the `controller_state`.

        **Arguments:**

        - `controller_state`: the state at the end of a solve, from
            `SaveAt(controller_state=True)`.
        """
        z = controller_state
        return cast_to(self.epsilon, z) * jnp.exp(-z)

    def reverse(self, t, y, args, controller_state):
        """The `controller_state` for a solve back along the same steps.

        For a solve forwards in time. Of one backwards in time the state is that of
        `controller.wrap(-1).reverse(-t, y, args, controller_state)`.

        **Arguments:**

        - `t`, `y`: the time and state at the end of the solve.
        - `args`: as in `diffeqsolve`.
        - `controller_state`: the state at the end of the solve, from
            `SaveAt(controller_state=True)`.
        """
        return controller_state - self._density(t, y, args)[1]

    def _density(self, t, y, args):
        r"""$\log \sigma$, and the change of $z$ per step."""
        t = as_time(t)

        def log_density(t, y):
            sigma = self.density(self.direction * t, y, args)
            if jnp.shape(sigma) != () or not jnp.isrealobj(sigma):
                raise ValueError(
                    "The density of `StepDensityController` must return a real scalar, "
                    f"but returned {describe(sigma)}. Write for example "
                    "`lambda t, y, args: jnp.linalg.norm(y[0]) ** 1.5`."
                )
            return jnp.log(cast_to(sigma, t))

        slope = self.system.vf(self.direction * t, y, args)
        slope = jax.tree.map(lambda dy: cast_to(self.direction, dy) * dy, slope)
        value, rate = jax.jvp(log_density, (t, y), (jnp.ones_like(t), slope))
        return value, -cast_to(self.epsilon, t) * jnp.exp(value) * rate
