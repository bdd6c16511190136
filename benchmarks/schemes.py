"""What one evaluation of the force buys: accuracy and stability of every scheme.

Accuracy: times less error than the triple jump of the same order at equal numbers of
force evaluations, in the geometric mean over the problems. Stability: the longest step
per force evaluation, in units of 1/omega, at which the undamped oscillator is stable.
Times are not measured, so any machine prints the same.
"""

import argparse
import statistics

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)

# Each with its force evaluations per step, compared to the first of its order.
SCHEMES = {
    2: {
        "leapfrog": (dps.PresymplecticLeapfrog(), 1),
        "leapfrog, position first": (dps.PresymplecticLeapfrog("position"), 1),
        "Tao": (dps.PresymplecticTao(), 3),
    },
    4: {
        "Yoshida4": (dps.PresymplecticYoshida4(), 3),
        "Yoshida4, position first": (dps.PresymplecticYoshida4("position"), 3),
        "Suzuki4": (dps.Suzuki4(), 5),
        "BlanesMoan4": (dps.BlanesMoan4(), 6),
        "BlanesMoanRKN4": (dps.BlanesMoanRKN4(), 6),
    },
    6: {
        "SuzukiYoshida(6)": (dps.SuzukiYoshida(6), 9),
        "SofroniouSpaletta6": (dps.SofroniouSpaletta6(), 13),
        "BlanesMoan6": (dps.BlanesMoan6(), 10),
        "BlanesMoanRKN6": (dps.BlanesMoanRKN6(), 14),
        "TunedRKN6": (dps.TunedRKN6(), 14),
    },
    8: {
        "SuzukiYoshida(8)": (dps.SuzukiYoshida(8), 27),
        "SofroniouSpaletta8": (dps.SofroniouSpaletta8(), 21),
        "BlanesCasasRKN8": (dps.BlanesCasasRKN8(), 19),
    },
}
PROBLEMS = {
    "pendulum": problems.pendulum,
    "decaying": problems.decaying,
    "Henon": problems.henon_heiles,
    "Kepler": problems.kepler,
}


@eqx.filter_jit
def solve(problem_y0, term, solver, t1, steps):
    return dfx.diffeqsolve(
        term,
        solver,
        t0=jnp.zeros_like(t1),
        t1=t1,
        dt0=t1 / steps,
        y0=problem_y0,
        max_steps=None,
        throw=False,
    ).ys


def error_constant(problem, exact, solver, evaluations, order):
    """The error times the number of force evaluations to the power of the order."""
    term = dps.HamiltonianTerm(problem.hamiltonian)
    constants = []
    for half_doublings in range(28):
        steps = round(problem.t1) * 2 ** (half_doublings / 2) / evaluations
        steps = jnp.asarray(max(1, round(steps)))
        y = solve(problem.y0, term, solver, jnp.asarray(problem.t1), steps)
        error = float(np.max(np.abs(np.array(y)[:, 0] - exact)))
        if 1e-10 < error < 1e-3:
            constants.append(error * (int(steps) * evaluations) ** order)
    # The finest steps that are not rounding.
    return statistics.geometric_mean(constants[-2:]) if constants else np.nan


@eqx.filter_jit
def trace_of_step(solver, h):
    term = dps.HamiltonianTerm(
        dps.SeparableHamiltonian(dps.QuadraticKinetic(), lambda t, q, args: q**2 / 2)
    )

    def step(y):
        t0 = jnp.zeros_like(h)
        carry = solver.init(term, t0, h, y, None)
        return solver.step(term, t0, h, y, None, carry, made_jump=False)[0]

    unit = jnp.ones_like(h), jnp.zeros_like(h)
    return step(unit)[0] + step(unit[::-1])[1]


def stability(solver, evaluations):
    """The first step per evaluation at which a step of the oscillator grows."""
    h = jnp.linspace(0, 2.2, 22001)[1:] * evaluations
    trace = jax.vmap(lambda h: trace_of_step(solver, h))(h)
    grows = np.abs(np.asarray(trace)) > 2 + 1e-9
    return float(h[np.argmax(grows)]) / evaluations if grows.any() else np.inf


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one problem, for CI")
    names = list(PROBLEMS)[: 1 if parser.parse_args().quick else None]
    makers = [PROBLEMS[name] for name in names]
    systems = [(problem := make(), problems.reference(problem)) for make in makers]
    header = "".join(f"{name:>9}" for name in (*names, "mean"))
    print(f"{'times less error':26}{header} h omega")
    for order, schemes in SCHEMES.items():
        base = None
        for name, (solver, evaluations) in schemes.items():
            constants = [
                error_constant(problem, exact, solver, evaluations, order)
                for problem, exact in systems
            ]
            base = constants if base is None else base
            gains = [b / c for b, c in zip(base, constants, strict=True)]
            limit = stability(solver, evaluations)
            mean = statistics.geometric_mean(gains)
            row = "".join(f"{gain:>9.2g}" for gain in (*gains, mean))
            # Tao's stability depends on its coupling as much as on the step.
            limit = f"{limit:>8.3f}" if name != "Tao" else f"{'-':>8}"
            print(f"{order} {name:24}{row}{limit}", flush=True)


if __name__ == "__main__":
    main()
