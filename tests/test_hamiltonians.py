"""Hamiltonians agree with their formulas: derivatives, momenta, vector fields."""

from decimal import Decimal, localcontext
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import lineax as lx
import numpy as np
import pytest
import scipy.integrate
from helpers import assert_close, drift, flat, henon_heiles, mixed_energy, solve

import diffrax_presym as dps


T, Q, P = jnp.array(1.3), jnp.array([0.3, -0.7]), jnp.array([0.9, 0.4])
MASS = jnp.array([[2.0, 0.3], [0.3, 1.0]])
ARGS = jnp.array(1.7)


def potential(t, q, args):
    return args * (1 + jnp.sin(t) / 4) * henon_heiles(t, q, None)


def kinetic(t, p, args):
    return args * jnp.sum(p**4) / 4 + jnp.cos(t) * p[0] * p[1]


def energy(t, q, p, args):
    return args * (1 + jnp.sin(t) / 4) * mixed_energy(t, q, p, None)


def canonical_kinetic(t, q, P, args):
    return args * (1 + q[0] ** 2) * jnp.sum(P**2) / 2 + jnp.sin(t) * q[1] * P[0]


def eta1(t):
    return jnp.log(t + 0.5)


LOG, CONSTANT = dps.LogDamping(3.0, shift=0.5), dps.ConstantDamping(0.7)
QUADRATIC, RELATIVISTIC = dps.QuadraticKinetic(MASS), dps.RelativisticKinetic(1.5, 2.0)


# Hamiltonian, and H(t, q, P) as in the paper.


def quadratic(P):
    return P @ jnp.linalg.solve(MASS, P) / 2


def relativistic(P):
    return 2.0 * jnp.sqrt(P @ P + 3.0**2)


def conformal(T, eta):
    """Equation (new_ham_time)."""
    return lambda t, q, P: (
        jnp.exp(eta(t)) * (T(t, jnp.exp(-eta(t)) * P) + potential(t, q, ARGS))
    )


def dissipative(T, eta1, eta2):
    """Equation (gen_ham)."""
    return lambda t, q, P: (
        jnp.exp(-eta1(t)) * T(t, q, P) + jnp.exp(eta2(t)) * potential(t, q, ARGS)
    )


def log(t):
    return 3 * jnp.log(t + 0.5)


def constant(t):
    return 0.7 * t


def dissipative_energy(t, q, p, args):
    kinetic = canonical_kinetic(t, q, jnp.exp(constant(t)) * p, args)
    return jnp.exp(-log(t) - constant(t)) * kinetic + potential(t, q, args)


HAMILTONIANS = {
    "separable, quadratic T": (
        dps.MechanicalSystem(QUADRATIC, potential),
        lambda t, q, P: quadratic(P) + potential(t, q, ARGS),
    ),
    "separable, relativistic T": (
        dps.MechanicalSystem(RELATIVISTIC, potential),
        lambda t, q, P: relativistic(P) + potential(t, q, ARGS),
    ),
    "separable, any T": (
        dps.MechanicalSystem(kinetic, potential),
        lambda t, q, P: kinetic(t, P, ARGS) + potential(t, q, ARGS),
    ),
    "nonseparable": (dps.Hamiltonian(energy), lambda t, q, P: energy(t, q, P, ARGS)),
    "conformal, undamped": (
        dps.MechanicalSystem(QUADRATIC, potential),
        lambda t, q, P: quadratic(P) + potential(t, q, ARGS),
    ),
    "conformal, quadratic T": (
        dps.MechanicalSystem(QUADRATIC, potential, LOG),
        conformal(lambda t, p: quadratic(p), log),
    ),
    "conformal, relativistic T": (
        dps.MechanicalSystem(RELATIVISTIC, potential, CONSTANT),
        conformal(lambda t, p: relativistic(p), constant),
    ),
    "conformal, any T": (
        dps.MechanicalSystem(kinetic, potential, eta1),
        conformal(lambda t, p: kinetic(t, p, ARGS), eta1),
    ),
    "conformal, nonseparable": (
        dps.Hamiltonian(energy, LOG),
        lambda t, q, P: jnp.exp(log(t)) * energy(t, q, jnp.exp(-log(t)) * P, ARGS),
    ),
    "dissipative, quadratic T": (
        dps.DissipativeHamiltonian(QUADRATIC, potential, eta1, LOG),
        dissipative(lambda t, q, P: quadratic(P), eta1, log),
    ),
    "dissipative, relativistic T": (
        dps.DissipativeHamiltonian(RELATIVISTIC, potential, eta1, CONSTANT),
        dissipative(lambda t, q, P: relativistic(P), eta1, constant),
    ),
    "dissipative, any T": (
        dps.DissipativeHamiltonian(kinetic, potential, LOG, CONSTANT),
        dissipative(lambda t, q, P: kinetic(t, P, ARGS), log, constant),
    ),
    "dissipative, nonseparable": (
        dps.Hamiltonian(dissipative_energy, CONSTANT),
        dissipative(lambda t, q, P: canonical_kinetic(t, q, P, ARGS), log, constant),
    ),
}
each = pytest.mark.parametrize(
    "hamiltonian, H", HAMILTONIANS.values(), ids=HAMILTONIANS
)


