"""Presymplectic integrators for Diffrax."""

from . import diagnostics as diagnostics
from ._adjoint import (
    FixedStepAdjoint as FixedStepAdjoint,
    ReversibleAdjoint as ReversibleAdjoint,
)
from ._friction import (
    AbstractDamping as AbstractDamping,
    AbstractFriction as AbstractFriction,
    ConstantDamping as ConstantDamping,
    Drag as Drag,
    LogDamping as LogDamping,
    MixedDamping as MixedDamping,
    PositionDamping as PositionDamping,
    RayleighDamping as RayleighDamping,
    ViscousDamping as ViscousDamping,
)
from ._hamiltonian import (
    AbstractHamiltonian as AbstractHamiltonian,
    AbstractKinetic as AbstractKinetic,
    AbstractMirrorMap as AbstractMirrorMap,
    AbstractScaling as AbstractScaling,
    BregmanHamiltonian as BregmanHamiltonian,
    ConformalHamiltonian as ConformalHamiltonian,
    DissipativeHamiltonian as DissipativeHamiltonian,
    EntropyMirror as EntropyMirror,
    EuclideanMirror as EuclideanMirror,
    ExponentialScaling as ExponentialScaling,
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
    Checked as Checked,
    Compensated as Compensated,
    Composition as Composition,
    PresymplecticCoupled as PresymplecticCoupled,
    PresymplecticEuler as PresymplecticEuler,
    PresymplecticGauss as PresymplecticGauss,
    PresymplecticLeapfrog as PresymplecticLeapfrog,
    PresymplecticTao as PresymplecticTao,
    PresymplecticYoshida4 as PresymplecticYoshida4,
    SofroniouSpaletta6 as SofroniouSpaletta6,
    SofroniouSpaletta8 as SofroniouSpaletta8,
    SofroniouSpaletta10 as SofroniouSpaletta10,
    Splitting as Splitting,
    SplittingTableau as SplittingTableau,
    Strang as Strang,
    Substeps as Substeps,
    Suzuki4 as Suzuki4,
    SuzukiYoshida as SuzukiYoshida,
    SymmetricMultistep as SymmetricMultistep,
    TunedLinear8 as TunedLinear8,
    TunedRKN6 as TunedRKN6,
)
from ._split import (
    AbstractSplit as AbstractSplit,
    KineticSplit as KineticSplit,
    PotentialSplit as PotentialSplit,
    SharedSplit as SharedSplit,
)
from ._step_size import (
    ArclengthDensity as ArclengthDensity,
    choose_step as choose_step,
    ChosenStep as ChosenStep,
    DistanceDensity as DistanceDensity,
    pair_distances as pair_distances,
    power_grid as power_grid,
    StepDensityController as StepDensityController,
)
from ._term import HamiltonianTerm as HamiltonianTerm


__version__ = "0.1.0"
