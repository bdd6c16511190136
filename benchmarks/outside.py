"""Integrators from outside JAX, where they are installed: `{name: (solve, sweep)}`."""

import numpy as np


def heyoka_runs(problem, tolerances):
    """heyoka's Taylor integrator, compiled once for each tolerance."""
    try:
        import heyoka as hy  # pyright: ignore[reportMissingImports]
    except ImportError:
        return {}
    equations = symbolic(problem, hy)
    if equations is None:
        return {}
    n = len(problem.q0)
    state = np.concatenate([problem.q0, problem.p0])
    compiled = {
        tolerance: hy.taylor_adaptive(equations, state.copy(), tol=tolerance)
        for tolerance in tolerances
    }

    def solve(tolerance):
        integrator = compiled[tolerance]
        integrator.time = 0.0
        integrator.state[:] = state
        integrator.propagate_until(problem.t1)
        return integrator.state.reshape(2, n).copy(), 0, False

    return {"heyoka": (solve, list(tolerances))}


def symbolic(problem, hy):
    """The right-hand side as heyoka expressions; `None` where it is too large."""
    n = len(problem.q0)
    q, p = (hy.make_vars(*[f"{c}{i}" for i in range(n)]) for c in "qp")
    q, p = ([x] if n == 1 else x for x in (q, p))
    if problem.name == "damped pendulum":
        forces = [-hy.sin(q[0]) - 0.1 * p[0]]
    elif problem.name == "decaying oscillator":
        forces = [-q[0] - 3.0 / (hy.time + 1.0) * p[0]]
    elif problem.name == "damped Henon-Heiles":
        x, y = q
        forces = [-x - 2.0 * x * y - 0.01 * p[0], -y - x * x + y * y - 0.01 * p[1]]
    elif problem.name == "Kepler with drag":
        r3 = (q[0] * q[0] + q[1] * q[1]) ** 1.5
        forces = [-x / r3 - 1e-3 * v for x, v in zip(q, p, strict=True)]
    elif problem.name == "relativistic oscillator":
        forces = [-q[0] - 0.05 * p[0]]
        velocities = [p[0] / hy.sqrt(p[0] * p[0] + 1.0)]
        return list(zip(q + p, velocities + forces, strict=True))
    elif problem.name == "chain of 100":
        cubic = lambda x: x + x * x * x
        forces = []
        for i in range(n):
            force = -cubic(q[i]) - 0.05 * p[i]
            if i > 0:
                force = force - cubic(q[i] - q[i - 1])
            if i < n - 1:
                force = force + cubic(q[i + 1] - q[i])
            forces.append(force)
    else:
        return None
    return list(zip([*q, *p], [*p, *forces], strict=True))
