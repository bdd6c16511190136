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
    BlanesCasasRKN8 as BlanesCasasRKN8,
    BlanesMoan4 as BlanesMoan4,
    BlanesMoan6 as BlanesMoan6,
    BlanesMoanRKN4 as BlanesMoanRKN4,
    BlanesMoanRKN6 as BlanesMoanRKN6,
    Composition as Composition,
    PresymplecticEuler as PresymplecticEuler,
    PresymplecticLeapfrog as PresymplecticLeapfrog,
    PresymplecticTao as PresymplecticTao,
    PresymplecticYoshida4 as PresymplecticYoshida4,
    SofroniouSpaletta6 as SofroniouSpaletta6,
    SofroniouSpaletta8 as SofroniouSpaletta8,
    SofroniouSpaletta10 as SofroniouSpaletta10,
    Splitting as Splitting,
    SplittingTableau as SplittingTableau,
    Substeps as Substeps,
    Suzuki4 as Suzuki4,
    SuzukiYoshida as SuzukiYoshida,
)
from ._term import HamiltonianTerm as HamiltonianTerm


__version__ = "0.1.0"
