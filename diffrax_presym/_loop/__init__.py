from ._adjoint import FixedStepAdjoint as FixedStepAdjoint
