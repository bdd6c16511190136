"""The split of a system that a scheme uses, or why there is none."""

from .._system._bound import System
from .._system._split import AbstractSplit
from ._base import AbstractPresymplecticSolver, refuse_constrained


def find_split(
    solver: AbstractPresymplecticSolver, kind: str, system: System
) -> AbstractSplit:
    """The split that a scheme uses; an error if the system has none of this kind."""
    split, name = system.split(kind), type(solver).__name__
    if split is not None:
        own, base = type(split), AbstractSplit
        omits = own.prepare is base.prepare and own.kick is base.kick
        if system.term.laws and omits:
            raise ValueError(
                f"`{own.__name__}` would omit the friction of this "
                f"`{system.name}`. Return `system.friction.prepare(t, h, order)` from "
                "`prepare(self, system, t, h, order)` of the split, and apply it in "
                "`drift`, as of `system.friction.flow(data, p)`."
            )
        return split
    if kind == "nystrom" and system.term.is_constrained:
        raise ValueError(
            f"`{name}` keeps its order on a manifold only without constraints, for "
            "friction at one rate for each array of momenta, and without a `force=f` "
            "of the velocity. Otherwise use `Strang()`, `BlanesMoan4()` or "
            "`BlanesMoan6()`, or compositions such as `SofroniouSpaletta(6, Strang())`."
        )
    refuse_constrained(solver, system)
    if kind == "shared":
        raise ValueError(
            f"`{name}` keeps its order only for a constant mass and at most one rate "
            "of constant friction. Write `MechanicalSystem(QuadraticKinetic(mass), "
            "potential, ConstantDamping(rate))`; otherwise use `TunedRKN6()`, "
            "`BlanesMoan6()` or `PresymplecticGauss()`."
        )
    if kind == "linear":
        raise ValueError(
            f"`{name}` keeps its order only for a linear force and at most one rate of "
            "constant friction. Write `MechanicalSystem(QuadraticKinetic(mass), "
            "QuadraticPotential(stiffness), ConstantDamping(rate))`; otherwise use "
            "`TunedRKN6()`, `BlanesMoan6()` or `PresymplecticGauss()`."
        )
    if kind == "separable":
        if system.split("any") is not None:
            raise ValueError(
                f"`{name}` would be implicit for this `{system.name}`. It is explicit "
                "for rates of friction, and with `QuadraticKinetic` for matrices, that "
                "depend on time alone, and without a `force=f` of the velocity. Use "
                "`Strang()` or `BlanesMoan4()`, which are explicit, or "
                "`PresymplecticGauss()`."
            )
        raise ValueError(
            f"This `{system.name}` is not separable, so `{name}` would be implicit. If "
            "the energy is a sum T(t, p) + V(t, q), give its parts: "
            "`MechanicalSystem(kinetic, potential)`. Otherwise use "
            "`PresymplecticGauss()`."
        )
    if system.split("any") is None:
        raise ValueError(
            f"`{name}` needs a system split into a kinetic part and a potential, but "
            f"this `{system.name}` is not. If its energy is a sum of the two, give its "
            "parts: `MechanicalSystem(kinetic, potential)`, which also takes a "
            "`force=f`. Any other energy has no such parts: use `PresymplecticGauss()`."
        )
    raise ValueError(
        f"`{name}` keeps its order only for a quadratic kinetic energy, written as "
        "`QuadraticKinetic(mass)`, or a quadratic potential, written as "
        "`QuadraticPotential(stiffness)`; and for friction that depends neither on "
        "positions nor on the speed, nor is a function `C(t, q, args)`, without a "
        "`force=f` of the velocity. Otherwise use `Strang()`, `BlanesMoan4()`, "
        "`BlanesMoan6()` or `PresymplecticGauss()`."
    )
