"""Studies of a design: what its capacitances do when its parameters change.

:func:`sweep` goes over grids, :func:`tolerance` over samples of what scatters.
"""

from capsense.studies.points import Evaluation, StudyRow
from capsense.studies.sweeps import Capacitances, sweep
from capsense.studies.tolerances import load_study, tolerance

__all__ = ["Capacitances", "Evaluation", "StudyRow", "load_study", "sweep", "tolerance"]
