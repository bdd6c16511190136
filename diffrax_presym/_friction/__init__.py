from ._base import AbstractFriction as AbstractFriction
from ._damping import (
    AbstractDamping as AbstractDamping,
    as_damping as as_damping,
    check_scalar as check_scalar,
    ConstantDamping as ConstantDamping,
    is_scalar as is_scalar,
    LogDamping as LogDamping,
    MixedDamping as MixedDamping,
    SumDamping as SumDamping,
)
from ._drag import Drag as Drag
from ._position import PositionDamping as PositionDamping
from ._viscous import (
    as_friction as as_friction,
    RayleighDamping as RayleighDamping,
    ViscousDamping as ViscousDamping,
    ViscousFriction as ViscousFriction,
)
