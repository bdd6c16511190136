"""Gradients of arrays that functions hold, wherever they hold them."""

import enum
import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import diffrax_presym as dps


# Where functions may hold what is differentiated.


class _Callable:
    """Not a pytree."""

    def __init__(self, k):
        self.k = k

    def __call__(self, t, q, args):
        return self.k * jnp.sum(q**2) / 2


class _Key(enum.Enum):
    A = 1
    B = 2


class _Bowl(eqx.Module):
    depth: jax.Array

    def __call__(self, t, q, args):
        return self.depth * jnp.sum(q**2) / 2


def _cycle(k):
    ring: list = [k]
    ring.append(ring)
    return lambda t, q, args: ring[1][0] * jnp.sum(q**2) / 2


def _mutual_recursion(k):
    def even(n, x):
        return k * x if n == 0 else odd(n - 1, x)

    def odd(n, x):
        return even(n - 1, x)

    return lambda t, q, args: even(2, jnp.sum(q**2) / 2)


HOLDERS = {
    "closure": lambda k: lambda t, q, args: k * jnp.sum(q**2) / 2,
    "default": lambda k: lambda t, q, args, k=k: k * jnp.sum(q**2) / 2,
    "jit": lambda k: jax.jit(lambda t, q, args: k * jnp.sum(q**2) / 2),
    "checkpoint": lambda k: jax.checkpoint(lambda t, q, args: k * jnp.sum(q**2) / 2),
    "partial": lambda k: functools.partial(lambda k, t, q, a: k * jnp.sum(q**2) / 2, k),
    "nested": lambda k: jax.jit(
        jax.checkpoint(lambda t, q, args: k * jnp.sum(q**2) / 2)
    ),
    "object": _Callable,
    "module": _Bowl,
    "method": lambda k: _Callable(k).__call__,
    "filter_jit": lambda k: eqx.filter_jit(lambda t, q, args: k * jnp.sum(q**2) / 2),
    "enumeration": lambda k: (
        lambda t, q, args, k={_Key.A: k, _Key.B: "x"}: k[_Key.A] * jnp.sum(q**2) / 2
    ),
    "cycle": _cycle,
    "mutual recursion": _mutual_recursion,
}


def _end(k, holder, adjoint, args=None):
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), holder(k), dps.ConstantDamping(0.1)
    )
    y0 = (jnp.array([1.0]), jnp.array([0.0]))
    sol = dfx.diffeqsolve(
        *(system, dps.PresymplecticLeapfrog(), 0.0, 1.0, 0.1, y0, args), adjoint=adjoint
    )
    assert sol.ys is not None
    return jnp.sum(sol.ys[0])


@functools.cache
def _by_checkpoints():
    adjoint = dfx.RecursiveCheckpointAdjoint()
    return jax.value_and_grad(_end)(jnp.asarray(1.3), HOLDERS["closure"], adjoint)


_QUICK = "nested", "cycle", "mutual recursion", "checkpoint"


@pytest.mark.parametrize(
    "holder",
    [
        pytest.param(holder, id=name, marks=() if name in _QUICK else pytest.mark.slow)
        for name, holder in HOLDERS.items()
    ],
)
def test_whatever_holds_an_array(holder):
    own = dps.FixedStepAdjoint()
    by_reversal = jax.value_and_grad(_end)(jnp.asarray(1.3), holder, own)
    np.testing.assert_allclose(by_reversal, _by_checkpoints(), rtol=1e-13)


def test_functions_among_the_arguments():
    of_args = lambda _: lambda t, q, args: args(q)

    def end(k):
        bowl = lambda q: k * jnp.sum(q**2) / 2
        return _end(None, of_args, dps.FixedStepAdjoint(), bowl)

    found = jax.value_and_grad(end)(jnp.asarray(1.3))
    np.testing.assert_allclose(found, _by_checkpoints(), rtol=1e-13)


def test_several_arrays_at_several_depths():
    """An array that is not used has a derivative of zero."""

    def end(x, adjoint):
        a, b, c, d = x
        inner, bowl = lambda q: c * jnp.sum(q**2) / 2, _Bowl(a)

        def potential(t, q, args, *, scale=b):
            return scale * inner(q) + bowl(t, q, args)

        return _end(d, lambda d: functools.partial(potential, scale=d), adjoint)

    x = jnp.array([1.0, 2.0, 0.3, 0.5])
    adjoints = dps.FixedStepAdjoint(), dfx.RecursiveCheckpointAdjoint()
    found, exact = (jax.grad(end)(x, adjoint) for adjoint in adjoints)
    np.testing.assert_allclose(found, exact, rtol=1e-13)
    assert ((found != 0) == jnp.array([True, False, True, True])).all()
