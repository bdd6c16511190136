"""Gradients by running the scheme backwards.

The inverse of a list of kicks and drifts is the list backwards, so that the states of a
solve need not be stored for its gradient: each is rebuilt from the one after it, and
cotangents are pulled back through the step between them.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax as dfx
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.lax as lax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, PyTree

from ._misc import as_positive, opened, tree_sub, tree_sum
from ._term import View, view


class ReversibleAdjoint(dfx.AbstractAdjoint):
    r"""Exact gradients in constant memory, by running the scheme backwards.

    The gradient of the numbers that were computed ("discretise, then optimise"): that
    of `diffrax.RecursiveCheckpointAdjoint`, to rounding, at the cost of two to four
    solves however many steps there are. The forward pass is that of a solve without
    gradients.

    For every solver of this package that can be reversed, with
    `diffrax.ConstantStepSize` or `diffrax.StepTo`, with any `SaveAt`, and with respect
    to `y0`, `args`, all that is inside the term, and all that a function of these or of
    `SaveAt(fn=...)` closes over. Everything else is refused, in favour of
    `diffrax.RecursiveCheckpointAdjoint`: events, adaptive steps, derivatives with
    respect to times. Second derivatives are had by forward mode over reverse mode,
    `jax.jvp` of `jax.grad`.

    Damping loses information: on the way back rounding grows by $e^{\eta(t_1) -
    \eta(t_0)}$. Where that is too much, or the start is missed on arrival there, the
    solve is repeated, and states are kept along the way from which the way back
    restarts. Each arrival at a known state measures the error of the states rebuilt,
    and a gradient made of states with an error beyond `tol` raises an error.
    """

    checkpoints: int = 128
    tol: float | None = None

    def __check_init__(self):
        if not isinstance(self.checkpoints, int) or self.checkpoints < 0:
            raise ValueError(
                "`ReversibleAdjoint(checkpoints=...)` must be a Python integer, zero "
                f"or more, but got {self.checkpoints!r}."
            )
        if self.tol is not None:
            as_positive(self.tol, "`ReversibleAdjoint(tol=...)`")

    def loop(
        self,
        *,
        args,
        terms,
        solver,
        saveat,
        init_state,
        passed_solver_state,
        passed_controller_state,
        throw,
        **rest,
    ):
        del passed_solver_state, throw
        system = view(terms, args)
        _check(solver, rest["stepsize_controller"], rest["event"])
        if passed_controller_state:
            raise ValueError(_refuse("a `controller_state`"))
        y, carry = init_state.y, init_state.solver_state
        if init_state.made_jump is not False:
            # What is carried is stale then, and is made anew before the first step.
            restart = lambda: solver.start(system, system.time(rest["t0"]), y)
            carry = lax.cond(init_state.made_jump, restart, lambda: carry)
        fns = _fns(saveat)
        rest |= dict(
            solver=solver,
            terms=eqx.tree_at(_hamiltonian, terms, None),
            saveat=eqx.tree_at(_fns, saveat, [None] * len(fns)),
            init_state=eqx.tree_at(
                _start, init_state, (None, None, False), is_leaf=_is_none
            ),
        )
        # What functions close over is differentiated like all else.
        parameters = opened((system, fns))
        out = _solve(_Inputs((y, carry), parameters, rest), self)
        # To JAX all that comes out of a custom rule has a derivative, integers too.
        out, counts = eqx.partition(out, eqx.is_inexact_array)
        return eqx.combine(out, eqxi.nondifferentiable_backward(counts))


ReversibleAdjoint.__init__.__doc__ = r"""**Arguments:**

- `checkpoints`: how many states may be kept along the way, besides its two ends. It
    takes the memory of as many states. With 0 the solve is never repeated. Defaults
    to 128, enough for an increment of $\eta$ of 1000 in `float64`, and of a few hundred
    in `float32`.
- `tol`: the largest error of a rebuilt state, relative to the size of the state.
    Defaults to the precision of the state to the power 2/3: 4e-11 in `float64`, 2e-5
    in `float32`.

**Raises:**

