"""Figures of what one looks at first. They need Matplotlib."""

from typing import Any

import diffrax as dfx
import jax
import numpy as np
from jaxtyping import PyTree

from .._step_size._solution import check_times, scaled_error, Solution
from .._system._base import AbstractSystem
from ._energy import checked, energy, energy_error
from ._work_precision import Solve, WorkPrecision


def plot_energy(
    system: AbstractSystem, sol: dfx.Solution, args: PyTree = None, axes: Any = None
):
    """The energy over time, and the error of its balance.

    **Arguments:**

    - `system`, `args`: as in `diffeqsolve`.
    - `sol`: the solution, saved at several times.
    - `axes`: two axes of Matplotlib, one above the other. Defaults to those of a new
        figure.

    **Returns:**

    The two axes.

    **Raises:**

    `ValueError` if the solution is a batch.
    """
    if axes is None:
        axes = _pyplot().subplots(2, sharex=True, layout="constrained")[1]
    above, below = axes
    assert sol.ts is not None and sol.ys is not None
    above.plot(sol.ts, energy(system, sol.ts, sol.ys, args))
    above.set_ylabel("energy $E$")
    below.plot(sol.ts, energy_error(system, sol.ts, sol.ys, args))
    below.set(xlabel="time $t$", ylabel="error of the energy balance")
    return axes


def plot_phase(sol: dfx.Solution, axes: Any = None, most: int = 6):
    """The phase portrait: momentum against position, a line for each degree of freedom.

    **Arguments:**

    - `sol`: the solution, saved at several times.
    - `axes`: axes of Matplotlib. Defaults to those of a new figure.
    - `most`: the largest number of degrees of freedom to draw, the first ones.

    **Returns:**

    The axes.

    **Raises:**

    `ValueError` if the solution is a batch.
    """
    assert sol.ts is not None and sol.ys is not None
    checked(sol.ts, sol.ys)
    axes = _axes(axes)
    rows = [np.asarray(x).reshape(len(x), -1) for x in jax.tree.leaves(sol.ys)]
    half = len(rows) // 2
    q, p = (np.concatenate(x, axis=1) for x in (rows[:half], rows[half:]))
    for i in range(min(q.shape[1], most)):
        axes.plot(q[:, i], p[:, i], label=f"{i + 1}")
    if q.shape[1] > 1:
        # Beside the lines, which may be anywhere.
        beside = {"loc": "center left", "bbox_to_anchor": (1, 0.5)}
        axes.legend(title="degree\nof freedom", **beside)
    axes.set(xlabel="position $q$", ylabel="momentum $p$")
    return axes


def plot_convergence(solve: Solve, t0, t1, order: int, axes: Any = None, solves=6):
    """The error against the step, and the slope of the claimed order.

    **Arguments:**

    - `solve`: a function of the step `dt0` that returns a `diffrax.Solution`.
    - `t0`, `t1`: the start and the end of the solve.
    - `order`: the order to compare with, for example `solver.order(system)`.
    - `axes`: axes of Matplotlib. Defaults to those of a new figure.
    - `solves`: the number of steps that are compared, each half of the last; one more
        solve is the reference.

    **Returns:**

    The axes.

    **Raises:**

    `ValueError` if the times are not valid or fewer than two solves are finite.
    """
    axes = _axes(axes)
    t0, t1 = check_times(t0, t1, "plot_convergence")
    numbers = [8 * 2**k for k in range(solves + 1)]
    found = [Solution.of(n, solve, (t1 - t0) / n) for n in numbers]
    finest = found[-1]
    points = [
        (abs(t1 - t0) / x.number, scaled_error(x.leaves, finest.leaves, 0.0, 1.0))
        for x in found[:-1]
        if x.finite and finest.finite
    ]
    points = [(h, error) for h, error in points if error > 0]
    if len(points) < 2:
        raise ValueError(
            "`plot_convergence` found fewer than two finite solutions. Check that the "
            "solve allows enough steps (`max_steps=None`)."
        )
    steps, errors = (np.array(x) for x in zip(*points, strict=True))
    axes.loglog(steps, errors, "o-", label="measured")
    # Through the point in the middle, away from rounding and instability.
    middle = len(steps) // 2
    slope = errors[middle] * (steps / steps[middle]) ** order
    axes.loglog(steps, slope, "k--", label=f"order {order}")
    axes.set(xlabel="step $h$", ylabel="largest error")
    axes.legend()
    return axes


def plot_work_precision(result: WorkPrecision, axes: Any = None):
    """The time of each solve against its error.

    **Arguments:**

    - `result`: of `diagnostics.work_precision`.
    - `axes`: axes of Matplotlib. Defaults to those of a new figure.

    **Returns:**

    The axes.
    """
    axes = _axes(axes)
    for name in dict.fromkeys(run.name for run in result.runs):
        runs = [run for run in result.runs if run.name == name]
        errors, times = [run.error for run in runs], [1e3 * run.seconds for run in runs]
        axes.loglog(errors, times, "o-", label=name)
    axes.set(xlabel="largest error over the tolerance", ylabel="time (ms)")
    axes.legend()
    return axes


def _axes(axes: Any):
    return _pyplot().subplots(layout="constrained")[1] if axes is None else axes


def _pyplot():
    try:
        import matplotlib.pyplot
    except ImportError as e:
        raise ImportError(
            "The figures of `diagnostics` need Matplotlib: `pip install matplotlib`."
        ) from e
    return matplotlib.pyplot
