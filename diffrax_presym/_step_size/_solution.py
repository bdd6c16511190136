"""What a solve saved, and how far it is from another."""

import logging
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax as dfx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array

from .._results import is_of_failed_solve, STEP_DENSITY_MISSED


class Solution(NamedTuple):
    """What a solve saved, on the host."""

    number: int  # of steps that was asked for
    steps: int  # that were taken
    ts: np.ndarray  # all times
    leaves: list[np.ndarray]  # values, and times
    finite: bool
    order: int | None  # of the scheme, if that is known
    interpolates: bool = False  # between steps, at the cost of a third of one
    values: int = 0  # the number of leaves that are values
    missed: bool = False  # whether its steps were far from what their density asks for

    def expected(self, number: int) -> float:
        """The steps that a solve of another number takes, by this one."""
        return number * self.steps / self.number if self.finite else number

    @classmethod
    def of(cls, number: int, solve: Callable[[Array], Any], step) -> "Solution":
        # JAX logs a traceback where a solve fails, as a trial may.
        logger = logging.getLogger("jax._src.callback")
        disabled, logger.disabled = logger.disabled, True
        try:
            sol = solve(step)
            check_concrete(sol, "The solve")
            sol = jax.device_get(sol)
        except (RuntimeError, ValueError) as error:
            # As `diffeqsolve` raises if a solve fails, by the name of its type or, from
            # inside of `jax.jit`, in the text of another.
            text = f"{type(error).__name__} {error}"
            if "(t1 - t0) * dt0 >= 0" in text:
                raise ValueError(
                    "The solve runs in the other direction of time. `t0` and `t1` must "
                    "be those that it passes to `diffeqsolve`, in this order."
                ) from None
            if "EquinoxRuntimeError" not in text or not is_of_failed_solve(text):
                raise
            missed = dfx.RESULTS[STEP_DENSITY_MISSED] in text
            return cls(number, number, np.zeros(0), [], False, None, missed=missed)
        finally:
            logger.disabled = disabled
        if not isinstance(sol, dfx.Solution):
            raise ValueError(
                "The solve must return a `diffrax.Solution`, the result of "
                f"`diffeqsolve`, but returned {type(sol).__name__}."
            )
        if np.ndim(sol.stats["num_steps"]):
            raise ValueError(
                "The solve must be of one problem, but it is a batch. Choose the step "
                "for its most difficult member."
            )
        times = [np.asarray(t) for t in jax.tree.leaves(sol.ts)]
        values = [np.asarray(y) for y in jax.tree.leaves(sol.ys)]
        by_event = bool(sol.result == dfx.RESULTS.event_occurred)
        if not times or not (by_event or any(y.size for y in values)):
            raise ValueError(
                "The solve must save values at some times, for example by "
                "`SaveAt(t1=True)`, to find its error."
            )
        good = (dfx.RESULTS.successful, dfx.RESULTS.event_occurred)
        finite = any(bool(sol.result == x) for x in good)
        if finite and not all(np.all(np.isfinite(t)) for t in times):
            raise ValueError(
                "The solve must save at times that do not depend on the step. Write "
                "`SaveAt(t1=True)` or `SaveAt(ts=ts)`, with an event the first; and "
                "leave out times that are NaN, gaps in measured ones."
            )
        finite = finite and all(np.all(np.isfinite(y)) for y in values)
        order = sol.stats.get("order")
        return cls(
            number,
            int(sol.stats["num_steps"]),
            np.concatenate([np.ravel(t) for t in times]),
            [*values, *times],
            finite,
            None if order is None else int(order),
            bool(sol.stats.get("interpolated", False)),
            len(values),
            bool(sol.result == STEP_DENSITY_MISSED),
        )

    def relative_change(self, finer: "Solution") -> tuple[float, np.dtype]:
        """By how much another solution is different, relative to the size of what is
        saved, and the lowest precision of that."""
        pairs = zip(self.leaves, finer.leaves, strict=True)
        pairs = [x for x in pairs if np.issubdtype(x[1].dtype, np.floating)]
        precision = max((b.dtype for _, b in pairs), key=lambda x: np.finfo(x).eps)
        size = lambda x: np.max(np.abs(x), initial=0)
        change = lambda a, b: float(size(a - b) / max(size(b), 1e-300))
        return max(change(*pair) for pair in pairs), precision

    def check_precision(self, rtol: float, atol: float):
        """An error if what is saved is rounded to less than the tolerance, so that
        solves agree of which it says nothing."""
        for y in self.leaves[: self.values]:
            if not jnp.issubdtype(y.dtype, jnp.inexact):
                continue
            size, eps = np.abs(np.asarray(y, complex)), float(jnp.finfo(y.dtype).eps)
            if np.any(eps / 4 * size > atol + rtol * size):
                raise RuntimeError(
                    f"`choose_step` cannot reach this tolerance in {y.dtype}, to which "
                    "the solve rounds what it saves. Save it in a higher precision, or "
                    "use a larger tolerance."
                )


def scaled_error(
    leaves: list[np.ndarray], exact: list[np.ndarray], rtol: float, atol: float
) -> float:
    """The largest error of an entry, over the tolerance."""
    worst = 0.0
    for y, z in zip(leaves, exact, strict=True):
        z = np.asarray(z, np.result_type(z, float))
        error = np.abs(np.asarray(y, z.dtype) - z)
        scale = atol + rtol * np.abs(z)
        # Where both vanish, as for a coordinate at rest, there is no error.
        scaled = np.divide(
            *(error, scale), out=np.where(error > 0, np.inf, 0.0), where=scale > 0
        )
        worst = max(worst, float(np.max(scaled, initial=0)))
    return worst


def check_concrete(x, name: str):
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(x)):
        raise ValueError(
            f"{name} needs concrete numbers, but got traced ones: a step is chosen by "
            "solving several times. Do so outside of `jax.jit`, `jax.grad` and "
            "`jax.vmap`, and pass the result to the transformed function."
        )


def check_times(t0, t1, name: str) -> tuple[float, float]:
    check_concrete((t0, t1), f"`{name}`")
    if np.shape(t0) or np.shape(t1) or not np.isfinite(t1 - t0) or t0 == t1:
        raise ValueError(
            f"`{name}` needs two different finite times `t0` and `t1`, but got "
            f"{t0} and {t1}."
        )
    return float(t0), float(t1)


def check_number(x, name: str, positive: bool = False) -> float:
    check_concrete(x, f"`{name}`")
    try:
        value = float(x)
    except (TypeError, ValueError):
        value = math.nan
    if not 0 <= value < math.inf or (positive and value == 0):
        wanted = "a positive number" if positive else "a number that is not negative"
        raise ValueError(f"`{name}` must be {wanted}, but got {x!r}.")
    return value
