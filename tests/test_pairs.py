# pyright: reportOptionalMemberAccess=false, reportArgumentType=false
"""All pairs of entries of the catalogue: refused, or what is claimed.

A row takes one entry of each list, and each pair of entries is in some row. It is
compared with SciPy on the bare equations: the order from several numbers of steps, the
error of all that is saved, the bare scheme in the loop of Diffrax, and gradients by
central differences.
"""

import dataclasses
import pathlib
from functools import cache, cached_property, partial

import catalogue
import deliberate_errors
import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
import orders
import pytest
from catalogue import build, claim, Problem, reference, Refused
from jax.flatten_util import ravel_pytree
from rows import covering, pairs, sample

import diffrax_presym as dps
from diffrax_presym._scheme import _prepare as prepare


NUMBERS = [4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256]


def flat(y) -> np.ndarray:
    return np.concatenate([np.ravel(np.asarray(x, float)) for x in jtu.tree_leaves(y)])


class Run:
    """A row as a function of the number of steps and what can be differentiated."""

    def __init__(self, row: dict, adjoint, precision: str):
        self.row, self.way = row, row["way"]
        self.system = build(row["system"], row["friction"])
        self.bare = row["scheme"].for_precision(precision)
        self.solver = row["wrapper"].wrap(self.bare)
        t0, t1 = catalogue.span(row["system"], row["friction"])
        self.t0, self.t1 = (jnp.asarray(t, precision) for t in (t0, t1))
        self.adjoint, self.precision = adjoint, precision
        y0 = catalogue.start(row["system"], row["friction"])
        if self.way.backwards:
            exact = reference(row["system"], row["friction"])(t1)[0]
            y0 = ravel_pytree(y0)[1](jnp.asarray(exact))
        self.y0 = jtu.tree_map(lambda x: jnp.asarray(x, precision), y0)

    def outputs(self, n, system, y0, t1=None):
        t1 = self.t1 if t1 is None else t1
        if self.row["system"].constrained:
            # A neighbour of a state, as gradients take, is not on the manifold.
            y0 = system.project(t1 if self.way.backwards else self.t0, y0)
        problem = Problem(system, self.solver, self.t0, t1, self.adjoint)
        return self.way.run(problem, n, y0)

    @cached_property
    def compiled(self):
        if not self.way.prescribed:
            fn = eqx.filter_jit(lambda n, *x: self.outputs(n, *x))
            return lambda n, *x: fn(jnp.asarray(n, self.precision), *x)
        of_number = cache(lambda n: eqx.filter_jit(partial(self.outputs, n)))
        return lambda n, *x: of_number(n)(*x)

    def error(self, saved) -> float:
        """The largest error of what was saved."""
        exact, worst = reference(self.row["system"], self.row["friction"]), 0.0
        for ts, ys in saved:
            taken = np.isfinite(np.asarray(ts))
            assert np.any(taken)
            for t, i in zip(np.asarray(ts)[taken], np.flatnonzero(taken), strict=True):
                y = flat(jtu.tree_map(lambda x, i=i: x[i], ys))
                # A time of single precision is where the solution was asked for.
                worst = max(worst, np.max(np.abs(y - exact(t)[0])))
        return worst


def successful(result) -> bool:
    return bool(result == dfx.RESULTS.successful)


def check_order(run: Run, claimed: float, rounding: float):
    """The slope over the three smallest steps with errors above rounding."""
    solve, errors = run.compiled, {}
    least = 24 if run.row["scheme"].name.startswith("multistep") else 4
    if run.row["friction"].jumps and not run.way.between:
        # The kink ends a step but is not named: interpolation goes across it.
        least = max(least, 12)
    numbers = [n for n in NUMBERS if n >= least]
    if run.way.prescribed:
        numbers = [8, 12, 16, 24]
    if run.way.between:  # Multiples, so that steps of all spans become shorter.
        numbers = [6, 12, 18, 24, 36, 48, 72, 96, 144, 192]
    if "density" in run.way.name:
        # The errors of polynomials within steps depend on where the saved times are.
        numbers = sorted({5, 7, 10, *numbers})
    for n in numbers:
        saved, result = solve(n, run.system, run.y0)
        if not successful(result):
            continue
        error = run.error(saved)
        if error < 5 * rounding and errors:
            break
        errors[n] = error
    assert errors, "no solve was successful"
    assert min(errors.values()) < 0.1
    # The errors of Tao's copies oscillate, and those of a kink or of variable steps
    # depend on where the last step, or that of the kink, ends.
    uneven = run.row["friction"].kind == "drag" and run.row["system"].size == 1
    uneven |= run.row["scheme"].name.startswith("Tao") or "density" in run.way.name
    uneven |= run.way.between or run.way.prescribed  # as those between saved times
    number = 6 if uneven else 3
    last = sorted(errors)[-number:]
    drop = (last[-1] / last[0]) ** claimed
    if len(last) < 3 or errors[last[0]] < max(30, 10 * drop) * rounding:
        # Too accurate for its order to be seen.
        return
    x, y = np.log(last), np.log([errors[n] for n in last])
    slopes = -np.diff(y) / np.diff(x)
    order = max(-np.polyfit(x, y, 1)[0], np.min(slopes))
    allowed = 0.4 if claimed < 6 else 0.5 if claimed < 8 else 1.2
    assert order > claimed - allowed, f"order {order:.2f}, {errors}"


