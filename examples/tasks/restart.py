"""A long solve, interrupted and continued by another process, to the same bits."""

import pathlib
import subprocess
import sys
import tempfile

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

system = dps.MechanicalSystem(
    dps.QuadraticKinetic(),
    lambda t, q, args: jnp.sum(q**4 / 4 - q**2 / 2 - 0.3 * q * jnp.cos(1.2 * t)),
    friction=dps.ConstantDamping(0.3),
)
solver, dt0 = dps.TunedRKN6(), 0.23
cuts = np.array([0.0, 14.3, 29.3])  # steps end there, in a whole solve too
y0 = jnp.array([1.0]), jnp.array([0.0])


def solve(t0, t1, y, solver_state=None):
    sol = dfx.diffeqsolve(
        *(system, solver, t0, t1, dt0, y),
        solver_state=solver_state,
        stepsize_controller=dps.StepsBetween(cuts),
        saveat=dfx.SaveAt(t1=True, solver_state=True),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )
    return jax.tree.map(lambda y: y[-1], sol.ys), sol.solver_state


start, middle, end = cuts
if len(sys.argv) > 1:  # the second process
    path = pathlib.Path(sys.argv[1])
    template = y0, solver.init(system, 0.0, dt0, y0, None)
    state = eqx.tree_deserialise_leaves(path / "middle.eqx", template)
    eqx.tree_serialise_leaves(path / "end.eqx", solve(middle, end, *state)[0])
    sys.exit()
with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder)
    eqx.tree_serialise_leaves(path / "middle.eqx", solve(start, middle, y0))
    subprocess.run([sys.executable, __file__, folder], check=True)
    restarted = eqx.tree_deserialise_leaves(path / "end.eqx", y0)
whole, _ = solve(start, end, y0)
same = all(map(np.array_equal, restarted, whole))
field = lambda t, y: [y[1], y[0] - y[0] ** 3 + 0.3 * np.cos(1.2 * t) - 0.3 * y[1]]
exact = solve_ivp(field, (0, end), [1.0, 0.0], "DOP853", rtol=1e-12, atol=1e-12)
error = np.max(np.abs(np.concatenate(whole) - exact.y[:, -1]))
print(f"bitwise equal: {same}, error {error:.1e}")
assert same and error < 1e-6
