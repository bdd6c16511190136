from ._adjoint import FixedStepAdjoint as FixedStepAdjoint
from ._steps import StepsBetween as StepsBetween
