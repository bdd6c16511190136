"""Values of rigid bodies between steps."""

from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
BODY = {"x": dps.Euclidean(2.0), "turn": dps.Attitude(jnp.array([1.0, 2.0, 2.5]))}
START = (
    {"x": jnp.array([0.3, 0.0, -0.5]), "turn": jnp.array([0.8, 0.6, 0.0, 0.0])},
    {"x": jnp.array([0.0, 1.0, 0.2]), "turn": jnp.array([0.2, 1.0, -2.0])},
)
TIMES = jnp.linspace(0.0, 6.0, 38)


def potential(t, q, args):
    axis = dps.rotation_matrix(q["turn"])[:, 2]
    return args * (q["x"] @ q["x"]) + axis @ q["x"] + jnp.cos(t) * axis[2]


FORCES = {
    "rate": {"friction": dps.ConstantDamping(0.1)},
    "force": {"force": lambda t, q, v, args: jtu.tree_map(lambda x: -0.1 * x**3, v)},
}


def solve(name, number=12, args=None, sign=1, **options):
    system = dps.ManifoldSystem(BODY, potential, **FORCES[name])
    end, args = sign * 6.0, jnp.array(1.0) if args is None else args
    solver = dps.BlanesMoan6() if name == "force" else dps.TunedRKN6()
    options = {"saveat": dfx.SaveAt(ts=sign * TIMES)} | options
    options = {"adjoint": dps.FixedStepAdjoint(), "max_steps": None} | options
    sol = diffeqsolve(system, solver, 0.0, end, end / number, START, args, **options)
    return system, sol


@pytest.mark.parametrize("sign", [1, -1], ids=["forwards", "backwards"])
@pytest.mark.parametrize("name", FORCES)
def test_values_are_interpolated_and_on_the_manifold(name, sign):
    system, sol = solve(name, sign=sign)
    assert sol.stats["interpolated"] == len(TIMES)
    # Steps that end at all of these times.
    _, exact = solve(name, 8 * (len(TIMES) - 1), sign=sign)
    pairs = list(zip(jax.tree.leaves(sol.ys), jax.tree.leaves(exact.ys), strict=True))
    at_ends = max(np.max(np.abs(x[-1] - y[-1])) for x, y in pairs)
    assert at_ends > 1e-10
    assert max(np.max(np.abs(x - y)) for x, y in pairs) < 10 * at_ends
    miss = jax.vmap(lambda t, y: system.violation(t, *y))(sol.ts, sol.ys)
    assert np.max(miss) < 1e-14


@pytest.mark.parametrize("name", FORCES)
def test_gradients(name):
    @jax.jit
    def loss(args):
        q, p = solve(name, args=args)[1].ys
        return jnp.sum(q["turn"] ** 3) + jnp.sum(p["turn"] ** 2 + q["x"] * p["x"])

    args, h = jnp.array(1.0), 1e-5
    central = (loss(args + h) - loss(args - h)) / (2 * h)
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(args), central, rtol=1e-7)
