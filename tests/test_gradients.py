"""Gradients of a solve with respect to all its inputs."""

from collections.abc import Callable

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import pytest
from helpers import each, flat, IMPLICIT, Scheme, SCHEMES

import diffrax_presym as dps


class Learned(eqx.Module):
    """A potential with a neural network inside."""

    network: eqx.nn.MLP

    def __init__(self):
        # A final bias would be a constant of the potential, without effect.
        self.network = eqx.nn.MLP(
            *(2, "scalar", 4, 1),
            activation=jnp.tanh,
            use_final_bias=False,
            key=jax.random.key(0),
        )

    def __call__(self, t, q, args):
        return self.network(q) + args["stiffness"] * jnp.sum(q**2) / 2


class Entangled(eqx.Module):
    """A nonseparable energy that contains the same network."""

    mass: jax.Array
    potential: Callable

    def __call__(self, t, q, p, args):
        kinetic = (1 + jnp.sum(q**2)) * jnp.sum(p**2) / self.mass / 2
        return kinetic + self.potential(t, q, args)


# Python numbers would give arrays of weak type, whose change of type in a finite
# difference causes a recompilation.
MASS, GAMMA, SHIFT, STIFFNESS = map(np.float64, (1.3, 0.4, 1.0, 0.8))
SEPARABLE = dps.ConformalHamiltonian(
    dps.QuadraticKinetic(MASS), Learned(), dps.ConstantDamping(GAMMA)
)
NONSEPARABLE = dps.ConformalHamiltonian(
    energy=Entangled(jnp.asarray(MASS), Learned()),
    damping=dps.LogDamping(GAMMA, shift=SHIFT),
)
Y0 = (jnp.array([0.5, -0.3]), jnp.array([0.2, 0.4]))
ARGS = {"stiffness": jnp.asarray(STIFFNESS)}


def loss(inputs, solver, adjoint, saveat=None):
    hamiltonian, y0, args = inputs
    sol = dfx.diffeqsolve(
        dps.HamiltonianTerm(hamiltonian),
        solver,
        t0=0.0,
        t1=1.0,
        dt0=0.125,
        y0=y0,
        args=args,
        saveat=dfx.SaveAt(t1=True) if saveat is None else saveat,
        adjoint=adjoint,
        max_steps=16,
    )
    assert sol.ys is not None
    q, p = sol.ys
    return jnp.sum(q**2) + jnp.sum(jnp.sin(p))


FORWARD = dfx.ForwardMode()
value_and_gradient = eqx.filter_jit(eqx.filter_value_and_grad(loss))


@eqx.filter_jit
def along(inputs, direction, solver, saveat):
    """The directional derivative, in forward mode."""
    arrays, rest = eqx.partition(inputs, eqx.is_inexact_array)
    fn = lambda arrays: loss(eqx.combine(arrays, rest), solver, FORWARD, saveat)
    return jax.jvp(fn, (arrays,), (direction,))[1]


def directions(inputs):
    """One random direction for each differentiable leaf."""
    leaves, structure = jtu.tree_flatten(eqx.filter(inputs, eqx.is_inexact_array))
    random = np.random.default_rng(0)
    for i, leaf in enumerate(leaves):
        zeros = [jnp.zeros_like(leaf) for leaf in leaves]
        zeros[i] = jnp.array(random.normal(size=leaf.shape), leaf.dtype)
        yield jtu.tree_unflatten(structure, zeros)


def check(hamiltonian, solver, adjoint, saveat=None, vanishing=0):
    inputs = (hamiltonian, Y0, ARGS)

    def reverse(inputs):
        value, gradient = value_and_gradient(inputs, solver, adjoint, saveat)
        return value, flat(eqx.filter(gradient, eqx.is_array))

    def moved(direction, e):
        step = jtu.tree_map(lambda d: e * d, direction)
        return reverse(eqx.apply_updates(inputs, step))[0]

    _, gradient = reverse(inputs)
    # Forward mode would not detect a `stop_gradient`.
    assert np.sum(gradient == 0) == vanishing
    for direction in directions(inputs):
        slope = gradient @ flat(direction)
        differences = (moved(direction, 1e-5) - moved(direction, -1e-5)) / 2e-5
        assert abs(slope - differences) < 1e-6
        assert abs(slope - along(inputs, direction, solver, saveat)) < 1e-10


def test_every_parameter_is_differentiated():
    # q, p, gamma, mass, args, and two weights and a bias of the network.
    for hamiltonian in (SEPARABLE, NONSEPARABLE):
        leaves = jtu.tree_leaves(eqx.filter((hamiltonian, Y0, ARGS), eqx.is_array))
        shift = hamiltonian is NONSEPARABLE
        assert len(leaves) == 8 + shift


def named(schemes, *names):
    return [scheme for scheme in schemes if scheme.name in names]


CHECKPOINTED = dfx.RecursiveCheckpointAdjoint()


# Compiling a gradient takes seconds, so one scheme of each kind is tested: without a
# solver state, with a force and a loop over stages, with a copy.


@each(named(SCHEMES, "euler_B", "suzuki_yoshida_4", "tao"))
def test_gradients(scheme: Scheme):
    check(SEPARABLE, scheme.solver, CHECKPOINTED)


def test_gradients_of_dense_output():
    saveat = dfx.SaveAt(ts=jnp.array([0.55, 1.0]))
    check(SEPARABLE, dps.PresymplecticLeapfrog(), CHECKPOINTED, saveat)


@pytest.mark.slow
@each([*named(IMPLICIT, "euler_A"), *named(SCHEMES, "tao")])
def test_gradients_of_nonseparable_systems(scheme: Scheme):
    check(NONSEPARABLE, scheme.solver, CHECKPOINTED)


@pytest.mark.slow
def test_gradients_by_the_direct_adjoint():
    (scheme,) = named(IMPLICIT, "leapfrog_AB")
    check(NONSEPARABLE, scheme.solver, dfx.DirectAdjoint())


@pytest.mark.parametrize("law", [dps.ConstantDamping, dps.LogDamping])
def test_gradients_without_damping(law):
    # The gradient with respect to gamma at zero is the limit, and not NaN.
    hamiltonian = dps.ConformalHamiltonian(
        dps.QuadraticKinetic(MASS),
        Learned(),
        law(0 * GAMMA) if law is dps.ConstantDamping else law(0 * GAMMA, shift=SHIFT),
    )
    # The shift of time has no effect in this case.
    vanishing = 1 if law is dps.LogDamping else 0
    check(hamiltonian, dps.PresymplecticLeapfrog(), CHECKPOINTED, vanishing=vanishing)
