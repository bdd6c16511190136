from ._bregman import BregmanHamiltonian as BregmanHamiltonian
from ._energy import Hamiltonian as Hamiltonian
from ._kinetic import (
    QuadraticKinetic as QuadraticKinetic,
    RelativisticKinetic as RelativisticKinetic,
)
from ._lagrangian import LagrangianSystem as LagrangianSystem
from ._mechanical import MechanicalSystem as MechanicalSystem
from ._mirror import (
    EntropyMirror as EntropyMirror,
    EuclideanMirror as EuclideanMirror,
    MirrorMap as MirrorMap,
)
from ._pairwise import pairwise_potential as pairwise_potential
from ._paper import (
    DissipativeHamiltonian as DissipativeHamiltonian,
)
from ._potential import (
    ForceField as ForceField,
    QuadraticPotential as QuadraticPotential,
)
from ._scaling import (
    ExponentialScaling as ExponentialScaling,
    PolynomialScaling as PolynomialScaling,
    Scaling as Scaling,
)
