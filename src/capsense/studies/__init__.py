"""Studies of a design: what its capacitances do when its parameters change.

:func:`sweep` goes over grids.
"""

from capsense.studies.points import Evaluation, Row
from capsense.studies.sweeps import Capacitances, sweep

__all__ = ["Capacitances", "Evaluation", "Row", "sweep"]