def check_bare(run: Run, rounding: float):
    """The end of the solve is that of the bare scheme in the loop of Diffrax."""
    row, way, n = run.row, run.way, 16
    steps = row["wrapper"].steps
    if steps is None or not way.end or not way.equal:
        return
    saved, result = run.compiled(n, run.system, run.y0)
    assert successful(result)
    dt0 = (run.t1 - run.t0) / (n * steps)
    sol = eqx.filter_jit(dfx.diffeqsolve)(
        run.system, run.bare, run.t0, run.t1, dt0, run.y0, max_steps=256
    )
    difference = np.max(np.abs(flat(last(saved[-1][1])) - flat(last(sol.ys))))
    if interpolates(run, run.solver) and not interpolates(run, run.bare):
        rounding = 1e-4  # the integrals of friction, here by quadrature of the bare one
    assert difference <= rounding, f"{difference:.1e} from the bare scheme"


def interpolates(run: Run, solver) -> bool:
    """Whether friction over a step is interpolated, for a step of many moves."""
    system = dps.extend.System(run.system, None, 1, run.y0)
    if system.friction is None or system.friction.is_known:
        return False
    return prepare._number(solver.scheme(system).moves) > prepare.NODES


def last(ys):
    return jtu.tree_map(lambda y: y[-1], ys)


def check_gradient(run: Run, tolerance: float):
    """A derivative along a direction, of all that is saved and all that is a number."""
    rng, n = np.random.default_rng(1), 8 if run.way.prescribed else 12.0
    # The loop of the package has no derivatives in times, and with another end of the
    # solve no step ends at a kink, or the number of those before it is another.
    timed = not (run.way.own or run.way.between or run.row["friction"].jumps)
    inputs = run.system, run.y0, *([run.t1] if timed else [])
    inputs, static = eqx.partition(inputs, eqx.is_inexact_array)
    if run.row["scheme"].name.startswith("multistep"):
        n = 4 * n  # not only the steps at the start
    singular = run.row["friction"].limit is not None

    def draw(x):
        dx = jnp.asarray(rng.standard_normal(x.shape) * 0.1, x.dtype)
        # A solve from a singularity only starts there, and from rest.
        dx = dx * (jnp.abs(x) + (0.0 if singular else 0.1))
        # A mass matrix stays symmetric.
        symmetric = x.ndim == 2 and x.shape[0] == x.shape[1] and jnp.all(x == x.T)
        return (dx + dx.T) / 2 if symmetric else dx

    along = jtu.tree_map(draw, inputs)

    def weigh(saved):
        total = 0.0
        for i, (ts, ys) in enumerate(saved):
            for k, y in enumerate(jtu.tree_leaves(ys)):
                finite = jnp.isfinite(ts).reshape(-1, *(1,) * (y.ndim - 1))
                weights = jnp.cos(jnp.arange(y.size) + i + k).reshape(y.shape)
                y = jnp.where(finite, y, 0).astype(float)
                total = total + jnp.sum(weights.astype(float) * y)
        return total

    whole = lambda inputs: eqx.combine(inputs, static)
    loss = lambda inputs: weigh(run.outputs(n, *whole(inputs))[0])
    if "forward" in run.row["gradient"].name:
        found = jax.jit(lambda x, dx: jax.jvp(loss, (x,), (dx,))[1])(inputs, along)
    else:
        bars = jax.jit(jax.grad(loss))(inputs)
        products = jtu.tree_map(
            lambda a, b: jnp.sum((a * b).astype(float)), bars, along
        )
        found = sum(jtu.tree_leaves(products))
    h = 1e-5
    move = lambda s: jtu.tree_map(lambda x, dx: x + s * h * dx, inputs, along)
    value = lambda s: weigh(run.compiled(n, *whole(move(s)))[0])
    wanted = (value(1) - value(-1)) / (2 * h)
    assert abs(found - wanted) <= tolerance * max(abs(wanted), 0.1), (
        f"{found}, {wanted}"
    )


# Ways that save nothing near the start, in either loop.
LATE = "end", "chunks", "density"


