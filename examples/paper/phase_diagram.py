"""Convergence on a random quadratic function, over friction and step size.

One solve for each point of the (gamma, h) plane, batched by `vmap`, and the theoretical
stability limits.
"""

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import diffrax_presym as dps
from examples.paper._common import Nesterov, parser, report


# Trace and determinant of the map of one step, for one mode,
# q'' = -lambda q - gamma q'. `s` is h^2 lambda.


def euler_momentum(gamma, h, s):
    m = np.exp(-gamma * h)
    return 1 + m - s, m


def euler_position(gamma, h, s):
    m = np.exp(-gamma * h)
    return 1 + m - m * s, m


def leapfrog(gamma, h, s):
    m = np.exp(-gamma * h)
    return (1 + m) * (1 - s / 2), m


def nesterov(gamma, h, s):
    m = np.exp(-gamma * h)
    return (1 - s) * (1 + m), (1 - s) * m


def yoshida(gamma, h, s):
    """The product of three leapfrog steps, in units in which lambda is one."""
    kappa = 2 ** (1 / 3)
    taus = np.array([1, -kappa, 1]) / (2 - kappa)
    # A mode depends only on gamma / sqrt(lambda) and h sqrt(lambda).
    steps = np.sqrt(s)
    product = np.eye(2)
    for tau in taus:
        x, mu = tau * steps, np.exp(-gamma * h * tau / 2)
        one, zero = np.ones_like(x), np.zeros_like(x)
        kick = _matrix(one, zero, -x / 2, one)
        frame = _matrix(one, zero, zero, mu * one)
        drift = _matrix(one, x * (mu + 1 / mu) / 2, zero, one)
        product = kick @ frame @ drift @ frame @ kick @ product
    return np.trace(product, axis1=-2, axis2=-1), np.exp(-gamma * h)


def _matrix(a, b, c, d):
    return np.stack([np.stack([a, b], -1), np.stack([c, d], -1)], -2)


METHODS = {
    "leapfrog": (dps.PresymplecticLeapfrog(), leapfrog),
    "Nesterov": (Nesterov(), nesterov),
    "Suzuki-Yoshida 4": (dps.SuzukiYoshida(4), yoshida),
    "Euler, momentum first (heavy ball)": (dps.PresymplecticEuler(), euler_momentum),
    "Euler, position first": (dps.PresymplecticEuler("position"), euler_position),
}


# The statements of the paper on its two panels.
AREA = {"leapfrog": "the wider area", "Nesterov": "the narrower area"}
AT_ZERO = {"Nesterov": "converges for some h, by numerical damping"}
LIMIT = {"leapfrog": "no value", "Nesterov": "does not depend on gamma (its figure)"}


def excess(method, gamma, h, eigenvalues):
    """The largest violation of Jury's conditions; negative if stable."""
    gamma, h = np.asarray(gamma)[..., None], np.asarray(h)[..., None]
    trace, det = method(gamma, h, h**2 * eigenvalues)
    return np.max(np.maximum(np.abs(trace) - 1 - det, np.abs(det) - 1), axis=-1)


def largest_step(method, gamma, eigenvalues):
    """The largest step size up to which all are stable, to four digits."""
    hs = np.arange(1, 20001) * 1e-4
    unstable = excess(method, gamma, hs, eigenvalues) > 1e-9
    return hs[np.argmax(unstable)] if unstable.any() else np.inf


def modes(key, rows, n):
    """Eigenvalues of M = A^T A / n, and q0 = (1, ..., 1) among its eigenvectors.

    The methods and the norm of the gradient do not depend on the choice of orthogonal
    coordinates. In these, a gradient takes `n` multiplications, not `n^2`.
    """
    A = jax.random.normal(key, (rows, n))
    eigenvalues, vectors = jnp.linalg.eigh(A.T @ A / n)
    return jnp.maximum(eigenvalues, 0), jnp.sum(vectors, axis=0)


def potential(t, q, eigenvalues):
    return jnp.sum(eigenvalues * q**2) / 2


def force(t, q, eigenvalues):
    return -eigenvalues * q


def converged(t, y, args, **kwargs):
    return jnp.linalg.norm(force(t, y[0], args)) < 1e-3