def differences(fn, x, step=1e-5):
    """The gradient by central differences."""
    x = np.asarray(x)
    units = step * np.eye(x.size)
    return np.array([float(fn(x + e) - fn(x - e)) / (2 * step) for e in units])


@each
def test_velocity_and_force_are_derivatives_of_the_energy(hamiltonian, H):
    value = jax.jit(lambda q, p: hamiltonian.energy(T, q, p, ARGS))
    velocity = hamiltonian.velocity(T, Q, P, ARGS)
    force = hamiltonian.force(T, Q, P, ARGS)
    np.testing.assert_allclose(velocity, differences(lambda p: value(Q, p), P), 1e-8)
    np.testing.assert_allclose(force, -differences(lambda q: value(q, P), Q), 1e-8)


@each
def test_canonical_is_the_hamiltonian_of_the_paper(hamiltonian, H):
    canonical = hamiltonian.to_canonical(T, P)
    scale = jnp.exp(hamiltonian.log_scale(T))
    assert_close(canonical, scale * P, 1e-15)
    assert_close(hamiltonian.from_canonical(T, canonical), P, 1e-15)
    value = H(T, Q, canonical)
    assert_close(hamiltonian.canonical(T, Q, P, ARGS), value, 1e-14)
    assert_close(scale * hamiltonian.energy(T, Q, P, ARGS), value, 1e-14)


@each
def test_vector_field_is_hamilton_s_equations(hamiltonian, H):
    canonical = hamiltonian.to_canonical(T, P)
    dq, dP = jax.grad(H, 2)(T, Q, canonical), -jax.grad(H, 1)(T, Q, canonical)
    # Including the time dependence of the momentum transformation.
    _, dp = jax.jvp(hamiltonian.from_canonical, (T, canonical), (jnp.ones_like(T), dP))
    field = hamiltonian.vf(T, (Q, P), ARGS)
    assert_close(field, (dq, dp), 1e-13)


def test_equal_damping_is_conformal():
    one = dps.DissipativeHamiltonian(QUADRATIC, potential, LOG, LOG)
    two = dps.MechanicalSystem(QUADRATIC, potential, LOG)
    for name in ("energy", "canonical", "velocity", "force"):
        first, second = (getattr(h, name)(T, Q, P, ARGS) for h in (one, two))
        assert_close(first, second, 1e-15)


VELOCITIES = "separable, quadratic T", "separable, relativistic T", "nonseparable"


@pytest.mark.variants(1)
@pytest.mark.parametrize("name", [*VELOCITIES, "dissipative, quadratic T"])
def test_states_by_velocities(name):
    system, _ = HAMILTONIANS[name]
    q, v = system.to_velocity(T, (Q, P), ARGS)
    assert_close((q, v), (Q, system.velocity(T, Q, P, ARGS)), 0)
    state = eqx.filter_jit(system.from_velocity)(T, (q, v), ARGS)
    assert_close(state, (Q, P), 1e-13)
    saveat = dfx.SaveAt(t0=True, fn=system.to_velocity)
    sol = solve(system, dfx.Tsit5(), T, T + 0.1, 0.1, state, ARGS, saveat=saveat)
    assert_close(jax.tree.map(lambda x: x[0], sol.ys), (Q, v), 1e-13)


# Masses of all forms.