`ValueError` if either is out of range, and when the solve is traced if it is one that
cannot be reversed. `RuntimeError` when the gradient is computed, if a state that is
known was missed by more than `tol`.
"""


def _refuse(what: str) -> str:
    return (
        f"`ReversibleAdjoint` does not support {what}. Use "
        "`diffrax.RecursiveCheckpointAdjoint()` instead."
    )


def _check(solver, controller, event) -> None:
    # Diffrax's wrappers of solvers pass for what they wrap, but have no reverse.
    if getattr(solver, "reverse", None) is None:
        what = f"`{type(solver).__name__}`, of which no reverse is known"
        raise ValueError(_refuse(what))
    if type(controller) not in (dfx.ConstantStepSize, dfx.StepTo):
        raise ValueError(
            _refuse(
                f"`{type(controller).__name__}`: only `diffrax.ConstantStepSize()` and "
                "`diffrax.StepTo(ts)` make steps that do not depend on the state"
            )
        )
    if event is not None:
        raise ValueError(_refuse("events"))


class _Inputs(NamedTuple):
    start: tuple[PyTree, PyTree]  # the state, and what the solver carries besides
    parameters: tuple[View, list[Callable]]  # the system, and functions to be saved
    rest: dict[str, Any]  # all that is not differentiated


# Where these are in what Diffrax passes on.
_is_none = lambda x: x is None
_is_sub = lambda x: isinstance(x, dfx.SubSaveAt)
_subs = lambda saveat: jtu.tree_leaves(saveat.subs, is_leaf=_is_sub)
_fns = lambda saveat: [sub.fn for sub in _subs(saveat)]
_hamiltonian = lambda terms: terms.term.hamiltonian
_start = lambda state: (state.y, state.solver_state, state.made_jump)


def _forward(inputs: _Inputs):
    """Diffrax's own loop, as for a solve without gradients."""
    system, fns = inputs.parameters
    init_state, saveat = inputs.rest["init_state"], inputs.rest["saveat"]
    start = (*inputs.start, False)
    changed = dict(
        terms=eqx.tree_at(
            _hamiltonian, inputs.rest["terms"], system.hamiltonian, is_leaf=_is_none
        ),
        saveat=eqx.tree_at(_fns, saveat, fns, is_leaf=_is_none),
        init_state=eqx.tree_at(_start, init_state, start, is_leaf=_is_none),
    )
    return dfx.ForwardMode().loop(
        **(inputs.rest | changed),
        args=system.args,
        throw=None,
        passed_solver_state=None,
        passed_controller_state=None,
    )


@eqx.filter_custom_vjp
def _solve(inputs: _Inputs, adjoint: ReversibleAdjoint):
    return _forward(inputs)


@_solve.def_fwd
def _solve_fwd(perturbed: _Inputs, inputs: _Inputs, adjoint: ReversibleAdjoint):
    if any(jtu.tree_leaves(perturbed.rest)):
        raise ValueError(
            _refuse(
                "derivatives with respect to times (`t0`, `t1`, `dt0`, `ts`) or to the "
                "solver"
            )
        )
    # Not `_solve`, so that forward mode can be taken of this.
    out = _forward(inputs)
    return out, out[0]


@_solve.def_bwd
def _solve_bwd(final, cotangents, perturbed: _Inputs, inputs: _Inputs, adjoint):
    way = _WayBack(final, cotangents[0], perturbed, inputs)
    eps = max(jnp.finfo(x.dtype).eps for x in jtu.tree_leaves(final.y))
    tol = float(eps) ** (2 / 3) if adjoint.tol is None else adjoint.tol
    most = adjoint.checkpoints + 1
    end = way.end()
    hopeless = ~(way.amplification() * float(eps) <= tol)

    def again(x):
        _, miss, tried = x
        return (tried == 0) | (~(miss <= tol) & (tried < most))

    def attempt(x):
        _, _, tried = x
        parts = jnp.where((tried == 0) & ~hopeless, 1, most)
        return *way.back_to_start(end, parts, most), parts

    nothing = (end, jnp.zeros(()), jnp.asarray(0))
    start, miss, _ = lax.while_loop(again, attempt, nothing)
    start = way.start(start)
    # A solve that diverged has a gradient of NaN anyway.
    finite = [jnp.all(jnp.isfinite(x)) for x in jtu.tree_leaves(final.y)]
    missed = ~(miss <= tol) & jnp.all(jnp.stack(finite))
    bar, gradient = eqx.error_if(
        (start.bar, start.gradient),
        missed,
        "`ReversibleAdjoint` rebuilt the states of this solve with an error beyond its "
        "`tol`: damping or instability amplifies rounding on the way back. Keep more "
        "states along the way, `ReversibleAdjoint(checkpoints=...)`, or use "
        "`diffrax.RecursiveCheckpointAdjoint()`.",
    )
    return _Inputs(bar, gradient, jtu.tree_map(lambda _: None, inputs.rest))