@eqx.filter_jit
def final_gradients(solver, gammas, hs, eigenvalues, q0, iterations=800):
    """The final norm of the gradient, for each gamma (rows) and h (columns)."""

    def final_gradient(gamma, h):
        hamiltonian = dps.MechanicalSystem(
            dps.QuadraticKinetic(), potential, dps.ConstantDamping(gamma)
        )
        sol = dfx.diffeqsolve(
            hamiltonian,
            solver,
            t0=0.0,
            t1=iterations * h,
            dt0=h,
            y0=(q0, jnp.zeros_like(q0)),
            args=eigenvalues,
            event=dfx.Event(converged),
            max_steps=None,
            throw=False,  # unstable solves overflow
        )
        assert sol.ys is not None
        return jnp.linalg.norm(force(0.0, sol.ys[0][-1], eigenvalues))

    over_hs = jax.vmap(final_gradient, in_axes=(None, 0))
    return jax.vmap(over_hs, in_axes=(0, None))(gammas, hs)


def main():
    options = parser(__doc__).parse_args()
    n, points = (100, 10) if options.quick else (1000, 50)
    # As in the authors' script: A has n / 0.8 rows. The text says 0.8 n.
    eigenvalues, q0 = modes(jax.random.key(0), round(n / 0.8), n)
    spectrum = np.asarray(eigenvalues)
    eigenvalues, q0 = (x.astype(jnp.float32) for x in (eigenvalues, q0))
    gammas, hs = jnp.linspace(0, 5, points), jnp.linspace(0.01, 1.1, points)
    fig, axes = plt.subplots(
        2, 3, figsize=(11, 6.5), sharex=True, sharey=True, layout="constrained"
    )
    fine = np.meshgrid(np.linspace(0, 5, 101), np.linspace(0.01, 1.1, 201))
    # A subset of the modes, including the extreme ones, which determine stability.
    some = spectrum[np.linspace(0, n - 1, 50).astype(int)]
    rows, image = [], None
    for ax, (name, (solver, method)) in zip(axes.flat, METHODS.items(), strict=False):
        norms = np.asarray(final_gradients(solver, gammas, hs, eigenvalues, q0))
        norms = np.nan_to_num(norms, nan=np.inf)
        image = ax.pcolormesh(
            hs, gammas, norms.clip(1e-3, 1), norm="log", cmap="magma_r", vmax=1
        )
        ax.contour(*fine[::-1], excess(method, *fine, some), [1e-9], colors="C0")
        ax.set_title(name, fontsize=10)
        ax.set_xlabel("step size h")
        ax.tick_params(labelbottom=True)
        done = norms <= 1e-3
        stable = excess(method, *np.meshgrid(gammas, hs), some).T <= 1e-9
        limits = [
            f"{h:.3f}"
            if np.isfinite(h := largest_step(method, gamma, some))
            else "none"
            for gamma in (0, 0.7, 5)
        ]
        rows += [
            (
                f"{name}: region of convergence",
                AREA.get(name, "not shown"),
                f"{done.mean():.0%} of the diagram; {(done & ~stable).sum()} points "
                "outside the theoretical limit",
            ),
            (
                f"{name}: at gamma = 0",
                AT_ZERO.get(name, "not shown"),
                f"smallest gradient after 800 steps: {norms[0].min():.2g}",
            ),
            (
                f"{name}: largest stable h",
                LIMIT.get(name, "not shown"),
                "{} at gamma = 0, {} at 0.7, {} at 5".format(*limits),
            ),
        ]
    shifted = [largest_step(nesterov, gamma + 100, some) for gamma in (0, 5)]
    rows.append(
        (
            "Nesterov with gamma + 100, as in the authors' script",
            "the panel of the paper",
            "largest stable h {:.3f} at gamma = 0, {:.3f} at 5".format(*shifted),
        )
    )
    for ax in axes[:, 0]:
        ax.set_ylabel("friction gamma")
    axes[-1, -1].remove()
    assert image is not None
    fig.colorbar(
        image, ax=axes.ravel()[:-1], label="norm of the gradient, after 800 steps"
    )
    report("phase_diagram", fig, rows, options)


if __name__ == "__main__":
    main()
