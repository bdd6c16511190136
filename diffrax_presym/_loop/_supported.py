"""What the loop of the package takes; errors that say what to use for the rest."""

import diffrax as dfx

from .._scheme._base import AbstractPresymplecticSolver, Scheme
from .._step_size._density import StepDensityController
from . import _diffrax as private
from ._steps_between import StepsBetween


KNOWN = dfx.ConstantStepSize, dfx.StepTo, StepsBetween


def check_supported(solver, controller, event, saveat, passed_controller_state) -> None:
    what, instead = None, "`diffrax.RecursiveCheckpointAdjoint()`"
    # An instance of `HalfSolver` is one of the class of the solver in it.
    known = isinstance(solver, AbstractPresymplecticSolver)
    if not known or isinstance(solver, dfx.HalfSolver):
        what = f"`{type(solver).__name__}`, only solvers of this package"
    elif not isinstance(controller, (*KNOWN, StepDensityController)):
        what = (
            f"`{type(controller).__name__}`, only `ConstantStepSize`, `StepTo`, "
            "`StepsBetween` and `StepDensityController`"
        )
    elif event is not None:
        what = "events"
    elif saveat.dense:
        what = "dense output"
    elif not isinstance(controller, KNOWN) and _saves_both(saveat):
        what = "times and steps in one output of `StepDensityController`"
        instead = "`SaveAt(subs=[SubSaveAt(ts=...), SubSaveAt(steps=...)])`"
    elif isinstance(controller, KNOWN) and passed_controller_state:
        what = "a `controller_state`"
    if what is not None:
        raise ValueError(
            f"`FixedStepAdjoint` does not support {what}. Use {instead} instead."
        )


def _saves_both(saveat: dfx.SaveAt) -> bool:
    subs, _ = private.flatten_subs(saveat)
    return any(sub.steps and sub.ts is not None for sub in subs)


def check_history(solver, scheme: Scheme, controller) -> None:
    if scheme.has_history and isinstance(controller, StepDensityController):
        raise ValueError(
            f"`{type(solver).__name__}` needs equal steps. With `StepDensityController`"
            " use `TunedRKN6()` or `BlanesCasasRKN8()`."
        )
    if scheme.has_history and isinstance(controller, StepsBetween):
        raise ValueError(
            "Steps end at the times of `StepsBetween` because the motion is not smooth "
            f"there, where the history of `{type(solver).__name__}` is of no use. Use "
            "`TunedRKN6()` or `BlanesCasasRKN8()`."
        )
