"""MuJoCo, an engine in C, beside solvers of this package, where it is installed."""

import importlib
from functools import partial
from typing import Any

import equinox as eqx
import numpy as np
from _report import Table
from _solve import last, solve
from _timing import interleaved


def _engine() -> Any:
    """MuJoCo, or `None` where it is not installed."""
    try:
        return importlib.import_module("mujoco")
    except ImportError:
        return None


def _at(mujoco, model, q):
    data = mujoco.MjData(model)
    data.qpos[:] = q
    return data


@eqx.filter_jit
def _end(system, t1, y0, solver, dt0):
    return last(solve(system, solver, 0.0, t1, dt0, y0))


def mujoco_tables(problems, solvers, quick):
    """Errors and times of MuJoCo's integrators, and of ours on the same equations.

    A problem is the XML of a model, our system, its initial state and the final time.
    MuJoCo loads a model once; a time is that of its steps.
    """
    mujoco = _engine()
    if mujoco is None:
        print("\nMuJoCo is not installed: pip install mujoco")
        return
    kinds = mujoco.mjtIntegrator
    integrators = {
        "Euler": kinds.mjINT_EULER,
        "implicitfast": kinds.mjINT_IMPLICITFAST,
        "RK4": kinds.mjINT_RK4,
    }
    for name, (xml, system, (q0, p0), t1) in problems.items():
        model = mujoco.MjModel.from_xml_string(xml)

        def simulate(integrator, steps, model=model, q0=q0, t1=t1):
            model.opt.integrator, model.opt.timestep = integrator, t1 / steps
            data = _at(mujoco, model, q0)
            mujoco.mj_step(model, data, nstep=steps)
            return data.qpos.copy(), data.qvel.copy()

        exact = simulate(kinds.mjINT_RK4, 40_000 if quick else 200_000)
        size = max(np.max(np.abs(x)) for x in exact)

        def error(found, exact=exact, size=size):
            pairs = zip(found, exact, strict=True)
            return max(np.max(np.abs(x - y)) for x, y in pairs) / size

        table = Table(
            f"MuJoCo, {name}, to t = {t1}",
            *("integrator:<24", "steps:>7", "error:>9.1e", "milliseconds:>13.3f"),
        )
        calls = {}
        for label, kind in integrators.items():
            for steps in (1000, 4000, 16000):
                calls[f"MuJoCo {label}", steps] = partial(simulate, kind, steps)
        run = partial(_end, system, t1, (q0, p0))
        for label, solver in solvers.items():
            for steps in (50, 200, 800):
                calls[label, steps] = partial(run, solver, t1 / steps)
        timings = interleaved(calls, 3 if quick else 9)
        for (label, steps), timing in timings.items():
            found = timing.result
            if not label.startswith("MuJoCo"):
                found = found[0], system.velocity(0.0, *found)
            off = error([np.asarray(x) for x in found])
            table.row(label, str(steps), off, 1e3 * timing.median)


def mujoco_mass(xml, q):
    """MuJoCo's mass matrix at a place, or `None` where MuJoCo is not installed."""
    mujoco = _engine()
    if mujoco is None:
        return None
    model = mujoco.MjModel.from_xml_string(xml)
    data = _at(mujoco, model, q)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    for column, unit in zip(mass, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return mass
