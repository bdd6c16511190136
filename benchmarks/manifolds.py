"""Minimisation on manifolds: gradients to an excess of the objective, beside Pymanopt.

Five problems whose minimum is known, with one rule. Solves from rest, with friction
`3 / t` and the step `1 / sqrt(L)`, follow one another. Each ends when the objective
begins to rise, the first after 20 steps at the latest, and each further one after twice
as many. `L` is the largest curvature where a solve starts, by ten products with the
Hessian for the first and three for each further one. A product counts as two gradients.

`Strang` moves along geodesics. `projected` is the same rule in a loop that adds momenta
to positions and projects. Of Pymanopt, if it is installed, conjugate gradients and
steepest descent with their defaults: gradients + values of the objective at new points.
The second table is for other friction. `--plot` saves docs/img/manifolds.png.
"""

import importlib
import importlib.metadata
import importlib.util
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from _plot import FOLDER, panels, save
from _report import command_line, Table

import diffrax_presym as dps


diffeqsolve: Any = dfx.diffeqsolve
jax.config.update("jax_enable_x64", True)
TARGETS = 1e-3, 1e-6, 1e-9
LEAST, MOST = 1e-11, 2000  # excess and evaluations at which a run ends
FRICTION = dps.LogDamping(3.0)
PEERS = {"ConjugateGradient": "conj. gradients", "SteepestDescent": "steepest descent"}


class Problem(NamedTuple):
    manifold: Any
    objective: Any  # of q
    minimum: float
    start: Any
    peer: tuple  # the manifold of Pymanopt, and its arguments


def problems(n, seed=0):
    rng = np.random.default_rng(seed)

    def rotation(n):
        frame = np.linalg.qr(rng.standard_normal((n, n)))[0]
        frame[:, 0] *= np.linalg.det(frame)
        return frame

    frame, values = rotation(n), np.linspace(1, 100, n)
    A = frame @ np.diag(values) @ frame.T
    quadratic = lambda q: jnp.sum(q * (A @ q)) / 2
    start = rng.standard_normal((n, 5))
    sphere, stiefel = dps.Sphere(), dps.Stiefel()
    found = quadratic, values[0] / 2, start[:, 0], ("Sphere", n)
    yield "smallest eigenvector", Problem(sphere, *found)
    found = quadratic, values[:5].sum() / 2, start, ("Stiefel", n, 5)
    yield "five smallest eigenvectors", Problem(stiefel, *found)
    # Points, and the same points rotated and perturbed.
    k = 10
    points = np.geomspace(1, 10, k)[:, None] * rng.standard_normal((k, 200))
    noise = 0.1 * rng.standard_normal(points.shape)
    M = (rotation(k) @ points + noise) @ points.T
    least = -np.linalg.svd(M, compute_uv=False).sum()
    found = lambda q: -jnp.sum(M * q), least, rotation(k), ("Stiefel", k, k)
    yield "nearest rotation", Problem(stiefel, *found)
    # The spherical model of Sherrington and Kirkpatrick.
    J = rng.standard_normal((5 * n, 5 * n))
    J = (J + J.T) / np.sqrt(10 * n)
    energy = lambda q: -jnp.sum(q * (J @ q)) / 2
    found = -np.linalg.eigvalsh(J)[-1] / 2, rng.standard_normal(5 * n)
    yield "spherical spin glass", Problem(sphere, energy, *found, ("Sphere", 5 * n))
    # Twelve charges on a sphere, whose minimum is the icosahedron.
    pairs = np.triu_indices(12, 1)
    apart = lambda q: q[pairs[0]] - q[pairs[1]]
    coulomb = lambda q: jnp.sum(1 / jnp.linalg.norm(apart(q), axis=1))
    ends = [(0, x, y * (1 + 5**0.5) / 2) for x in (-1, 1) for y in (-1, 1)]
    ends = np.concatenate([np.roll(ends, i, axis=1) for i in range(3)])
    least = float(coulomb(ends / np.linalg.norm(ends[0])))
    found = coulomb, least, rng.standard_normal((12, 3)), ("Oblique", 3, 12)
    yield "twelve charges", Problem(sphere, *found)


