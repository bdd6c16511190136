"""Presymplectic integrators for Diffrax."""

from . import diagnostics as diagnostics, extend as extend
from ._friction._damping import (
    ConstantDamping as ConstantDamping,
    LogDamping as LogDamping,
    PowerDamping as PowerDamping,
)
from ._friction._drag import Drag as Drag
from ._friction._viscous import (
    PositionDamping as PositionDamping,
    ViscousDamping as ViscousDamping,
)
from ._loop._adjoint import FixedStepAdjoint as FixedStepAdjoint
from ._loop._steps_between import StepsBetween as StepsBetween
from ._scheme._compensated import Compensated as Compensated
from ._scheme._composition import (
    Composition as Composition,
    PresymplecticYoshida4 as PresymplecticYoshida4,
    SofroniouSpaletta as SofroniouSpaletta,
    Suzuki4 as Suzuki4,
    SuzukiYoshida as SuzukiYoshida,
)
from ._scheme._frozen import (
    PresymplecticEuler as PresymplecticEuler,
    PresymplecticLeapfrog as PresymplecticLeapfrog,
)
from ._scheme._gauss import PresymplecticGauss as PresymplecticGauss
from ._scheme._multistep import SymmetricMultistep as SymmetricMultistep
from ._scheme._splitting import (
    BlanesCasasRKN8 as BlanesCasasRKN8,
    BlanesMoan4 as BlanesMoan4,
    BlanesMoan6 as BlanesMoan6,
    BlanesMoanRKN4 as BlanesMoanRKN4,
    BlanesMoanRKN6 as BlanesMoanRKN6,
    Splitting as Splitting,
    Strang as Strang,
    TunedLinear8 as TunedLinear8,
    TunedRKN6 as TunedRKN6,
)
from ._scheme._tableaus import SplittingTableau as SplittingTableau
from ._scheme._tao import PresymplecticTao as PresymplecticTao
from ._step_size._choose import (
    choose_step as choose_step,
    ChosenStep as ChosenStep,
)
from ._step_size._density import StepDensityController as StepDensityController
from ._system._attitude import (
    Attitude as Attitude,
    rotation_matrix as rotation_matrix,
)
from ._system._bregman import BregmanHamiltonian as BregmanHamiltonian
from ._system._constrained import ConstrainedSystem as ConstrainedSystem
from ._system._energy import Hamiltonian as Hamiltonian
from ._system._kinetic import (
    QuadraticKinetic as QuadraticKinetic,
    RelativisticKinetic as RelativisticKinetic,
)
from ._system._lagrangian import LagrangianSystem as LagrangianSystem
from ._system._manifold import ManifoldSystem as ManifoldSystem
from ._system._manifolds import (
    Euclidean as Euclidean,
    Sphere as Sphere,
    Stiefel as Stiefel,
)
from ._system._mechanical import MechanicalSystem as MechanicalSystem
from ._system._mirror import (
    EntropyMirror as EntropyMirror,
    EuclideanMirror as EuclideanMirror,
    MirrorMap as MirrorMap,
)
from ._system._pairwise import pairwise_potential as pairwise_potential
from ._system._paper import DissipativeHamiltonian as DissipativeHamiltonian
from ._system._potential import (
    ForceField as ForceField,
    QuadraticPotential as QuadraticPotential,
)
from ._system._scaling import (
    ExponentialScaling as ExponentialScaling,
    PolynomialScaling as PolynomialScaling,
    Scaling as Scaling,
)


__version__ = "0.1.0"
