"""Functions that XLA computes slowly."""

from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from helpers import assert_close

import diffrax_presym.math


FUNCTIONS = {
    "sin": (diffrax_presym.math.sin, jnp.sin, mpmath.sin),
    "cos": (diffrax_presym.math.cos, jnp.cos, mpmath.cos),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_to_one_unit_in_the_last_place(name):
    function, _, exact = FUNCTIONS[name]
    rng, quarters = np.random.default_rng(0), np.pi / 2 * np.arange(-40, 40)
    x = [rng.uniform(-size, size, 500) for size in (1e-3, 1, 10, 1e3, 1e6)]
    # The numbers next to the zeros.
    x = np.concatenate([*x, quarters, np.nextafter(quarters, 9), [0.0, 5e-324]])
    with mpmath.workdps(60):
        values: list[Any] = [exact(mpmath.mpf(float(v))) for v in x]
        found = np.asarray(jax.jit(function)(x))
        errors = [
            abs(mpmath.mpf(float(a)) - b) / float(np.spacing(abs(float(b))))
            for a, b in zip(found, values, strict=True)
        ]
    assert max(errors) <= 1
    # Never a wrong number.
    assert jnp.all(jnp.isnan(function(jnp.array([2e6, jnp.inf, jnp.nan]))))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_derivatives_and_other_types(name):
    function, known, _ = FUNCTIONS[name]
    for order in (lambda f: f, jax.grad, lambda f: jax.grad(jax.grad(f))):
        for x in (0.3, -2.0, 40.0):
            assert_close(order(function)(x), order(known)(x), 3e-16)
    single = jnp.array([0.5, 3e8], jnp.float32)
    assert function(single).dtype == jnp.float32
    assert jnp.all(function(single) == known(single))
    tangent = jax.jvp(function, (jnp.ones(3),), (jnp.ones(3),))
    assert_close(tangent, jax.jvp(known, (jnp.ones(3),), (jnp.ones(3),)), 3e-16)
