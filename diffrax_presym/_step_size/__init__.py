from ._choose import choose_step as choose_step, ChosenStep as ChosenStep
from ._density import (
    ArclengthDensity as ArclengthDensity,
    DistanceDensity as DistanceDensity,
    pair_distances as pair_distances,
    power_grid as power_grid,
    StepDensityController as StepDensityController,
)
