"""Undocumented behaviour of Diffrax that this package relies on.

If one of these tests fails after an update of Diffrax, adapt
`diffrax_presym/_system/_bound.py` or `diffrax_presym/_loop/_diffrax.py` accordingly.
"""

import inspect
from typing import Any, ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from helpers import oscillator
from jax.core import Tracer

import diffrax_presym as dps
from diffrax_presym import _results
from diffrax_presym._loop import _diffrax as private


TERM = oscillator()
Y0 = (jnp.ones(1), jnp.ones(1))


class Seen(dict):
    """Compared by identity, as it may hold tracers."""

    __eq__ = object.__eq__
    __hash__: Any = object.__hash__


class Recorder(dfx.AbstractSolver):
    """Euler's method, which records its arguments."""

    term_structure: ClassVar = dfx.AbstractTerm
    interpolation_cls: ClassVar = dfx.LocalLinearInterpolation
    seen: "Seen" = eqx.field(static=True, default_factory=lambda: Seen())

    def order(self, terms):
        return 1

    def init(self, terms, t0, t1, y0, args):
        self.seen["init"] = terms

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        self.seen.update(step=terms, made_jump=made_jump)
        y1 = jax.tree.map(lambda y, f: y + (t1 - t0) * f, y0, terms.vf(t0, y0, args))
        return y1, None, dict(y0=y0, y1=y1), None, dfx.RESULTS.successful

    def func(self, terms, t0, y0, args):
        return terms.vf(t0, y0, args)


def record(recorder=None, **kwargs):
    recorder = Recorder() if recorder is None else recorder
    run = lambda: dfx.diffeqsolve(TERM, recorder, 0.0, -1.0, -0.1, Y0, **kwargs).ys
    eqx.filter_eval_shape(run)
    return recorder.seen


@pytest.mark.parametrize("call", ["init", "step"])
def test_the_term_arrives_in_a_wrapper_with_term_and_direction(call):
    wrapped = record()[call]
    assert not isinstance(wrapped, dps.MechanicalSystem) and isinstance(
        getattr(wrapped, "term", None), dps.MechanicalSystem
    ), "`diffeqsolve` no longer passes the term in a wrapper with `.term`."
    assert eqx.is_array(getattr(wrapped, "direction", None)), (
        "The wrapper of a term no longer has a `.direction`, the sign of time."
    )


@pytest.mark.parametrize("t1, sign", [(1.0, 1), (-1.0, -1)])
def test_direction_is_the_sign_of_time(t1, sign):
    class Compass(Recorder):
        def step(self, terms, t0, t1, y0, *args):
            _, *rest = super().step(terms, t0, t1, y0, *args)
            return (terms.direction * jnp.ones(1), jnp.abs(t1) * jnp.ones(1)), *rest

    sol = dfx.diffeqsolve(TERM, Compass(), 0.0, t1, sign * 0.25, Y0)
    assert sol.ys is not None
    direction, end = sol.ys
    assert direction == sign and end == abs(t1), (
        "The wrapper's `.direction` is no longer 1 or -1, a factor of the time."
    )


def test_made_jump_is_false_under_constant_step_sizes():
    assert record()["made_jump"] is False, (
        "`made_jump` is no longer the Python value `False` under `ConstantStepSize`: "
        "an unnecessary branch is traced."
    )


def test_made_jump_is_traced_under_controllers_that_jump():
    controller = dfx.ClipStepSizeController(
        dfx.PIDController(rtol=1.0, atol=1.0), jump_ts=jnp.array([-0.5])
    )

    class Estimating(Recorder):
        def step(self, *args):
            y1, _, dense, state, result = super().step(*args)
            return y1, jax.tree.map(jnp.zeros_like, y1), dense, state, result

    seen = record(Estimating(), stepsize_controller=controller)
    assert isinstance(seen["made_jump"], Tracer), (
        "`made_jump` is no longer an array under `ClipStepSizeController`."
    )


def test_the_term_of_backsolve_adjoint_is_called_adjoint_term():
    recorder = Recorder()

    @jax.grad
    def gradient(y0):
        adjoint = dfx.BacksolveAdjoint(solver=recorder)
        sol = dfx.diffeqsolve(TERM, dfx.Euler(), 0.0, 1.0, 0.1, y0, adjoint=adjoint)
        assert sol.ys is not None
        return jnp.sum(sol.ys[0])

    eqx.filter_eval_shape(gradient, Y0)
    inner = getattr(recorder.seen["init"], "term", recorder.seen["init"])
    assert type(inner).__name__ == "AdjointTerm", (
        "`BacksolveAdjoint` no longer solves an `AdjointTerm`, by whose name it is "
        "detected for an error message."
    )


class Interpolation(dfx.AbstractLocalInterpolation):
    """An interpolation that accepts and records any arguments."""

    t0: jax.Array
    t1: jax.Array
    given: dict

    def __init__(self, *args, **kwargs):
        Interpolating.built.append((args, kwargs))
        self.t0, self.t1, self.given = kwargs["t0"], kwargs["t1"], kwargs

    def evaluate(self, t0, t1=None, left=True):
        return self.given["y1"]


class Interpolating(Recorder):
    interpolation_cls: ClassVar = Interpolation
    built: ClassVar[list] = []


