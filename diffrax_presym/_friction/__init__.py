from ._base import AbstractFriction as AbstractFriction
from ._damping import (
    AbstractDamping as AbstractDamping,
    as_damping as as_damping,
    ConstantDamping as ConstantDamping,
    LogDamping as LogDamping,
    MixedDamping as MixedDamping,
)