P2 = jnp.array([[0.3, -0.2, 1.0], [0.5, 0.1, -0.4]])
TREE = {"a": P, "b": (jnp.array(0.5), P2)}
MATRIX = jnp.array([[2.0, -0.5, 0.0], [-0.5, 1.0, 0.1], [0.0, 0.1, 3.0]])
MASSES = {
    "none": (None, P, P),
    "none, array of rank two": (None, P2, P2),
    "number": (2.0, P2, P2 / 2),
    "integer": (2, TREE, jtu.tree_map(lambda x: x / 2, TREE)),
    "each degree of freedom": (jnp.array([2.0, 5.0]), P, P / np.array([2.0, 5.0])),
    "each particle": (
        jnp.array([[2.0], [5.0]]),
        P2,
        P2 / np.array([[2.0, 2.0, 2.0], [5.0, 5.0, 5.0]]),
    ),
    "each direction": (
        jnp.array([[2.0, 3.0, 4.0]]),
        P2,
        P2 / np.array([[2.0, 3.0, 4.0], [2.0, 3.0, 4.0]]),
    ),
    "matrix": (MASS, P, np.linalg.solve(MASS, P)),
    "symmetric to rounding": (
        MASS.at[0, 1].multiply(1 + 1e-15),
        P,
        np.linalg.solve(MASS, P),
    ),
    "each vector a matrix": (
        jnp.stack([MATRIX, 2 * MATRIX]),
        P2,
        np.linalg.solve(MATRIX, P2.T).T / np.array([[1.0], [2.0]]),
    ),
    "square, each entry": (
        jnp.array([[2.0, 3.0], [5.0, 7.0]]),
        P2[:, :2],
        P2[:, :2] / np.array([[2.0, 3.0], [5.0, 7.0]]),
    ),
    "operator": (
        lx.MatrixLinearOperator(MASS, lx.positive_semidefinite_tag),
        P,
        np.linalg.solve(MASS, P),
    ),
    "pytree": (
        {"a": MASS, "b": (4.0, jnp.array([[2.0], [5.0]]))},
        TREE,
        {
            "a": jnp.linalg.solve(MASS, P),
            "b": (jnp.array(0.125), P2 / np.array([[2.0] * 3, [5.0] * 3])),
        },
    ),
}


@pytest.mark.parametrize("mass, p, expected", MASSES.values(), ids=MASSES)
def test_masses(mass, p, expected):
    kinetic = dps.QuadraticKinetic(mass)
    velocity = kinetic.velocity(T, p)
    assert jtu.tree_structure(velocity) == jtu.tree_structure(p)
    assert_close(velocity, jtu.tree_map(jnp.asarray, expected), 1e-15)
    assert_close(kinetic(T, p), flat(p) @ flat(expected) / 2, 1e-15)
    assert_close(velocity, jax.grad(kinetic, 1)(T, p), 1e-14)


@pytest.mark.parametrize("name", ["velocity", "function"])
def test_negative_effective_masses_have_a_way(name):
    # A synchrotron above transition: phi'' = -omega^2 sin(phi) about phi = 0, of
    # T = -p^2 / 2 m and the potential of the opposite sign, with friction.
    m, gamma = 2.0, 0.3
    top = lambda t, q, args: jnp.sum(jnp.cos(q))
    well = lambda t, q, args: -jnp.sum(jnp.cos(q))
    if name == "function":
        kinetic = lambda t, p, args: -jnp.sum(p**2) / (2 * m)
        system, sign = (
            dps.MechanicalSystem(kinetic, top, dps.ConstantDamping(gamma)),
            -1,
        )
    else:
        law = dps.ViscousDamping(gamma * m)  # of the mass -m it would be -gamma * m
        system, sign = dps.MechanicalSystem(dps.QuadraticKinetic(m), well, law), 1
    y0 = jnp.array([0.5]), jnp.array([sign * m * 0.2])
    ys: Any = solve(system, dps.BlanesMoan6(), 0.0, 10.0, 0.05, y0).ys
    rates = lambda t, y: [y[1], -np.sin(y[0]) / m - gamma * y[1]]
    exact = scipy.integrate.solve_ivp(
        rates, (0, 10), [0.5, 0.2], rtol=1e-12, atol=1e-12
    ).y[:, -1]
    end = jax.tree.map(lambda x: x[-1], ys)
    assert_close(end, (exact[:1], sign * m * exact[1:]), 1e-8)


