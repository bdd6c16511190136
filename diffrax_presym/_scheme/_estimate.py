import equinox as eqx
import jax.tree_util as jtu
from jaxtyping import PyTree


class NoErrorEstimate(eqx.Module):
    """The error estimate of a scheme that has none.

    A controller divides estimates by the tolerance, and gets a helpful error. It has no
    leaves, so that everything else treats it as the `None` of Diffrax.
    """

    def __truediv__(self, tolerance):
        raise ValueError(
            "Presymplectic solvers have no error estimate, which the step size "
            "controller needs. For a solution to a tolerance, choose a constant step: "
            "`dt0=choose_step(term, solver, t0, t1, y0, rtol=..., atol=...).dt0`, "
            "without a controller. For adaptive steps, at the price of the long-time "
            "behaviour, write `diffrax.HalfSolver(solver)`."
        )


def no_error_estimate(y: PyTree) -> PyTree:
    """One for each leaf of the state."""
    return jtu.tree_map(lambda _: NoErrorEstimate(), y)
