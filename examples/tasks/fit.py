"""A fit of friction and stiffness to noisy data, with uncertainties."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from scipy.integrate import solve_ivp
from scipy.optimize import curve_fit

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

truth, noise = np.array([0.15, 2.0]), 0.03
rng = np.random.default_rng(0)
ts = np.sort(rng.uniform(0.0, 20.0, 120))


@jax.jit
def model(parameters):
    rate, stiffness = parameters
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(),
        lambda t, q, args: stiffness * (1 - jnp.cos(q[0])),
        friction=dps.ConstantDamping(rate),
    )
    return dfx.diffeqsolve(
        *(system, dps.TunedRKN6(), 0.0, 20.0, 0.25, (jnp.ones(1), jnp.zeros(1))),
        saveat=dfx.SaveAt(ts=jnp.asarray(ts), fn=lambda t, y, args: y[0][0]),
        adjoint=dps.FixedStepAdjoint(),
    ).ys


def exact(ts, rate, stiffness):
    field = lambda t, y: [y[1], -stiffness * np.sin(y[0]) - rate * y[1]]
    sol = solve_ivp(field, (0, 20), [1.0, 0.0], "DOP853", ts, rtol=1e-8, atol=1e-8)
    return sol.y[0]


data = exact(ts, *truth) + noise * rng.normal(size=len(ts))
residuals = lambda x, _=None: (model(x) - data) / noise
guess = jnp.array([0.3, 2.2])
fit = optx.least_squares(
    residuals,
    optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6),
    guess,
    options=dict(jac="bwd"),
)
J = jax.jacrev(residuals)(fit.value)
covariance = jnp.linalg.inv(J.T @ J)
wanted, expected = curve_fit(
    exact, ts, data, guess, noise * np.ones(120), absolute_sigma=True
)
errors = jnp.sqrt(jnp.diag(covariance))
for name, value, error in zip(
    ["friction", "stiffness"], fit.value, errors, strict=True
):
    print(f"{name:10}{value:.4f} ± {error:.4f}")
assert np.allclose(fit.value, wanted, atol=1e-3 * errors)
assert np.allclose(covariance, expected, rtol=1e-3, atol=1e-3 * np.max(expected))
assert np.all(np.abs(fit.value - truth) < 4 * errors)