def check(row: dict):
    """One row: whether it keeps what it claims."""
    scheme, friction, way = row["scheme"], row["friction"], row["way"]
    combined = [row[k] for k in ("system", "friction", "scheme", "wrapper")]
    claimed = claim(*combined)
    assert not isinstance(claimed, Refused)
    late = way.name.removeprefix("Diffrax's loop, ") in LATE
    if not late and friction.limit is not None:
        claimed = min(claimed, 1)  # within the first step after a singular start
    if not way.equal and scheme.name.startswith("multistep"):
        claimed = min(claimed, 8)  # all steps are those of the start
    run = Run(row, row["gradient"].adjoint(), "float64")
    if catalogue.fails(*combined):
        assert not successful(run.compiled(16, run.system, run.y0)[1])
        return
    # Implicit schemes are as accurate as their root finder.
    rounding = 1e-9 if scheme.implicit else 1e-11
    # The first saved time is within the first step, however short the others are.
    first = way.prescribed and friction.limit is not None
    jumps = friction.jumps and not (way.equal or way.between)
    # Stages beyond a jump: of order one in the mean, but not from step to step.
    beyond = row["system"].jumps and not (scheme.inside and row["wrapper"].inside)
    if not way.order or first or jumps or beyond:
        saved, result = run.compiled(16, run.system, run.y0)
        assert successful(result)
        # Twenty times the tolerance of `HalfSolver`.
        assert run.error(saved) < 5e-3 * (40 if claimed == 1 or beyond else 1)
    elif row["precision"] == "float64":
        check_order(run, claimed, rounding if scheme.implicit else 2e-13)
    if row["precision"] == "float64":
        check_bare(run, rounding)
        # A controller does not differentiate the steps that it chooses.
        if way.order:
            check_gradient(run, 1e-4 if scheme.implicit else 1e-6)
        return
    if beyond:  # By rounding, on either side of it.
        return
    single = Run(row, run.adjoint, "float32")
    (saved, result), (exact, _) = (
        x.compiled(32, x.system, x.y0) for x in (single, run)
    )
    if row["wrapper"].composes and friction.limit is not None:
        # From a singularity on, what goes back in time may amplify too much.
        if not successful(result):
            return
    assert successful(result)
    for (_, y), (_, z) in zip(saved, exact, strict=True):
        assert all(x.dtype == jnp.float32 for x in jtu.tree_leaves(y))
        assert all(jtu.tree_leaves(jtu.tree_map(_near, y, z)))


def _near(y, z):
    y, z = np.asarray(y, float), np.asarray(z, float)
    taken = np.isfinite(z)
    return np.max(np.abs(y[taken] - z[taken]), initial=0) < 2e-4


# Which are tried when.


def rows() -> list:
    chosen = [id(row) for row in sample()]
    marks = lambda row: () if id(row) in chosen else pytest.mark.slow
    name = lambda row: " | ".join(map(str, row.values()))
    return [pytest.param(x, id=name(x), marks=marks(x)) for x in covering()]


@pytest.mark.variants(10**6)  # marked above
@pytest.mark.parametrize("row", rows())
def test_pair(row, record_property):
    with jax.numpy_dtype_promotion("strict"), jax.numpy_rank_promotion("raise"):
        check(row)
    record_property("pairs", sorted(pairs(row)))


def test_all_that_is_exported_is_in_the_catalogue():
    def classes(x):
        yield type(x)
        if dataclasses.is_dataclass(x):
            for field in dataclasses.fields(x):
                yield from classes(getattr(x, field.name))
        elif isinstance(x, list | tuple):
            for y in x:
                yield from classes(y)

    schemes = [scheme.solver for scheme in catalogue.SCHEMES]
    wrapped = [wrapper.wrap(dps.Strang()) for wrapper in catalogue.WRAPPERS]
    systems = [build(system, catalogue.FRICTION[0]) for system in catalogue.SYSTEMS]
    laws = [x.laws(catalogue.SYSTEMS[6]) for x in catalogue.FRICTION]
    found = {x.__name__ for x in classes([schemes, wrapped, systems, laws])}
    public = {name for name, x in vars(dps).items() if isinstance(x, type)}
    missing = {name for name in public - found if not name.startswith("Abstract")}
    assert missing == catalogue.ELSEWHERE


def test_the_table_of_orders():
    page = pathlib.Path(__file__).parents[1] / "docs" / "friction.md"
    assert orders.table() in page.read_text(), "Print it by `python tests/orders.py`."


def test_deliberate_errors_apply():
    package = pathlib.Path(dps.__file__).parent
    for mutant in deliberate_errors.MUTANTS:
        assert mutant.old in (package / mutant.file).read_text(), mutant.name
