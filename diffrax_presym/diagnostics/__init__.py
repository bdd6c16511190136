"""Measures of solutions and solvers: energy, structure, order, error against time."""

from ._measures import (
    canonical_energy as canonical_energy,
    convergence_order as convergence_order,
    energy as energy,
    energy_error as energy_error,
    energy_lost as energy_lost,
    power_lost as power_lost,
    structure_defect as structure_defect,
    volume_defect as volume_defect,
)
from ._work_precision import (
    work_precision as work_precision,
    WorkPrecision as WorkPrecision,
    WorkPrecisionRun as WorkPrecisionRun,
)
