"""Gradients of long solves: time and memory of three ways to get them.

The leapfrog, on damped pendulums, whose sines take most of the time, and on springs
with a cubic force, which takes almost none. A ratio is the time of value and gradient,
with respect to the initial state and the damping, over that of the same solve alone.
`FixedStepAdjoint` is measured by reversal and by checkpoints, beside Diffrax's
`RecursiveCheckpointAdjoint` and reverse mode through a `lax.scan` written by hand,
whose number of steps is fixed when it is compiled. Runs that would take too long or too
much memory are omitted, and the longest are made once.

`--batches` measures one pendulum each under `vmap`, in batches of 1, 64, 1000 and 4096,
with the gradient for each member, with the leapfrog and with `TunedRKN6`.

`--network` measures value and gradient of a loss over 100 saved times by the weights of
a network that is the potential, with steps for an error of 1e-5 there, and their first
call, beside Diffrax's solvers with its own loop.

Memory is what XLA reports that the compiled program needs in addition to its arguments.

`--damping` finds the strongest damping of a pendulum, of 8 rates in each decade, up to
which a gradient by reversal with the defaults agrees with one by checkpoints to a
relative 1e-6, and that up to which the solve is successful: in 40, 400 and 4000 steps
to t = 20, saved at 21 times.
"""

import itertools
from functools import partial
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from _report import command_line, Table
from _schemes import SCHEMES
from _solve import solve
from _timing import interleaved, timed

import diffrax_presym as dps


T1 = 10.0
REVERSAL = dps.FixedStepAdjoint()
ADJOINTS = {
    "reversal": REVERSAL,
    "checkpoints": dps.FixedStepAdjoint("checkpoints"),
    "Diffrax's": dfx.RecursiveCheckpointAdjoint(),
}
# Steps times unknowns beyond which a method is not tried.
LONGEST = 1e9
MOST = {"reversal": LONGEST, "checkpoints": 1e8, "Diffrax's": 2e7, "scan": 3e7}
LONG = 3e8  # Beyond which a program runs once, without a warm-up.

SYSTEMS = {
    "pendulums": lambda t, q, args: -jnp.sum(jnp.cos(q)),
    "springs": lambda t, q, args: jnp.sum(q**2 / 2 + q**4 / 4),
}
SAVES = {
    "t1": dfx.SaveAt(t1=True),
    "101": dfx.SaveAt(ts=jnp.linspace(0.0, T1, 101)),
}
LEAPFROG = dps.PresymplecticLeapfrog()
# With the factor by which a step is longer.
SOLVERS = {"leapfrog": (LEAPFROG, 1), "TunedRKN6": (dps.TunedRKN6(), 20)}


def loss_of(system, adjoint, steps, saved="t1", solver: Any = LEAPFROG):
    """The sum of squares of what is saved."""

    def loss(y0, gamma):
        problem = dps.MechanicalSystem(
            dps.QuadraticKinetic(), SYSTEMS[system], dps.ConstantDamping(gamma)
        )
        options = {"saveat": SAVES[saved], "adjoint": adjoint, "max_steps": steps}
        sol = solve(problem, solver, 0.0, T1, T1 / steps, y0, **options, throw=True)
        return sum(jnp.sum(y**2) for y in jax.tree.leaves(sol.ys))

    return loss


def by_scan(system, steps):
    """The same scheme as one would write it."""
    h = T1 / steps
    slope = jax.grad(lambda q: SYSTEMS[system](0.0, q, None))

    def loss(y0, gamma):
        decay = jnp.exp(-gamma * h / 2)

        def step(y, _):
            q, p = y
            p = decay * (p - h / 2 * slope(q))
            q = q + h * p / 2 * (1 + decay) / decay
            p = decay * p - h / 2 * slope(q)
            return (q, p), None

        y, _ = jax.lax.scan(step, y0, length=steps)
        return sum(jnp.sum(x**2) for x in y)

    return loss


def with_gradient(loss):
    return jax.value_and_grad(loss, argnums=(0, 1))


def methods(system, steps):
    return {"solve": loss_of(system, REVERSAL, steps)} | {
        name: with_gradient(loss)
        for name, loss in {
            **{name: loss_of(system, x, steps) for name, x in ADJOINTS.items()},
            "scan": by_scan(system, steps),
        }.items()
    }


def problem(n):
    return (jnp.linspace(0.5, 2.0, n), jnp.zeros(n)), jnp.array(0.1)


def compiled(loss, at):
    """A program without arguments."""
    return partial(jax.jit(loss).lower(*at).compile(), *at)


def over_solve(found, names):
    """Milliseconds of the solve alone, and the ratios to it of those measured."""
    alone = found["solve"]
    ratios = (found[x].over(alone) if x in found else None for x in names)
    return alone.median * 1e3, *ratios


