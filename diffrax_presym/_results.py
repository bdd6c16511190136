"""Why a solve failed, where `diffrax.RESULTS` has no entry for it.

Diffrax's loop takes entries of its own enumeration only, so these are added to it. The
two private fields that this uses are tested in `tests/test_diffrax_contract.py`.
"""

from typing import Any

import diffrax as dfx
import numpy as np


def _entry(name: str, message: str) -> Any:
    """A further entry of `diffrax.RESULTS`."""
    results: Any = dfx.RESULTS
    if name not in results._name_to_item:
        item = type(results.successful)
        index = np.array(len(results._index_to_message), np.int32)
        results._name_to_item[name] = item(index, results)
        results._index_to_message.append(message)
    return results._name_to_item[name]


def is_of_failed_solve(text: str) -> bool:
    """Whether that of an error is one of the reasons for which a solve fails."""
    results: Any = dfx.RESULTS
    return any(reason and reason in text for reason in results._index_to_message)


SUCCESSFUL: Any = dfx.RESULTS.successful
NONFINITE: Any = dfx.RESULTS.nonfinite  # pyright: ignore[reportAttributeAccessIssue]

FRICTION_TOO_STRONG = _entry(
    "friction_too_strong",
    "The friction over one step, the rate times the length of the step, is more than "
    "this scheme can resolve. Take shorter steps (`choose_step` finds them), or use "
    "`Strang()`, which is stable and right in positions, not in the velocities of "
    "what is damped so strongly, or `PresymplecticGauss(stages, root_finder)`.",
)
NOT_CONVERGED = _entry(
    "fixed_point_not_converged",
    "The fixed-point iteration of `PresymplecticGauss` did not converge in a step, or "
    "left the finite numbers: the step times the largest frequency of the system is "
    "too large, its friction is strong, or its mass matrix is not positive definite. "
    "Take shorter steps, or pass a root finder: "
    "`PresymplecticGauss(stages, optimistix.Newton(rtol, atol))`. With `throw=False` "
    "the last finite time in `ts` of `SaveAt(steps=True)` is the end of that step.",
)
FORCE_NOT_SOLVED = _entry(
    "force_not_solved",
    "The equation of a kick by a `force` of the velocity was not solved, or the state "
    "left the finite numbers, as by a parameter that is NaN. Otherwise the force is "
    "too stiff for the step, whose length times its slope by momentum must be below "
    "about 2; or there are constraints that are redundant, which "
    "`system.project(t0, y0, args)` detects. Take shorter steps; write what is linear "
    "in the velocity as "
    "`friction=ViscousDamping(C)`, also with a function `C(t, q, args)`; or use "
    "`PresymplecticGauss(stages, optimistix.Newton(rtol, atol))`, but on manifolds.",
)
TURNS_TOO_FAR = _entry(
    "turns_too_far",
    "The state left the finite numbers; or a rigid body, which had turned slowly, "
    "turns by more than three radians in a step within which values are saved, too far "
    "to interpolate them; or its momentum turns relative to it by more than half of a "
    "circle. Take shorter steps, or steps that end at all saved times: "
    "`stepsize_controller=StepsBetween(ts)`.",
)
ENERGY_NOT_DEFINED = _entry(
    "energy_not_defined",
    "At the end of a step, whose state is finite, the energy is not defined: the mass "
    "matrix of `LagrangianSystem` is not symmetric to rounding, or not positive "
    "definite; or positions of `BregmanHamiltonian` are outside of the domain of its "
    "mirror map, or its rates do not satisfy the conditions. Evaluate these at `y0`, "
    "and at the last finite state, of `SaveAt(steps=True)` with `throw=False`; if the "
    "state left the domain, take shorter steps.",
)
ROOT_NOT_FOUND = _entry(
    "root_not_found",
    "The root finder of `PresymplecticGauss` did not find the stages of a step: the "
    "step is too long, they leave the domain of the energy, or the tolerances of the "
    "root finder are below the rounding of the state. Take shorter steps, larger "
    "tolerances `optimistix.Newton(rtol, atol)`, or a larger `max_iterations`. With "
    "`throw=False` the last finite time in `ts` of `SaveAt(steps=True)` is the end of "
    "that step.",
)
MULTISTEP_UNSTABLE = _entry(
    "multistep_unstable",
    "`SymmetricMultistep` is unstable: the step times the highest frequency of the "
    "system is more than 0.63 (order 8) or 0.48 (order 10), or on eccentric orbits "
    "less. Take shorter steps, or use `TunedRKN6()`.",
)
OTHER_HISTORY = _entry(
    "other_history",
    "The `solver_state` is the history of another solution: its momentum is not that "
    "of `y0`. Pass the `solver_state` of the solve whose final state is `y0`, or pass "
    "`made_jump=True`, or omit it.",
)
OFF_MANIFOLD = {
    most: _entry(
        f"off_manifold_{most:.0e}",
        f"The initial state is off the manifold of the system by more than {most:.0e}, "
        "in positions, or relative to their size in velocities, off its tangent space: "
        "by `system.violation(t0, *y0, args)`. Pass `system.project(t0, y0, args)`, "
        "with `y0` in the precision of the times if that is higher.",
    )
    for most in (1e-8, 1e-5, 1e-2, 10.0)
}
CONSTRAINT_NOT_SOLVED = _entry(
    "constraint_not_solved",
    "Newton's method did not find the multipliers of the constraints in a step: the "
    "step is too long for the curvature of the constraint, the state left the finite "
    "numbers, the constraints are redundant, which `system.project(t0, y0, args)` "
    "detects, or with `lineax.Tridiagonal()` more than neighbours are coupled. Take "
    "shorter steps, or the default `linear_solver=None`.",
)
NOT_REVERSIBLE = _entry(
    "constraint_not_reversible",
    "The inverse of a step does not end where the step started: there are several "
    "positions on the constraint along its normals, and Newton's method found "
    "different ones. Take shorter steps.",
)
STEP_DENSITY_MISSED = _entry(
    "step_density_missed",
    "A step differs from `epsilon` times the step density at one of its ends by more "
    "than a factor of four: the density changes too much over a step. Reduce `epsilon` "
    "of `StepDensityController`.",
)
STEP_DENSITY_INVALID = _entry(
    "step_density_invalid",
    "The `density` of `StepDensityController` is not positive and finite at a state of "
    "the solve. Write one that is, such as `jnp.linalg.norm(y[0]) ** 1.5` for a "
    "distance that does not vanish. If the state itself is not finite, reduce "
    "`epsilon`.",
)