# Within the loop, and in dense output after it.
@pytest.mark.parametrize("saveat", [dict(ts=jnp.array([-0.5])), dict(dense=True)])
def test_interpolations_are_made_of_times_and_dense_info(saveat):
    Interpolating.built.clear()

    def run():
        saved = dfx.SaveAt(**saveat)
        sol = dfx.diffeqsolve(TERM, Interpolating(), 0.0, -1.0, -0.1, Y0, saveat=saved)
        return sol.evaluate(-0.5) if saved.dense else sol.ys

    eqx.filter_eval_shape(run)
    assert Interpolating.built, "`interpolation_cls` is no longer called."
    for args, kwargs in Interpolating.built:
        assert not args and set(kwargs) == {"t0", "t1", "y0", "y1"}, (
            "`interpolation_cls` is no longer called with `t0`, `t1` and the entries "
            "of `dense_info` as keyword arguments."
        )


@pytest.mark.parametrize("call", ["init", "step"])
def test_times_are_arrays_of_one_precision(call):
    times = []

    class Clock(Recorder):
        def init(self, terms, t0, t1, y0, args):
            times.extend((t0, t1) if call == "init" else ())

        def step(self, terms, t0, t1, *args):
            times.extend((t0, t1) if call == "step" else ())
            return super().step(terms, t0, t1, *args)

    # From Python numbers of several types, including an integer.
    run = lambda: dfx.diffeqsolve(TERM, Clock(), 0, 1.0, 0.1, Y0).ys
    eqx.filter_eval_shape(run)
    assert times and all(isinstance(t, jax.Array) for t in times), (
        "Times are no longer passed to a solver as arrays: Python numbers would be "
        "promoted, and have no `.dtype`."
    )
    assert {(t.shape, t.dtype) for t in times} == {((), jnp.dtype("float64"))}, (
        "Times are no longer passed to a solver in one floating-point precision."
    )


class Watching(dfx.AbstractAdjoint):
    """The adjoint of Diffrax, which keeps what it is given."""

    seen: Seen = eqx.field(static=True, default_factory=Seen)

    def loop(self, **kwargs):
        self.seen.update(kwargs)
        return dfx.DirectAdjoint().loop(**kwargs)


def watched(**kwargs):
    adjoint = Watching()
    options: dict[str, Any] = dict(adjoint=adjoint, max_steps=16) | kwargs
    run = lambda: dfx.diffeqsolve(TERM, Recorder(), 0.0, 1.0, y0=Y0, **options).stats
    eqx.filter_eval_shape(run)
    return adjoint.seen


CONTROLLERS = {
    "constant": dict(dt0=0.1),
    "given": dict(dt0=None, stepsize_controller=dfx.StepTo(jnp.linspace(0, 1, 4))),
}


@pytest.mark.parametrize("steps", CONTROLLERS.values(), ids=CONTROLLERS)
def test_what_an_adjoint_gets(steps):
    subs = [dfx.SubSaveAt(ts=jnp.array([0.5])), {"end": dfx.SubSaveAt(t1=True)}]
    seen = watched(saveat=dfx.SaveAt(subs=subs), **steps)
    arguments = set(inspect.signature(dps.FixedStepAdjoint.loop).parameters) - {"self"}
    assert set(seen) == arguments, "`AbstractAdjoint.loop` gets other arguments."
    state = seen["init_state"]
    missing = {
        *("y", "solver_state", "made_jump", "tprev", "num_steps", "result"),
        *("num_accepted_steps", "progress_meter_state", "save_state"),
        "controller_state",
    } - set(vars(state))
    assert not missing, f"The state of Diffrax's loop has no {missing}."
    flat, structure = private.flatten_subs(seen["saveat"])
    saves = structure.flatten_up_to(state.save_state)
    assert len(saves) == len(flat) == 2, "`save_state` has another structure."
    for save in saves:
        names = {"ts", "ys", "save_index", "saveat_ts_index"}
        assert set(vars(save)) >= names, "What is saved is stored otherwise."
    first = jax.tree.leaves(state.controller_state)[0]
    assert jnp.issubdtype(jnp.result_type(first), jnp.integer), (
        "The first number of the state of a controller is no longer its step."
    )


def test_the_state_at_the_end_of_a_loop():
    """That of the package differs from Diffrax's in rounding alone."""
    saveat = dfx.SaveAt(
        t0=True, ts=jnp.array([0.3, 0.6]), t1=True, controller_state=True
    )
    ours, theirs = (
        dfx.diffeqsolve(
            *(TERM, dps.BlanesMoanRKN4(), 0.0, 1.0, 0.25, Y0),
            saveat=saveat,
            adjoint=adjoint,
        )
        for adjoint in (dps.FixedStepAdjoint(), dfx.DirectAdjoint())
    )
    assert jax.tree.structure(ours.ys) == jax.tree.structure(theirs.ys)
    assert ours.result == theirs.result
    same = jax.tree.map(jnp.allclose, (ours.ts, ours.ys), (theirs.ts, theirs.ys))
    assert jax.tree.all(same)
    assert eqx.tree_equal(ours.controller_state, theirs.controller_state, rtol=1e-12)
    assert set(theirs.stats) <= set(ours.stats)
    assert all(ours.stats[k] == theirs.stats[k] for k in theirs.stats)


def test_further_results_are_entries_of_the_enumeration_of_diffrax():
    result = _results.FRICTION_TOO_STRONG
    assert isinstance(result, dfx.RESULTS)
    assert result is dfx.RESULTS.friction_too_strong  # pyright: ignore
    assert dfx.RESULTS[result].startswith("The friction over one step")
    assert "friction_too_strong" in dfx.RESULTS._name_to_item
    assert len(dfx.RESULTS._index_to_message) == len(dfx.RESULTS)