def times(system, sizes, counts, repeats):
    table = Table(
        f"Value and gradient over the solve alone, {system}",
        *("unknowns:>9", "steps:>7", "solve, ms:>10.3g"),
        *(f"{name}:>13.2f" for name in MOST),
    )
    for n, steps in itertools.product(sizes, counts):
        if n * steps <= LONGEST:
            programs = {
                name: compiled(loss, problem(n))
                for name, loss in methods(system, steps).items()
                if n * steps <= MOST.get(name, LONGEST)
            }
            once = n * steps > LONG
            found = interleaved(programs, 1 if once else repeats, warm_up=not once)
            table.row(n, steps, *over_solve(found, MOST))


def batches(sizes, counts, repeats):
    table = Table(
        "Value and gradient over the solve alone, batches of pendulums",
        *("batch:>7", "scheme:<9", "steps:>7", "saved:>5", "solve, ms:>10.3g"),
        *(f"{name}:>13.2f" for name in ADJOINTS),
    )
    for batch in sizes:
        q, gamma = jnp.linspace(0.5, 2.0, batch)[:, None], jnp.array(0.1)
        at = (q, jnp.zeros_like(q)), gamma
        each = partial(jax.vmap, in_axes=(0, None))
        for scheme, (solver, fewer) in SOLVERS.items():
            for count, saved in itertools.product(counts, SAVES):
                steps = count // fewer
                loss = partial(loss_of, "pendulums", steps=steps, saved=saved)
                loss = partial(loss, solver=solver)
                programs = {"solve": compiled(each(loss(REVERSAL)), at)}
                for name, adjoint in ADJOINTS.items():
                    if batch * steps <= (1e6 if name == "Diffrax's" else 1e7):
                        fn = each(with_gradient(loss(adjoint)))
                        programs[name] = compiled(fn, at)
                found = interleaved(programs, repeats)
                cells = over_solve(found, ADJOINTS)
                table.row(batch, scheme, steps, saved, *cells)


def memory(n, counts):
    title = f"Memory of value and gradient at {n} unknowns, MB"
    table = Table(title, "steps:>9", *(f"{name}:>13.3f" for name in MOST))
    for steps in counts:
        losses, at = methods("pendulums", steps), problem(n)
        programs: list[Any] = [compiled(losses[name], at).func for name in MOST]
        used = [program.memory_analysis() for program in programs]
        table.row(steps, *(analysis.temp_size_in_bytes / 1e6 for analysis in used))


def network(n, tolerance=1e-5, repeats=21):
    """The potential is a network, and the loss is of its weights."""
    fn = eqx.nn.MLP(n, "scalar", 64, 2, jnp.tanh, key=jax.random.key(0))
    weights, rest = eqx.partition(fn, eqx.is_inexact_array)
    ts, y0 = jnp.linspace(0.0, T1, 101)[1:], (jnp.linspace(0.5, 1.0, n), jnp.zeros(n))
    potential = lambda t, q, args: q @ q / 2 + eqx.combine(args, rest)(q)
    system = dps.MechanicalSystem(
        dps.QuadraticKinetic(), potential, dps.ConstantDamping(0.1)
    )

    def run(solver, step, weights, tol=None) -> Any:
        options: dict = {"adjoint": REVERSAL, "max_steps": None}
        if not isinstance(solver, dps.extend.AbstractPresymplecticSolver):
            options = {"max_steps": 4096}
        if tol is not None:
            controller = dfx.PIDController(rtol=tol, atol=tol)
            options["stepsize_controller"] = controller
        return dfx.diffeqsolve(
            *(system, solver, 0.0, T1, step, y0, weights),
            saveat=dfx.SaveAt(ts=ts),
            **options,
        )

    exact = run(dfx.Dopri8(), None, weights, 1e-12).ys
    error = lambda ys: max(
        float(jnp.max(jnp.abs(y - z))) for y, z in zip(ys, exact, strict=True)
    )
    solves = {}
    for name in ("BlanesMoanRKN4", "TunedRKN6", "Tsit5", "Dopri8"):
        solver = getattr(dps if hasattr(dps, name) else dfx, name)()
        constant = jax.jit(lambda dt0, solver=solver: run(solver, dt0, weights))
        step = dps.choose_step(constant, 0.0, T1, rtol=0.0, atol=tolerance)
        solves[f"{name}, constant"] = partial(run, solver, float(step.dt0))
        if hasattr(dfx, name):
            fn = jax.jit(lambda tol, solver=solver: run(solver, None, weights, tol).ys)
            tols = (10.0 ** (-k / 4) for k in range(12, 48))
            tol = next(x for x in tols if error(fn(x)) <= tolerance)
            solves[f"{name}, adaptive"] = partial(run, solver, None, tol=tol)
    calls, first, errors = {}, {}, {}
    for name, saved in solves.items():
        loss = lambda weights, saved=saved: jnp.sum(saved(weights).ys[0] ** 2)
        calls[name] = partial(jax.jit(jax.value_and_grad(loss)), weights)
        first[name] = timed(calls[name])[1]
        errors[name] = error(saved(weights).ys)
    found = interleaved(calls, repeats)
    table = Table(
        f"A network as potential of {n} unknowns, value and gradient by its weights",
        *(
            "solver:<24",
            "error:>9.1e",
            "first, s:>10.1f",
            "ms:>9.2f",
            "over best:>10.2f",
        ),
    )
    theirs = [name for name in calls if hasattr(dfx, name.split(",")[0])]
    best = found[min(theirs, key=lambda name: found[name].median)]
    for name in calls:
        time = found[name].median * 1e3
        table.row(name, errors[name], first[name], time, found[name].over(best))