def by_geodesics(system, f, uphill, restarts):
    ends = dfx.SubSaveAt(t1=True, fn=lambda t, y, args: y[0])
    values = dfx.SubSaveAt(steps=True, fn=lambda t, y, args: f(y[0]))

    def descend(q, h, most):
        sol = diffeqsolve(
            *(system, dps.Strang(), h, (most + 1) * h, h, (q, jnp.zeros_like(q))),
            saveat=dfx.SaveAt(subs=[ends, values]),
            event=dfx.Event(lambda t, y, args, **_: uphill(*y)) if restarts else None,
            max_steps=MOST + 1,
        )
        return sol.ys[0][-1], sol.ys[1], sol.stats["num_steps"]

    return descend


def by_projection(system, f, uphill, restarts):
    def descend(q, h, most):
        def step(carry):
            n, q, p, values = carry
            p = (n / (n + 1)) ** 3 * p + h * system.kick(0.0, q, p, None)
            q, p = system.project(0.0, (q + h * p, p))
            return n + 1, q, p, values.at[n - 1].set(f(q))

        proceed = lambda x: (x[0] <= most) & ~(restarts & uphill(*x[1:3]))
        start = 1, q, jnp.zeros_like(q), jnp.full(MOST, jnp.inf)
        n, q, _, values = jax.lax.while_loop(proceed, step, start)
        return q, values, n - 1

    return descend


def minimise(problem, method=by_geodesics, friction=FRICTION, restarts=True):
    """Gradients, and the excess after each relative to that at the start."""
    f, slope = problem.objective, jax.grad(problem.objective)
    system = dps.ManifoldSystem(problem.manifold, lambda t, q, args: f(q), friction)
    tangent = lambda q, x: system.project(0.0, (q, x))[1]
    descend = method(system, f, lambda q, p: jnp.sum(slope(q) * p) > 0, restarts)

    def curvature(q, v, products):
        def hessian(_, v):
            v = tangent(q, v / jnp.linalg.norm(v))
            return tangent(q, jax.jvp(lambda q: tangent(q, slope(q)), (q,), (v,))[1])

        v = jax.lax.fori_loop(0, products, hessian, v)
        return v, jnp.linalg.norm(v)

    curvature, descend = jax.jit(curvature), jax.jit(descend)
    q = v = jnp.asarray(problem.start)
    q = system.project(0.0, (q, jnp.zeros_like(q)))[0]
    relative = lambda x: (np.asarray(x) - problem.minimum) / (f(q0) - problem.minimum)
    q0, products, most, count, curve = q, 10, 20, 1, [(1, 1.0)]
    while count < MOST and curve[-1][1] > LEAST:
        v, largest = curvature(q, v, products)
        q, values, steps = descend(q, 1 / jnp.sqrt(largest), most)
        count, products, steps = count + 2 * products, 3, int(steps)
        most = min(2 * most, MOST)
        each = enumerate(relative(values[:steps]), count + 1)
        curve, count = [*curve, *each], count + steps
    return np.array(curve).T


