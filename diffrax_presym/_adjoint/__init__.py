from ._fixed_step import FixedStepAdjoint as FixedStepAdjoint
from ._reversible import ReversibleAdjoint as ReversibleAdjoint
