"""How strong friction may be over a step, of each explicit scheme.

The oscillator q'' = -q - gamma q' at steps of h = 0.5 and 1. Of each scheme: the
largest h gamma up to which no solution grows, by the eigenvalues of a step; the error
of the slower of the two motions there; and the h gamma from which a solve fails, as a
stage that goes back in time amplifies rounding errors beyond half of the digits.
"""

import argparse

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

SCHEMES = {
    "PresymplecticLeapfrog": dps.PresymplecticLeapfrog(),
    "Strang": dps.Strang(),
    "PresymplecticYoshida4": dps.PresymplecticYoshida4(),
    "Suzuki4": dps.Suzuki4(dps.PresymplecticLeapfrog()),
    "SofroniouSpaletta6": dps.SofroniouSpaletta6(dps.PresymplecticLeapfrog()),
    "SofroniouSpaletta8": dps.SofroniouSpaletta8(dps.PresymplecticLeapfrog()),
    "SofroniouSpaletta10": dps.SofroniouSpaletta10(dps.PresymplecticLeapfrog()),
    "BlanesMoanRKN4": dps.BlanesMoanRKN4(),
    "BlanesMoan4": dps.BlanesMoan4(),
    "TunedRKN6": dps.TunedRKN6(),
    "BlanesMoanRKN6": dps.BlanesMoanRKN6(),
    "BlanesMoan6": dps.BlanesMoan6(),
    "BlanesCasasRKN8": dps.BlanesCasasRKN8(),
}


def potential(t, q, args):
    return jnp.sum(q**2) / 2


@eqx.filter_jit
def step_matrices(solver, gammas, h):
    """The matrix of a step for each rate of friction."""

    def matrix(gamma):
        system = dps.MechanicalSystem(
            dps.QuadraticKinetic(), potential, friction=dps.ConstantDamping(gamma)
        )

        def step(x):
            y = x[:1], x[1:]
            state = solver.init(system, 0.0, h, y, None)
            y = solver.step(system, 0.0, h, y, None, state, made_jump=False)[0]
            return jnp.concatenate(y)

        return jax.jacfwd(step)(jnp.zeros(2))

    return jax.vmap(matrix)(gammas)


def limits(solver, h, h_gamma):
    """The largest stable h gamma, the error there, and the first that fails."""
    matrices = np.asarray(step_matrices(solver, h_gamma / h, h))
    fails = ~np.all(np.isfinite(matrices), axis=(1, 2))
    radius = np.array(
        [
            np.max(np.abs(np.linalg.eigvals(x))) if good else np.inf
            for x, good in zip(matrices, ~fails, strict=True)
        ]
    )
    unstable = radius > 1 + 1e-12
    stable = np.argmax(unstable) if np.any(unstable) else len(h_gamma)
    # Of the motion that friction slows down.
    gamma = h_gamma / h
    rates = (-gamma + np.sqrt((gamma**2 - 4).astype(complex))) / 2
    error = np.abs(radius - np.abs(np.exp(h * rates)))
    first = h_gamma[np.argmax(fails)] if np.any(fails) else np.inf
    if stable == len(h_gamma):
        return np.inf, error[-1], first
    return h_gamma[max(stable - 1, 0)], error[max(stable - 1, 0)], first


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="few rates of friction")
    quick = parser.parse_args().quick
    h_gamma = np.geomspace(0.05, 400, 60 if quick else 1200)
    print(f"{'':22} {'h = 0.5':>24} {'h = 1':>24}")
    columns = f"{'stable to':>10} {'error':>7} {'fails':>5} "
    print(f"{'h gamma':22} {columns} {columns}")
    text = lambda x: f"{x:.3g}" if np.isfinite(x) else "-"
    for name, solver in SCHEMES.items():
        cells = ""
        for h in (0.5, 1.0):
            stable, error, fails = limits(solver, h, h_gamma)
            cells += f"{text(stable):>10} {error:7.0e} {text(fails):>5}  "
        print(f"{name:22} {cells}")


if __name__ == "__main__":
    main()
