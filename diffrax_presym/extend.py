"""What one needs to write systems, friction and schemes of one's own."""

from ._friction._base import (
    AbstractFriction as AbstractFriction,
    Mechanics as Mechanics,
    Parts as Parts,
)
from ._friction._damping import AbstractDamping as AbstractDamping
from ._friction._log_scale import AbstractLogScale as AbstractLogScale
from ._interpolation import HermiteInterpolation as HermiteInterpolation
from ._scheme._base import (
    AbstractPresymplecticSolver as AbstractPresymplecticSolver,
    Scheme as Scheme,
)
from ._scheme._engine import (
    AbstractMove as AbstractMove,
    MoveSequence as MoveSequence,
    Span as Span,
)
from ._scheme._moves import Drift as Drift, Enter as Enter, Kick as Kick
from ._system._base import AbstractSystem as AbstractSystem
from ._system._bound import System as System
from ._system._kinetic import AbstractKinetic as AbstractKinetic
from ._system._mirror import AbstractMirrorMap as AbstractMirrorMap
from ._system._potential import AbstractPotential as AbstractPotential
from ._system._split import AbstractSplit as AbstractSplit