ANY = dps.MechanicalSystem(kinetic, potential).kinetic


@pytest.mark.parametrize(
    "kinetic", [QUADRATIC, RELATIVISTIC, ANY], ids=["quadratic", "relativistic", "any"]
)
def test_rescaled_kinetic_energies(kinetic):
    s = jnp.array(0.8)
    rescaled = kinetic.rescale(s)
    assert_close(
        rescaled(T, P, ARGS), jnp.exp(-2 * s) * kinetic(T, jnp.exp(s) * P, ARGS), 1e-14
    )
    assert_close(
        rescaled.velocity(T, P, ARGS),
        jnp.exp(-s) * kinetic.velocity(T, jnp.exp(s) * P, ARGS),
        1e-14,
    )


def test_a_long_damped_frame_does_not_overflow():
    late = jnp.array(1e4, jnp.float32)
    q, p = Q.astype(jnp.float32), P.astype(jnp.float32)
    args = ARGS.astype(jnp.float32)
    for kinetic in (QUADRATIC, RELATIVISTIC):
        system = dps.DissipativeHamiltonian(kinetic, potential, CONSTANT, CONSTANT)
        field = system.vf(late, (q, p), args)
        assert np.all(np.isfinite(flat(field)))


# Damping laws.

# Law, and eta(t) to fifty digits
LAWS = {
    "constant": (CONSTANT, lambda t: Decimal("0.7") * t),
    "negative": (dps.ConstantDamping(-0.7), lambda t: Decimal("-0.7") * t),
    "logarithmic": (dps.LogDamping(3.0), lambda t: 3 * t.ln()),
    "shifted": (LOG, lambda t: 3 * (t + Decimal("0.5")).ln()),
}
laws = pytest.mark.parametrize("law, eta", LAWS.values(), ids=LAWS)


@laws
@pytest.mark.parametrize("h", [0.25, -0.25, 2.0**-10])
@pytest.mark.parametrize(
    "dtype, tolerance", [(jnp.float32, 1e-6), (jnp.float64, 1e-14)]
)
def test_increments_are_exact_at_late_times(law, eta, h, dtype, tolerance):
    # In `float32` a difference of two values of eta would have no correct digit.
    t, h = jnp.array(1e4, dtype), jnp.array(h, dtype)
    increment = law.increment(t, h)
    assert increment.dtype == dtype
    t, h = Decimal(float(t)), Decimal(float(h))
    with localcontext() as context:
        context.prec = 50
        expected = float(eta(t + h) - eta(t))
    np.testing.assert_allclose(increment, expected, tolerance)


def test_no_damping_is_the_limit_of_little_damping():
    y = (Q, P)
    field = lambda damping: dps.MechanicalSystem(QUADRATIC, potential, damping).vf(
        T, y, ARGS
    )
    for law in (dps.ConstantDamping, dps.LogDamping):
        assert_close(field(law(0.0)), field(None), 1e-16)
        assert_close(field(law(1e-10)), field(None), 1e-9)


@pytest.mark.variants(1)
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_a_relativistic_drift_through_friction_that_stops_it(dtype):
    p = jnp.array([0.3, -0.4], dtype)

    def moved(gamma):
        damping = dps.ConstantDamping(gamma)
        system = dps.MechanicalSystem(RELATIVISTIC, potential, damping)
        start = jnp.zeros((), dtype)
        q, _ = drift(system, start, jnp.ones((), dtype), jnp.zeros_like(p), p)
        return q

    # The momentum decays before the first quadrature node.
    gamma = jnp.array(1e4, dtype)
    np.testing.assert_allclose(moved(gamma), 0.0, atol=1e-15)
    np.testing.assert_allclose(jax.jacrev(moved)(gamma), 0.0, atol=1e-15)
    # Against the closed form, if there are enough nodes.
    mass, speed = float(RELATIVISTIC.mass), float(RELATIVISTIC.speed)
    sizes = 0.5 * np.array([1, np.exp(-0.5)]) / (mass * speed)
    travelled = speed / 0.5 * -np.diff(np.arcsinh(sizes))
    exact = travelled * np.asarray(p) / 0.5
    gamma = jnp.array(0.5, dtype)
    np.testing.assert_allclose(moved(gamma), exact, rtol=1e-6)


# Masses that are missing, or of the wrong shape.


