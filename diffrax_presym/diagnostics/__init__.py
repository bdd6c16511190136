"""Measures of solutions and solvers: energy, structure, order, error against time."""

from ._energy import (
    energy as energy,
    energy_error as energy_error,
    energy_lost as energy_lost,
    power_lost as power_lost,
)
from ._plot import (
    plot_convergence as plot_convergence,
    plot_energy as plot_energy,
    plot_phase as plot_phase,
    plot_work_precision as plot_work_precision,
)
from ._structure import (
    structure_defect as structure_defect,
)
from ._work_precision import (
    work_precision as work_precision,
    WorkPrecision as WorkPrecision,
    WorkPrecisionRun as WorkPrecisionRun,
)