def by_pymanopt(problem, name):
    """Gradients, gradients and values, and the excess at each gradient."""
    pymanopt: Any = importlib.import_module("pymanopt")
    kind, *size = problem.peer
    manifold = getattr(pymanopt.manifolds, kind)(*size)
    turn = np.transpose if kind == "Oblique" else np.asarray
    f, slope = jax.jit(problem.objective), jax.jit(jax.grad(problem.objective))
    seen, history = set(), []

    @pymanopt.function.numpy(manifold)
    def cost(x):
        seen.add(x.tobytes())
        return float(f(turn(x)))

    @pymanopt.function.numpy(manifold)
    def gradient(x):
        count = len(history) + 1
        history.append((count, count + len(seen), f(turn(x))))
        return turn(slope(turn(x)))

    start = dps.ManifoldSystem(problem.manifold, lambda t, q, args: 0.0)
    start = start.project(0.0, (problem.start, 0 * problem.start))[0]
    limits = {"max_iterations": MOST // 2, "min_gradient_norm": 1e-9}
    optimizer = getattr(pymanopt.optimizers, name)(verbosity=0, **limits)
    task = pymanopt.Problem(manifold, cost, euclidean_gradient=gradient)
    optimizer.run(task, initial_point=np.array(turn(start)))
    gradients, both, values = np.array(history).T
    excess = values - problem.minimum
    return gradients, both, excess / excess[0]


def reached(count, excess):
    """The numbers of evaluations that the targets take."""
    found = [count[excess < target] for target in TARGETS]
    return [int(x[0]) if len(x) else None for x in found]


def picture(results):
    fig, axes = panels(len(results), 3, (3.2, 2.7), sharey=True)
    style = dict(zip(("Strang", *PEERS.values()), ("-", "--", ":"), strict=True))
    for ax, (name, curves) in zip(axes, results.items(), strict=True):
        for label, (count, excess) in curves.items():
            ax.semilogy(count, np.maximum(excess, 1e-99), style[label], label=label)
        ax.set(title=name, xlabel="gradients + values", ylim=(1e-10, 2), xlim=(0, 400))
    for ax in axes[::3]:
        ax.set_ylabel("excess / initial excess")
    handles, labels = axes[0].get_legend_handles_labels()
    axes[0].figure.legend(handles, labels, loc=(0.72, 0.2))
    save(fig, FOLDER / "manifolds.png")


def main():
    parser = command_line(__doc__)
    parser.add_argument("--plot", action="store_true", help="save the figure")
    parser.add_argument("--seed", type=int, default=0, help="of problems and starts")
    options = parser.parse_args()
    peers = PEERS if importlib.util.find_spec("pymanopt") else {}
    version = importlib.metadata.version("pymanopt") if peers else "is not installed"
    print(f"Pymanopt {version}")
    table = Table(
        "Gradients to an excess relative to that at the start",
        *("problem:<26", "excess:>7.0e", "Strang:>7", "projected:>9"),
        *(f"{name}:>16" for name in PEERS.values()),
    )
    results = {}
    cases = dict(problems(20 if options.quick else 100, options.seed))
    cases = dict(list(cases.items())[: 2 if options.quick else None])
    for name, problem in cases.items():
        curves: dict[str, Any] = {"Strang": minimise(problem)}
        rows = [reached(*curves["Strang"])]
        rows += [reached(*minimise(problem, by_projection))]
        for peer, label in peers.items():
            gradients, both, excess = by_pymanopt(problem, peer)
            curves[label] = both, excess
            found = reached(gradients, excess), reached(both - gradients, excess)
            rows += [[x and f"{x} + {y}" for x, y in zip(*found, strict=True)]]
        rows += [[None] * len(TARGETS)] * (len(PEERS) - len(peers))
        for i, cells in enumerate(zip(TARGETS, *rows, strict=True)):
            table.row("" if i else name, *cells)
        results[name] = curves
    if options.plot:
        picture(results)
    if options.quick:
        return
    rules = {
        "3/t": (FRICTION, True),
        "3/t, to the last step": (FRICTION, False),
        "none": (None, True),
    }
    table = Table(
        "Gradients to 1e-6 with other friction, and without the stop at a rise",
        *("problem:<26", *(f"{rule}:>21" for rule in rules)),
    )
    for name, problem in cases.items():
        runs = [minimise(problem, by_geodesics, *rule) for rule in rules.values()]
        table.row(name, *(reached(*run)[1] for run in runs))


if __name__ == "__main__":
    main()
