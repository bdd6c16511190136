"""How much of the package is entered while a step, a solve or a gradient is traced: the
functions, their files and their calls. Lambdas and comprehensions are not counted.

`python benchmarks/calls.py`; with `PYTHONPATH=` a folder with another version of the
package it counts there.
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax as dfx
import jax
import jax.numpy as jnp

import diffrax_presym as dps


jax.config.update("jax_enable_x64", True)
PACKAGE = str(Path(dps.__file__).parent)
Y0 = jnp.array([1.0, 0.5]), jnp.zeros(2)


def potential(t, q, args):
    return -jnp.sum(jnp.cos(q)) + jnp.sum(q**2) / 2


def system(friction=None, mass=None):
    return dps.MechanicalSystem(dps.QuadraticKinetic(mass), potential, friction)


def one_step(solver, system) -> Callable:
    def step(y):
        state = solver.init(system, 0.0, 0.1, y, None)
        out: Any = solver.step(system, 0.0, 0.1, y, None, state, False)
        return out[0]

    return lambda: jax.eval_shape(step, Y0)


def saved(p) -> Any:
    return dfx.diffeqsolve(
        *(system(dps.ConstantDamping(0.1)), dps.TunedRKN6(), 0.0, 1.0, 0.1),
        y0=(Y0[0], p),
        saveat=dfx.SaveAt(ts=jnp.linspace(0.0, 1.0, 7)),
        adjoint=dps.FixedStepAdjoint(),
        max_steps=None,
    )


CONSTANT = dps.ConstantDamping(0.1)
MATRIX = dps.ViscousDamping(jnp.array([[0.2, 0.1], [0.1, 0.3]]))
MASS = jnp.array([[2.0, 0.1], [0.1, 1.0]])
WALKS = {
    "leapfrog, constant friction": one_step(
        dps.PresymplecticLeapfrog(), system(CONSTANT)
    ),
    "TunedRKN6, matrix friction": one_step(dps.TunedRKN6(), system(MATRIX)),
    "7 saved times": lambda: jax.eval_shape(saved, Y0[1]),
    "their gradient": lambda: jax.eval_shape(
        jax.grad(lambda p: jnp.sum(saved(p).ys[0])), Y0[1]
    ),
    "Gauss, a matrix of masses": one_step(
        dps.PresymplecticGauss(3), system(CONSTANT, MASS)
    ),
}


def count(walk: Callable) -> tuple[int, int, int]:
    """The functions of the package that it enters, their files, and their calls."""
    calls = []
    jax.clear_caches()

    def profile(frame, event, arg):
        code = frame.f_code
        if event == "call" and code.co_filename.startswith(PACKAGE):
            if not code.co_name.startswith("<"):
                calls.append((code.co_filename, code.co_qualname))

    sys.setprofile(profile)
    try:
        walk()
    finally:
        sys.setprofile(None)
    functions = set(calls)
    return len(functions), len({file for file, _ in functions}), len(calls)


def main():
    print(f"{'traced':32}{'functions':>10}{'files':>8}{'calls':>8}")
    for name, walk in WALKS.items():
        functions, files, calls = count(walk)
        print(f"{name:32}{functions:10}{files:8}{calls:8}")


if __name__ == "__main__":
    main()
