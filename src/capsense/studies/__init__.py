"""Studies of a sensor: what its capacitances and counts do when parameters change.

:func:`sweep` goes over grids, :func:`tolerance` over samples of what scatters, and
:func:`derivatives` gives slopes at a point.
"""

from capsense.studies.capacitances import Capacitances
from capsense.studies.points import Evaluation, StudyRow
from capsense.studies.slopes import Derivatives, derivatives
from capsense.studies.sweeps import sweep
from capsense.studies.tolerances import load_study, tolerance

__all__ = [
    "Capacitances",
    "Derivatives",
    "Evaluation",
    "StudyRow",
    "derivatives",
    "load_study",
    "sweep",
    "tolerance",
]
