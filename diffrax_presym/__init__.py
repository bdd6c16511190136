"""Presymplectic integrators for Diffrax."""

from ._hamiltonian import (
    AbstractDamping as AbstractDamping,
    AbstractHamiltonian as AbstractHamiltonian,
    AbstractKinetic as AbstractKinetic,
    ConformalHamiltonian as ConformalHamiltonian,
    ConstantDamping as ConstantDamping,
    DissipativeHamiltonian as DissipativeHamiltonian,
    Hamiltonian as Hamiltonian,
    LogDamping as LogDamping,
    MixedDamping as MixedDamping,
    QuadraticKinetic as QuadraticKinetic,
    RelativisticKinetic as RelativisticKinetic,
    SeparableHamiltonian as SeparableHamiltonian,
    VectorField as VectorField,
)
from ._interpolation import HermiteInterpolation as HermiteInterpolation
from ._solver import (
    AbstractPresymplecticSolver as AbstractPresymplecticSolver,
    Composition as Composition,
    PresymplecticEuler as PresymplecticEuler,
    PresymplecticLeapfrog as PresymplecticLeapfrog,
    PresymplecticTao as PresymplecticTao,
    PresymplecticYoshida4 as PresymplecticYoshida4,
    Substeps as Substeps,
    SuzukiYoshida as SuzukiYoshida,
)
from ._term import HamiltonianTerm as HamiltonianTerm


__version__ = "0.1.0"
