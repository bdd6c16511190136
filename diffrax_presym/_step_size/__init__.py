from ._choose import choose_step as choose_step, ChosenStep as ChosenStep
from ._density import StepDensityController as StepDensityController
