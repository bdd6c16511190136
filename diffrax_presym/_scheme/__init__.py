from ._base import AbstractPresymplecticSolver as AbstractPresymplecticSolver
from ._compensated import Compensated as Compensated
from ._composition import (
    Composition as Composition,
    SofroniouSpaletta as SofroniouSpaletta,
    Suzuki4 as Suzuki4,
    SuzukiYoshida as SuzukiYoshida,
)
from ._frozen import (
    PresymplecticEuler as PresymplecticEuler,
    PresymplecticLeapfrog as PresymplecticLeapfrog,
)
from ._gauss import PresymplecticGauss as PresymplecticGauss
from ._multistep import SymmetricMultistep as SymmetricMultistep
from ._splitting import (
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
from ._tableaus import SplittingTableau as SplittingTableau
from ._tao import PresymplecticTao as PresymplecticTao