RATES = 10 ** (np.arange(-8, 57) / 8)
# Schemes that have an inverse.
INVERTIBLE = {
    name: scheme.solver
    for name, scheme in SCHEMES.items()
    if not name.startswith("SymmetricMultistep")
} | {
    "PresymplecticEuler, position first": dps.PresymplecticEuler("position"),
    "Suzuki4 of Strang": dps.Suzuki4(dps.Strang()),
    "SuzukiYoshida(4) of PresymplecticTao": dps.SuzukiYoshida(
        4, dps.PresymplecticTao(4.0)
    ),
    "PresymplecticGauss(2)": dps.PresymplecticGauss(2),
    "PresymplecticGauss(4)": dps.PresymplecticGauss(4),
}


def strongest_damping(counts):
    """The largest rates for which a gradient by reversal and a solve are right."""
    table = Table(
        "Strongest damping: of a right gradient, and of a successful solve",
        "scheme:<38",
        *(f"{x}:>10.3g" for n in counts for x in (f"{n} steps", "solve")),
    )
    for name, solver in INVERTIBLE.items():
        linear = name == "TunedLinear8"
        energy = dps.QuadraticPotential(jnp.eye(1)) if linear else SYSTEMS["pendulums"]

        def gradient(rate, h, adjoint, solver=solver, energy=energy):
            def loss(q, gamma):
                system = dps.MechanicalSystem(
                    dps.QuadraticKinetic(), energy, dps.ConstantDamping(gamma)
                )
                sol = solve(
                    *(system, solver, 0.0, 20.0, h, (q[None], jnp.zeros(1))),
                    saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 20.0, 21)),
                    **{"adjoint": adjoint, "max_steps": max(counts)},
                )
                value = jnp.sum(sol.ys[0] ** 2)  # pyright: ignore
                return value, sol.result == dfx.RESULTS.successful

            return jax.grad(loss, (0, 1), has_aux=True)(jnp.asarray(1.5), rate)

        row = []
        programs = [
            jax.jit(jax.vmap(partial(gradient, adjoint=x), (0, None)))
            for x in (REVERSAL, ADJOINTS["checkpoints"])
        ]
        for count in counts:
            slopes, exact = (run(jnp.asarray(RATES), 20.0 / count) for run in programs)
            good = np.asarray(slopes[1])
            for one, other in zip(slopes[0], exact[0], strict=True):
                right = np.abs(one - other) <= 1e-6 * np.abs(other)
                row.append(good & right)
            row[-2:] = [row[-2] & row[-1], good]
        largest = (RATES[: np.argmin(np.append(x, False))] for x in row)
        table.row(name, *(x[-1] if x.size else None for x in largest))


def main():
    parser = command_line(__doc__)
    parser.add_argument("--batches", action="store_true", help="only the batches")
    parser.add_argument("--network", action="store_true", help="only the network")
    parser.add_argument("--damping", action="store_true", help="only strong damping")
    options = parser.parse_args()
    quick = options.quick
    repeats = 2 if quick else 5
    if options.damping:
        return strongest_damping((40,) if quick else (40, 400, 4000))
    if options.network:
        for n in (2,) if quick else (2, 64):
            network(n, repeats=2 if quick else 21)
        return
    print(f"Median of {repeats} runs")
    batch_sizes = (1, 1000) if quick else (1, 64, 1000, 4096)
    batches(batch_sizes, (100,) if quick else (1000, 10_000), repeats)
    if options.batches:
        return
    sizes, counts = (1, 1000, 100000), (1000, 10000, 100000)
    for system in SYSTEMS:
        times(system, *(((1,), (1000,)) if quick else (sizes, counts)), repeats)
    memory(1000, (1000, 10000) if quick else (1000, 10000, 100000, 1000000))
    strongest_damping((40,) if quick else (40, 400, 4000))


if __name__ == "__main__":
    main()
