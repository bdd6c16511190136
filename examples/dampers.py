"""Identify the damper in each joint of a chain of ten links from noisy angles.

The links hang in a row and are released from rest. Their angles are measured at fifty
times, with noise, and the coefficients of all dampers are estimated by least squares:
L-BFGS of SciPy with gradients from `FixedStepAdjoint`, whose memory does not grow with
the number of steps. The curvature at the minimum gives the standard errors.

The mass matrix depends on the positions, so that the scheme is `PresymplecticGauss`,
with the step from `choose_step`. One value and gradient is timed beside that of
`Tsit5`, to the same error and with Diffrax's default adjoint.

    python examples/dampers.py [--quick] [--output dampers.png]
"""

import argparse
import pathlib
import statistics
import time
from functools import partial

import diffrax as dfx
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import scipy.optimize

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

GRAVITY, NOISE, DURATION, MEASURED = 9.81, 0.01, 5.0, 50
# The solution is wanted to a hundredth of the noise.
ERROR = NOISE / 100


def chain(n, dampers):
    """Thin rods of unit length and mass; the angles are relative to the rod before."""
    total = np.tril(np.ones((n, n)))
    # The centre of a rod moves with all rods before it, and half with its own.
    reach = total - np.eye(n) / 2
    products = reach.T @ reach

    def mass(t, q, args):
        angles = total @ q
        cos = jnp.cos(angles[:, None] - angles[None, :])
        return total.T @ (products * cos + np.eye(n) / 12) @ total

    def potential(t, q, args):
        return -GRAVITY * jnp.sum(reach @ jnp.cos(total @ q))

    return dps.LagrangianSystem(mass, potential, friction=dps.ViscousDamping(dampers))


def motion(ts, q0, solver, controller, adjoint, dt0, logs, throw=True):
    """The angles of all joints at the times of the measurements."""
    return dfx.diffeqsolve(
        chain(len(q0), jnp.exp(logs)),
        solver,
        t0=0.0,
        t1=DURATION,
        dt0=dt0,
        y0=(q0, jnp.zeros_like(q0)),
        saveat=dfx.SaveAt(ts=ts, fn=lambda t, y, args: y[0]),
        stepsize_controller=controller,
        adjoint=adjoint,
        max_steps=4096,
        throw=throw,
    )


def angles(*problem):
    return motion(*problem).ys


def misfit(solve, data, logs):
    return jnp.mean((solve(logs) - data) ** 2)


def milliseconds(function, *args):
    """The median time of a compiled call."""
    jax.block_until_ready(function(*args))
    times = []
    for _ in range(7):
        start = time.perf_counter()
        jax.block_until_ready(function(*args))
        times.append(time.perf_counter() - start)
    return 1e3 * statistics.median(times)


def picture(path, ts, data, fitted, truth, estimate, error):
    fig, (left, right) = plt.subplots(
        1, 2, figsize=(11, 4.2), width_ratios=(2, 1), layout="constrained"
    )
    for joint, color in ((0, "C0"), (len(truth) - 1, "C3")):
        left.plot(ts, data[:, joint], ".", color=color, ms=5)
        left.plot(ts, fitted[:, joint], color=color, label=f"joint {joint + 1}")
    left.set(xlabel="time / s", ylabel="angle / rad", title="Measured and fitted")
    left.legend()
    joints = np.arange(1, len(truth) + 1)
    bars = dict(yerr=2 * error, fmt="o", ms=4, capsize=3)
    right.errorbar(joints, estimate, **bars, label="estimate, two standard errors")
    right.plot(joints, truth, "k_", ms=12, label="truth")
    right.set(xlabel="joint", ylabel="damper / (N m s)", ylim=(0, None))
    right.legend(fontsize="small")
    fig.savefig(path, dpi=100)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a chain of three links")
    parser.add_argument("--output", type=pathlib.Path, default="dampers.png")
    options = parser.parse_args()
    n = 3 if options.quick else 10
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.02, 0.1, n)
    q0, ts = jnp.linspace(0.4, 0.1, n), jnp.linspace(0.0, DURATION, MEASURED + 1)[1:]

    # The step for the error wanted, with a first guess of the dampers.
    guess = jnp.log(jnp.full(n, 0.05))
    scheme = dps.PresymplecticGauss(4, tolerance=ERROR / 1000)
    problem = ts, q0, scheme, dfx.ConstantStepSize()
    # Steps are undone as accurately as the iteration of the scheme.
    adjoint = dps.FixedStepAdjoint(tol=ERROR)
    # The iteration may fail with a step that is too long.
    solve = jax.jit(lambda dt0: motion(*problem, adjoint, dt0, guess, throw=False))
    chosen = dps.choose_step(solve, 0.0, DURATION, rtol=0.0, atol=ERROR)
    gauss = partial(angles, *problem, adjoint, chosen.dt0)
    print(chosen)

    def tsit5(tolerance):
        # An array, so that one compilation serves all tolerances.
        tolerance = jnp.asarray(tolerance)
        controller = dfx.PIDController(rtol=tolerance, atol=tolerance)
        adjoint = dfx.RecursiveCheckpointAdjoint()
        return partial(angles, ts, q0, dfx.Tsit5(), controller, adjoint, None)

    exact = tsit5(1e-11)(jnp.log(truth))
    error = lambda solve: float(jnp.max(jnp.abs(solve(jnp.log(truth)) - exact)))
    # The largest tolerance with which Tsit5 is as accurate.
    tolerances = 10.0 ** -np.arange(3.0, 9.0, 0.5)
    other = next(solve for solve in map(tsit5, tolerances) if error(solve) <= ERROR)

    assert exact is not None
    data = exact + NOISE * rng.standard_normal(exact.shape)
    solves = {"PresymplecticGauss": gauss, "Tsit5, adaptive": other}
    gradients = {
        name: jax.jit(jax.value_and_grad(partial(misfit, solve, data)))
        for name, solve in solves.items()
    }
    fit = scipy.optimize.minimize(
        lambda logs: jax.tree.map(np.asarray, gradients["PresymplecticGauss"](logs)),
        guess,
        jac=True,
        method="L-BFGS-B",
        bounds=[(np.log(0.002), np.log(1.0))] * n,
        options=dict(ftol=1e-12, gtol=1e-9, maxiter=300),
    )
    logs = jnp.asarray(fit.x)
    forward = partial(angles, *problem, dps.FixedStepAdjoint("forward"), chosen.dt0)
    slopes = jax.jit(jax.jacfwd(forward))(logs).reshape(-1, n)
    spread = NOISE * np.sqrt(np.diag(np.linalg.inv(slopes.T @ slopes)))
    estimate = np.exp(logs)

    print("joint   truth  estimate  standard error")
    rows = zip(truth, estimate, estimate * spread, strict=True)
    for i, row in enumerate(rows):
        print("{:5d}{:8.3f}{:10.3f}{:16.3f}".format(i + 1, *row))
    print(
        f"\n{fit.nit} iterations with {fit.nfev} gradients. Errors of the solutions in"
    )
    print("rad, and times of one solve and of one value and gradient in milliseconds:")
    for name, solve in solves.items():
        costs = milliseconds(jax.jit(solve), logs), milliseconds(gradients[name], logs)
        print("{:20}{:9.1e}{:8.1f}{:8.1f}".format(name, error(solve), *costs))
    picture(options.output, ts, data, gauss(logs), truth, estimate, estimate * spread)
    print(f"Saved {options.output}")


if __name__ == "__main__":
    main()
