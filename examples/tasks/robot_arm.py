"""An arm with two joints and a mass matrix M(q): a network as its motor, trained to
bring it to rest upright."""

from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from scipy.integrate import solve_ivp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)


def mass_matrix(t, q, args):
    c = jnp.cos(q[0] - q[1])
    return jnp.array([[2.0, c], [c, 1.0]])


def potential(t, q, args):
    return 2 * jnp.cos(q[0]) + jnp.cos(q[1])  # angles from upright


def motor(t, q, v, network):
    return network(jnp.concatenate([q, v]))


arm = dps.LagrangianSystem(
    mass_matrix, potential, friction=dps.ViscousDamping(0.1), force=motor
)
q0, v0 = jnp.array([0.5, -0.3]), jnp.zeros(2)
ts = jnp.linspace(0.0, 5.0, 21)


def solve(network, adjoint) -> Any:
    return dfx.diffeqsolve(
        *(arm, dps.PresymplecticGauss(2), 0.0, 5.0, 0.1),
        arm.from_velocity(0.0, (q0, v0)),
        args=network,
        saveat=dfx.SaveAt(ts=ts, fn=arm.to_velocity),
        adjoint=adjoint,
    ).ys


@eqx.filter_value_and_grad
def loss(network):
    q, v = solve(network, dps.FixedStepAdjoint())
    return jnp.mean(q**2 + v**2)


network = eqx.nn.MLP(4, 2, 16, 1, jnp.tanh, key=jax.random.key(0))
optimiser = optax.adam(0.02)


@eqx.filter_jit
def update(network, state):
    value, gradient = loss(network)
    changes, state = optimiser.update(gradient, state)
    return eqx.apply_updates(network, changes), state, value, gradient


values, state = [], optimiser.init(eqx.filter(network, eqx.is_array))
for _ in range(120):
    network, state, value, gradient = update(network, state)
    values.append(value)
print(f"loss {values[0]:.3f} before and {values[-1]:.3f} after 120 updates")
assert values[-1] < 0.2 * values[0]

# One entry of the gradient by central differences, and the path by SciPy.
value, gradient = loss(network)
bias = lambda network: network.layers[-1].bias
move = lambda s: eqx.tree_at(bias, network, bias(network) + s * jnp.array([1e-5, 0.0]))
difference = (loss(move(1))[0] - loss(move(-1))[0]) / 2e-5
assert abs(bias(gradient)[0] - difference) < 1e-7
(W, b), (U, c) = ((np.asarray(x.weight), np.asarray(x.bias)) for x in network.layers)


def field(t, y):
    q, v = np.split(y, 2)
    c12, s12 = np.cos(q[0] - q[1]), np.sin(q[0] - q[1])
    force = U @ np.tanh(W @ y + b) + c - 0.1 * v + np.array([2.0, 1.0]) * np.sin(q)
    force += s12 * np.array([-(v[1] ** 2), v[0] ** 2])
    return np.concatenate([v, np.linalg.solve([[2.0, c12], [c12, 1.0]], force)])


start = np.concatenate([q0, v0])
exact = solve_ivp(field, (0, 5), start, "DOP853", ts, rtol=1e-12, atol=1e-12).y.T
found = np.hstack(solve(network, dps.FixedStepAdjoint()))
error = np.max(np.abs(found - exact))
print(f"largest error of the path {error:.1e}")
assert error < 1e-4
