from ._base import AbstractFriction as AbstractFriction
from ._damping import (
    ConstantDamping as ConstantDamping,
    Damping as Damping,
    LogDamping as LogDamping,
    PowerDamping as PowerDamping,
)
from ._drag import Drag as Drag
from ._log_scale import AbstractLogScale as AbstractLogScale
from ._viscous import (
    PositionDamping as PositionDamping,
    ViscousDamping as ViscousDamping,
)
