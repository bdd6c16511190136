from ._base import AbstractHamiltonian as AbstractHamiltonian
from ._bregman import BregmanHamiltonian as BregmanHamiltonian
from ._dissipative import (
    ConformalHamiltonian as ConformalHamiltonian,
    DissipativeHamiltonian as DissipativeHamiltonian,
)
from ._energy import (
    Hamiltonian as Hamiltonian,
    SeparableHamiltonian as SeparableHamiltonian,
)
from ._kinetic import (
    AbstractKinetic as AbstractKinetic,
    QuadraticKinetic as QuadraticKinetic,
    RelativisticKinetic as RelativisticKinetic,
)
from ._lagrangian import LagrangianSystem as LagrangianSystem
from ._mechanical import MechanicalSystem as MechanicalSystem
from ._mirror import (
    AbstractMirrorMap as AbstractMirrorMap,
    EntropyMirror as EntropyMirror,
    EuclideanMirror as EuclideanMirror,
    MirrorMap as MirrorMap,
)
from ._pairwise import pairwise_potential as pairwise_potential
from ._potential import QuadraticPotential as QuadraticPotential
from ._scaling import (
    AbstractScaling as AbstractScaling,
    ExponentialScaling as ExponentialScaling,
    PolynomialScaling as PolynomialScaling,
    Scaling as Scaling,
)
from ._vector_field import VectorField as VectorField
