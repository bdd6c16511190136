"""A network of masses and springs with Rayleigh damping, and its energy balance."""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import expm

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

n, alpha, beta = 30, 0.05, 0.02
rng = np.random.default_rng(1)
masses = rng.uniform(0.5, 2.0, n)
edges = [(i, i + 1) for i in range(n - 1)] + [(0, 7), (3, 20), (11, 29)]
stiffness = np.eye(n)
for i, j in edges:
    stiffness[np.ix_([i, j], [i, j])] += 5.0 * np.array([[1, -1], [-1, 1]])
system = dps.MechanicalSystem(
    dps.QuadraticKinetic(masses),
    dps.QuadraticPotential(jnp.asarray(stiffness)),
    friction=[dps.ConstantDamping(alpha), dps.ViscousDamping(beta * stiffness)],
)
q0 = jnp.asarray(rng.normal(size=n))
y0 = q0, jnp.zeros(n)
ts = jnp.linspace(0.0, 20.0, 201)


@jax.jit
def solve(dt0):
    return dfx.diffeqsolve(
        *(system, dps.TunedRKN6(), 0.0, 20.0, dt0, y0),
        saveat=dfx.SaveAt(ts=ts),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


step = dps.choose_step(solve, 0.0, 20.0, rtol=1e-7, atol=1e-7)
sol = solve(step.dt0)
damping = alpha * np.diag(masses) + beta * stiffness
A = np.block([[np.zeros((n, n)), np.diag(1 / masses)], [-stiffness, -damping / masses]])
exact = np.stack([expm(A * t) @ np.concatenate(y0) for t in ts])
error = np.max(np.abs(np.hstack(sol.ys) - exact) / (1 + np.abs(exact)))

lost = dps.diagnostics.energy_lost(system, sol.ts, sol.ys)[-1]
defect = jnp.max(jnp.abs(dps.diagnostics.energy_error(system, sol.ts, sol.ys)))


def energy(x):
    q, p = x[:n], x[n:]
    return p @ (p / masses) / 2 + q @ stiffness @ q / 2


wanted = energy(exact[0]) - energy(exact[-1])
print(f"{step.steps} steps, largest error {error:.1e}")
print(f"energy lost {lost:.6f}, exact {wanted:.6f}; balance holds to {defect:.1e}")
assert error < 1e-7
assert abs(lost - wanted) < 1e-5 and defect < 1e-5