def test_massless_test_particles_have_a_way():
    with pytest.raises(ValueError, match=r"massless test particles.*ForceField"):
        dps.QuadraticKinetic(jnp.array([1.0, 0.0]))


def test_a_euclidean_mirror_takes_masses_as_kinetic_energies_do():
    mass, q = jnp.array([1.0, 2.0]), jnp.ones((2, 3))
    with jax.numpy_rank_promotion("allow"):
        for fn in (dps.EuclideanMirror(mass).gradient, dps.EuclideanMirror(mass)):
            with pytest.raises(ValueError, match="does not fit"):
                fn(q[:, :2])


@pytest.mark.slow
def test_pairwise_potential():
    masses, q = jnp.array([1.0, 2.0, 0.5, 3.0]), jnp.arange(12.0).reshape(4, 3) ** 1.3
    i, j = np.triu_indices(4, 1)

    def by_index(t, q, args):
        r = jnp.sqrt(jnp.sum((q[i] - q[j]) ** 2, axis=1))
        return args * jnp.sum(masses[i] * masses[j] * (1 + t) / r**2)

    fn = lambda t, r, args: args * (1 + t) / r**2
    potential = dps.pairwise_potential(fn, masses)
    args = jnp.array(0.3), q, jnp.array(2.0)
    for order in (lambda f: f, lambda f: jax.grad(f, argnums=(0, 1, 2))):
        assert_close(order(potential)(*args), order(by_index)(*args), 1e-14)
    second = lambda f: jax.hessian(f, argnums=1)(*args)
    assert_close(second(potential), second(by_index), 1e-13)
    # Its force has no scattered additions, which are slow.
    assert "scatter" not in str(jax.make_jaxpr(jax.grad(potential, argnums=1))(*args))
    unit = dps.pairwise_potential(fn)
    distances = jnp.linalg.norm(q[i] - q[j], axis=1)
    assert_close(unit(*args), jnp.sum(fn(0.3, distances, 2.0)), 1e-14)
    with pytest.raises(ValueError, match=r"fn\(t, r, args\)"):
        dps.pairwise_potential(3.0)  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="4 particles"):
        dps.pairwise_potential(fn, masses[:3])(*args)
    for wrong in (q[0], {"a": q}, [[0.0, 1.0]], 1.0):
        with pytest.raises(ValueError, match="one array"):
            potential(0.0, wrong, 1.0)


def test_numpy_states():
    gravity = dps.pairwise_potential(lambda t, r, args: -1 / r)
    system = dps.MechanicalSystem(dps.QuadraticKinetic(), gravity, lambda t: 0.1 * t)
    q, p = np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([[0.0, 1.0], [0.0, 0.0]])
    assert_close(system.energy(0.0, q, p), 0.0, 1e-15)
    force = np.array([[0.25, 0.0], [-0.25, 0.0]])
    assert_close(system.force(0.0, q, p), force, 1e-15)
    assert_close(system.vf(0.0, (q, p), None), (p, force - 0.1 * p), 1e-15)


@pytest.mark.parametrize("box", [2.0, np.array([2.0, 3.0])])
def test_pairs_in_a_periodic_box(box):
    q = np.array([[0.1, 0.2], [1.9, 2.9], [1.2, 1.3], [-3.2, 7.45]])
    potential = dps.pairwise_potential(lambda t, r, args: jnp.exp(-(r**2)), box=box)
    cells = np.array([[i, j] for i in range(-6, 7) for j in range(-6, 7)]) * box

    def nearest(q):
        pairs = [q[i] - q[j] for i in range(4) for j in range(i)]
        squares = [min(np.sum((d + cells) ** 2, axis=1)) for d in pairs]
        return np.sum(np.exp(-np.array(squares)))

    assert_close(potential(0.0, jnp.asarray(q), None), nearest(q), 1e-14)
    force = jax.grad(lambda q: potential(0.0, q, None))(jnp.asarray(q))
    wanted = differences(lambda x: nearest(x.reshape(4, 2)), q.ravel())
    assert_close(force, jnp.asarray(wanted.reshape(4, 2)), 1e-9)
    for moved in (q + 0.77, q + cells[30], q - cells[7] * np.arange(4)[:, None]):
        assert_close(potential(0.0, jnp.asarray(moved), None), nearest(q), 1e-14)
