from ._base import AbstractHamiltonian as AbstractHamiltonian
from ._damping import (
    AbstractDamping as AbstractDamping,
    ConstantDamping as ConstantDamping,
    LogDamping as LogDamping,
    MixedDamping as MixedDamping,
)
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
from ._vector_field import VectorField as VectorField
