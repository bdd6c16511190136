from ._density import (
    ArclengthDensity as ArclengthDensity,
    DistanceDensity as DistanceDensity,
    pair_distances as pair_distances,
    power_grid as power_grid,
    StepDensityController as StepDensityController,
)
