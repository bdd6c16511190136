"""Presymplectic integrators for Diffrax."""

from . import diagnostics as diagnostics, extend as extend
from ._friction import (
    ConstantDamping as ConstantDamping,
    Drag as Drag,
    LogDamping as LogDamping,
    PositionDamping as PositionDamping,
    PowerDamping as PowerDamping,
    ViscousDamping as ViscousDamping,
)
from ._loop import (
    FixedStepAdjoint as FixedStepAdjoint,
    StepsBetween as StepsBetween,
)
from ._scheme import (
    BlanesCasasRKN8 as BlanesCasasRKN8,
    BlanesMoan4 as BlanesMoan4,
    BlanesMoan6 as BlanesMoan6,
    BlanesMoanRKN4 as BlanesMoanRKN4,
    BlanesMoanRKN6 as BlanesMoanRKN6,
    Compensated as Compensated,
    Composition as Composition,
    PresymplecticEuler as PresymplecticEuler,
    PresymplecticGauss as PresymplecticGauss,
    PresymplecticLeapfrog as PresymplecticLeapfrog,
    PresymplecticTao as PresymplecticTao,
    SofroniouSpaletta as SofroniouSpaletta,
    Splitting as Splitting,
    SplittingTableau as SplittingTableau,
    Strang as Strang,
    Suzuki4 as Suzuki4,
    SuzukiYoshida as SuzukiYoshida,
    SymmetricMultistep as SymmetricMultistep,
    TunedLinear8 as TunedLinear8,
    TunedRKN6 as TunedRKN6,
)
from ._step_size import (
    choose_step as choose_step,
    ChosenStep as ChosenStep,
    StepDensityController as StepDensityController,
)
from ._system import (
    BregmanHamiltonian as BregmanHamiltonian,
    DissipativeHamiltonian as DissipativeHamiltonian,
    EntropyMirror as EntropyMirror,
    EuclideanMirror as EuclideanMirror,
    ExponentialScaling as ExponentialScaling,
    ForceField as ForceField,
    Hamiltonian as Hamiltonian,
    LagrangianSystem as LagrangianSystem,
    MechanicalSystem as MechanicalSystem,
    MirrorMap as MirrorMap,
    pairwise_potential as pairwise_potential,
    PolynomialScaling as PolynomialScaling,
    QuadraticKinetic as QuadraticKinetic,
    QuadraticPotential as QuadraticPotential,
    RelativisticKinetic as RelativisticKinetic,
    Scaling as Scaling,
)


__version__ = "0.1.0"
