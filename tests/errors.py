"""Tables of invalid input: what raises, and what its message says."""

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import pytest

import diffrax_presym as dps


PAIR = (jnp.ones(2), jnp.ones(2))


def trace(term, solver, y0=PAIR, dtype=jnp.float64, **options):
    """Trace a solve, without computing it, so errors are raised at trace time."""
    t0, t1, dt0 = (jnp.array(t, dtype) for t in (0.0, 1.0, 0.1))
    run = lambda y0: dfx.diffeqsolve(term, solver, t0, t1, dt0, y0, **options).ys
    eqx.filter_eval_shape(run, y0)


def raising(cases: dict):
    """Parametrise over rows of what raises, what is given, what is expected, and what
    to write instead."""
    rows = [(act, parts) for act, *parts in cases.values()]
    each = pytest.mark.parametrize("act, parts", rows, ids=list(cases))
    # All of them, as they take little time.
    return lambda test: pytest.mark.variants(1000)(each(test))


def check(act, parts):
    with pytest.raises(ValueError) as error:
        act()
    for part in parts:
        assert part in str(error.value)


def mechanics(kinetic=None, potential=None, friction=None, force=None):
    kinetic = dps.QuadraticKinetic() if kinetic is None else kinetic
    harmonic = lambda t, q, args: jnp.sum(q**2) / 2
    potential = harmonic if potential is None else potential
    return dps.MechanicalSystem(kinetic, potential, friction, force=force)


def traced(solver=None, y0=PAIR, **parts):
    """A row's act: trace a solve of a system with invalid parts."""
    solver = dps.BlanesMoan4() if solver is None else solver
    return lambda: trace(mechanics(**parts), solver, y0)
