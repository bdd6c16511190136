from ._base import AbstractPresymplecticSolver as AbstractPresymplecticSolver
from ._composition import (
    Composition as Composition,
    PresymplecticYoshida4 as PresymplecticYoshida4,
    Substeps as Substeps,
    SuzukiYoshida as SuzukiYoshida,
)
from ._euler import PresymplecticEuler as PresymplecticEuler
from ._leapfrog import PresymplecticLeapfrog as PresymplecticLeapfrog
from ._tao import PresymplecticTao as PresymplecticTao