class _Place(NamedTuple):
    """How far the way back has got."""

    n: Array
    t: Array
    state: tuple[PyTree, PyTree]
    # The cotangents of the state, and of the parameters so far.
    bar: tuple[PyTree, PyTree]
    gradient: PyTree
    # For each of `SaveAt(subs=...)`, how much is left of its `ts` and of all it saved.
    left: list[tuple[Array, Array]]


class _WayBack:
    """From the end of a solve to its start, with the cotangents."""

    def __init__(self, final, cotangents, perturbed: _Inputs, inputs: _Inputs):
        rest = inputs.rest
        self.solver, self.t0, self.final = rest["solver"], rest["t0"], final
        self.time = _clock(
            rest["stepsize_controller"], self.t0, rest["t1"], rest["dt0"]
        )
        self.first, (self.system, _) = inputs.start, inputs.parameters
        self.wanted, _ = perturbed.parameters
        self.moved, self.fixed = eqx.partition(inputs.parameters, perturbed.parameters)
        # What is saved, for each of `SaveAt(subs=...)`, and its cotangents.
        saveat = rest["saveat"]
        structure = jtu.tree_structure(saveat.subs, is_leaf=_is_sub)
        self.saves = saves = structure.flatten_up_to(final.save_state)
        bars = structure.flatten_up_to(cotangents.save_state)
        self.subs = _subs(saveat)
        self.saved = [
            _materialise(save.ys, bar.ys) for save, bar in zip(saves, bars, strict=True)
        ]
        self.dense = _materialise(final.dense_infos, cotangents.dense_infos)
        self.carried = _materialise(final.solver_state, cotangents.solver_state)

    def end(self) -> _Place:
        y, carry, n = self.final.y, self.final.solver_state, self.final.num_steps
        bar = jtu.tree_map(jnp.zeros_like, y), self.carried
        gradient = jtu.tree_map(jnp.zeros_like, self.moved)
        left = [
            _saved(sub, save, n)
            for sub, save in zip(self.subs, self.saves, strict=True)
        ]
        place = _Place(n, self.time(n), (y, carry), bar, gradient, left)
        for i, sub in enumerate(self.subs):
            # It may have been saved as a step already.
            if sub.t1 and sub.steps != 1:
                here = sub.steps == 0 or n % sub.steps != 0
                bar = self.saved_at(i, left[i][1], here)
                place = self.add(place, self.pull_saved(i, place.t, y, bar))
        return place

    def start(self, place: _Place) -> _Place:
        """All that is left was saved here, which is more than one state only if the
        solve has no length."""
        for i, (_, left) in enumerate(place.left):
            bar = jtu.tree_map(lambda x, n=left: _sum_of_first(n, x), self.saved[i])
            place = self.add(place, self.pull_saved(i, place.t, place.state[0], bar))
        return place

    def unsave(self, place: _Place, i: int, pred) -> _Place:
        """Take back the last that was saved, if it was saved here."""
        times, left = place.left[i]
        left = left - jnp.where(pred, 1, 0)
        bar = self.saved_at(i, left, pred)
        place = self.add(place, self.pull_saved(i, place.t, place.state[0], bar))
        return place._replace(
            left=[*place.left[:i], (times, left), *place.left[i + 1 :]]
        )

    def saved_at(self, i: int, index, pred):
        return jtu.tree_map(lambda x: jnp.where(pred, x[index], 0), self.saved[i])

    def pull_saved(self, i: int, t, y, bar):
        """From what was saved of `y` to the parameters and `y` itself."""

        def saved(moved, y):
            system, fns = eqx.combine(moved, self.fixed)
            return eqx.filter(fns[i](t, y, system.args), eqx.is_inexact_array)

        return jax.vjp(saved, self.moved, y)[1](bar)

    def add(self, place: _Place, bars) -> _Place:
        gradient, y_bar = bars
        y, carry = place.bar
        return place._replace(
            gradient=tree_sum(place.gradient, gradient), bar=(tree_sum(y, y_bar), carry)
        )

    def step(self, place: _Place) -> _Place:
        """Back to the start of the step that ends here."""
        system, solver, end = self.system, self.solver, place.state
        n, t_end = place.n - 1, place.t
        t_start = self.time(n)
        t0, t1 = system.time(t_start), system.time(t_end)
        h = t1 - t0
        for i, sub in enumerate(self.subs):
            if sub.steps != 0:
                place = self.unsave(place, i, place.n % sub.steps == 0)
        start_bar = jtu.tree_map(jnp.zeros_like, place.bar)
        within = self.is_saved_within(place.left, n, t_start)
        if within is not False:
            # Of most steps nothing was saved between their ends, which is cheaper.
            unsave = lambda place: self.unsave_within(place, n, t_start, t0, t1, h)
            skip = lambda place: (place, start_bar)
            place, start_bar = lax.cond(within, unsave, skip, place)
        start, more, bar = solver.pull_back(
            system, self.wanted, t0, t1, h, end, place.bar
        )
        more = (more, jtu.tree_map(jnp.zeros_like, self.moved[1]))
        gradient, bar = tree_sum((place.gradient, bar), (more, start_bar))
        return _Place(n, t_start, start, bar, gradient, place.left)

    def is_saved_within(self, left, n, t_start):
        """Whether anything that is left was saved by interpolation in this step."""
        if self.dense is not None:
            return True
        within = False
        for sub, (times, _) in zip(self.subs, left, strict=True):
            if sub.ts is not None:
                within |= _is_within(sub.ts, times, n, t_start)
        return within

    def unsave_within(self, place: _Place, n, t_start, t0, t1, h):
        """Take back what was saved between the ends of a step, and find the cotangents
        of the state at its start."""
        end, solver = place.state, self.solver
        start = solver.reverse.advance(self.system, t1, t0, -h, *end)[:2]

        def look(moved, start, end):
            system, _ = eqx.combine(moved, self.fixed)
            return solver.dense_info(system, t0, t1, h, start, end)

        info, pull = jax.vjp(look, self.moved, start, end)
        info_bar = jtu.tree_map(jnp.zeros_like, info)
        if self.dense is not None:
            info_bar = jtu.tree_map(lambda x: x[n], self.dense)

        def take(i, x):
            times, saved, (gradient, info_bar) = x
            times, saved = times - 1, saved - 1
            t = self.subs[i].ts[times]
            at = lambda info: solver.interpolation_cls(
                t0=t_start, t1=place.t, **info
            ).evaluate(t)
            y, pull = jax.vjp(at, info)
            bar = jtu.tree_map(lambda x: x[saved], self.saved[i])
            more, y_bar = self.pull_saved(i, t, y, bar)
            return times, saved, tree_sum((gradient, info_bar), (more, *pull(y_bar)))

        seen, left = (place.gradient, info_bar), list(place.left)
        for i, sub in enumerate(self.subs):
            if sub.ts is not None:
                inside = lambda x, ts=sub.ts: _is_within(ts, x[0], n, t_start)
                times, saved, seen = lax.while_loop(
                    inside, partial(take, i), (*left[i], seen)
                )
                left[i] = times, saved
        gradient, info_bar = seen
        more, start_bar, end_bar = pull(info_bar)
        gradient, bar = tree_sum((gradient, place.bar), (more, end_bar))
        place = place._replace(gradient=gradient, bar=bar, left=left)
        return place, start_bar

    def back_to_start(self, place: _Place, parts, most: int) -> tuple[_Place, Array]:
        """Back to the start in a number of parts, each from a state that is known.

        And the largest error of a state on arrival at one that is known.
        """
        length = -(-place.n // parts)
        starts = lambda j: jnp.minimum(j * length, place.n)

        def forward(n, state):
            t0, t1 = (self.system.time(self.time(i)) for i in (n, n + 1))
            return self.solver.advance(self.system, t0, t1, t1 - t0, *state)[:2]

        def keep(j, states):
            last = jtu.tree_map(lambda x: x[j - 1], states)
            state = lax.fori_loop(starts(j - 1), starts(j), forward, last)
            return jtu.tree_map(lambda x, s: x.at[j].set(s), states, state)

        states = jtu.tree_map(
            lambda x: jnp.broadcast_to(x, (most, *x.shape)), self.first
        )
        states = lax.fori_loop(1, parts, keep, states)
        # Units in which positions and momenta compare: the largest there are of each.
        # What is carried besides may be all rounding, and is not compared.
        units = jtu.tree_map(
            lambda x, y: jnp.maximum(_largest(x), _largest(y)),
            *(states[0], place.state[0]),
        )

        def size(state):
            scaled = jtu.tree_map(
                lambda x, u: (_largest(x) / jnp.where(u > 0, u, 1)).astype(float),
                *(state[0], units),
            )
            return jtu.tree_reduce(jnp.maximum, scaled)

        def part(i, x):
            place, worst = x
            j = parts - 1 - i
            end, known = place.state, jtu.tree_map(lambda x: x[j], states)
            place = lax.while_loop(lambda p: p.n > starts(j), self.step, place)
            miss = size(tree_sub(place.state, known))
            miss = miss / jnp.maximum(size(known), size(end))
            return place._replace(state=known), jnp.maximum(worst, miss)

        return lax.fori_loop(0, parts, part, (place, jnp.zeros_like(size(self.first))))

    def amplification(self):
        """By how much the damping amplifies rounding on the way back."""
        damping = self.system.hamiltonian.damping
        if damping is None:
            return jnp.ones(())
        t0, t1 = self.system.time(self.t0), self.system.time(self.final.tprev)
        return jnp.exp(damping.increment(t0, t1 - t0))


def _clock(controller, t0, t1, dt0) -> Callable[[Array], Array]:
    """When step `n` starts, as the step size controllers of Diffrax would have it."""
    if isinstance(controller, dfx.StepTo):
        return lambda n: controller.ts[n]
    up, down = (jnp.asarray(sign * jnp.inf, t0.dtype) for sign in (1, -1))
    steps = jnp.ceil((t1 - t0) / jnp.nextafter(dt0, up))
    almost = t1
    for _ in range(100):
        almost = jnp.nextafter(almost, down)

    def time(n):
        t = t0 + (t1 - t0) * (n.astype(t0.dtype) / steps)
        t = jnp.where((n >= steps) | (t > almost), t1, t)
        # The first step alone is of the length that was asked for.
        return jnp.where(n == 1, jnp.minimum(t0 + dt0, t1), t)

    return time


def _materialise(like: PyTree, bar: PyTree) -> PyTree:
    """Cotangents of what can have them, also where there are none."""
    like = eqx.filter(like, eqx.is_inexact_array)
    return jtu.tree_map(lambda x, b: jnp.zeros_like(x) if b is None else b, like, bar)


def _is_within(ts, times, n, t_start):
    """Whether the last of so many `ts` is in the step that begins here."""
    return (times > 0) & ((n == 0) | (ts[times - 1] > t_start))


def _largest(x: Array) -> Array:
    return jnp.max(jnp.abs(x), initial=0)


def _saved(sub: dfx.SubSaveAt, save, n) -> tuple[Array, Array]:
    """How much of `ts`, and how much in all, was saved before the end of the solve.

    Counted anew: what Diffrax counts may include an end that was not saved.
    """
    times = jnp.asarray(0)
    if sub.ts is not None:
        # A solve of no length saves them all without counting.
        times = jnp.where(n == 0, len(sub.ts), save.saveat_ts_index)
    steps = 0 if sub.steps == 0 else n // sub.steps
    return times, times + steps + int(sub.t0)


def _sum_of_first(n: Array, x: Array) -> Array:
    mask = (jnp.arange(len(x)) < n).reshape(-1, *(1,) * (x.ndim - 1))
    return jnp.sum(jnp.where(mask, x, 0), axis=0)
