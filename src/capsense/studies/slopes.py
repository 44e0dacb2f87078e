"""Derivatives of what a study computes by its parameters, each with an estimated error."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from capsense._validate import suggest
from capsense.errors import DesignError, ScenarioError
from capsense.studies.capacitances import (
    Capacitances,
    is_code,
)
from capsense.studies.points import WRONG_POINT, Evaluation
from capsense.studies.template import Point

Array = NDArray[np.float64]

STEP = 0.05
"""Largest step, as a part of the value."""
LEVELS = 3
"""Each step is half the one before it."""


class Derivatives(NamedTuple):
    """Derivatives at a point."""

    outputs: tuple[str, ...]
    parameters: tuple[str, ...]
    values: Array
    """[F] per unit of the parameter, such as F/m, shape (outputs, parameters)."""
    errors: Array
    """Estimated errors of the values, in the same unit and shape."""


def derivatives(
    design: str | Path,
    point: Point,
    steps: Mapping[str, float | None] | None = None,
    *,
    scenario: str | Path | None = None,
) -> Derivatives:
    """Derivatives of capacitances, and of their changes by bodies, by parameters of a sensor.

    Central differences at three steps, each half the one before, are extrapolated to step 0 (C. J.
    F. Ridders, *Adv. Eng. Software* 4, 1982, 75-76). Six evaluations are needed for each parameter.

    Args:
        design: A design's file with expressions, or the name of a packaged design.
        point: Values of the parameters, as of :func:`~capsense.studies.sweep`.
        steps: Parameters by which derivatives are taken, and the largest step of each in its own
            unit; None for a twentieth of the value. By default all parameters that are numbers.
        scenario: A scenario's file, for changes by its bodies as they stand at time 0.

    Returns:
        Derivatives of ``C0_…`` and, with a scenario, ``dC_…``.

    Raises:
        DesignError: The design is wrong, or a parameter is not used.
        ScenarioError: The scenario or a step is wrong.
        CapSenseError: Nothing can be made of the point, or a step from it.
    """
    evaluation = Capacitances.load(design, [point], scenario)
    if steps is None:
        steps = {name: None for name, value in point.items() if not isinstance(value, str)}
    WithDerivatives.of(evaluation, steps, [point])  # checks the steps
    return differentiate(evaluation, point, steps)


def differentiate(
    evaluation: Evaluation, point: Point, steps: Mapping[str, float | None]
) -> Derivatives:
    """Derivatives of the outputs of an evaluation that are no counts; see :func:`derivatives`.

    Raises:
        CapSenseError: Nothing can be made of a step from the point.
    """
    chosen = [k for k, name in enumerate(evaluation.outputs) if not is_code(name)]
    found = []
    for name, step in steps.items():
        centre = point[name]
        assert not isinstance(centre, str)
        largest = STEP * abs(centre) if step is None else step

        def at(value: float, name: str = name) -> Array:
            try:
                return np.array(evaluation({**point, name: value}))[chosen]
            except WRONG_POINT as error:
                raise DesignError(
                    f"derivative by {name}: at {name} = {value:g}: {error}; give a smaller step"
                ) from None

        ladder = [largest / 2**level for level in range(LEVELS)]
        found.append(extrapolate([(at(centre + h) - at(centre - h)) / (2 * h) for h in ladder]))
    values, errors = (np.array([pair[k] for pair in found]).T for k in (0, 1))
    return Derivatives(tuple(evaluation.outputs[k] for k in chosen), tuple(steps), values, errors)


def extrapolate(differences: Sequence[Array]) -> tuple[Array, Array]:
    """The limit of central differences whose steps are halved from one to the next, and its error.

    Neville's scheme for an error in even powers of the step. Of each output that extrapolation is
    taken which lies nearest to the two entries it is made of, after Ridders: they part where the
    step is too large and, by noise, where it is too small. Its estimated error is its largest
    distance from any other extrapolation.

    Args:
        differences: Three or more, the largest step first, each of shape (n,).

    Returns:
        Limits and estimated errors, shape (n,) each.
    """
    best = np.array(differences[0], dtype=float)
    apart = np.full(best.shape, np.inf)
    above, found = [best], []
    for difference in differences[1:]:
        row = [np.asarray(difference, dtype=float)]
        for order, before in enumerate(above, start=1):
            better = row[-1] + (row[-1] - before) / (4.0**order - 1.0)
            distance = np.maximum(np.abs(better - row[-1]), np.abs(better - before))
            best = np.where(distance < apart, better, best)
            apart = np.minimum(apart, distance)
            row.append(better)
        found += row[1:]
        above = row
    return best, np.max(np.abs(best - np.array(found)), axis=0)


@dataclass(frozen=True)
class WithDerivatives:
    """The outputs of an evaluation, then their derivatives and the errors of these; another
    :class:`~capsense.studies.Evaluation`."""

    evaluation: Evaluation
    steps: Mapping[str, float | None]
    """Parameters, and the largest step of each; None for a twentieth of the value."""

    @classmethod
    def of(
        cls, evaluation: Evaluation, steps: Mapping[str, float | None], points: Sequence[Point]
    ) -> WithDerivatives:
        """Check steps.

        Raises:
            ScenarioError: A step is not positive, or a point needs one that is not given.
        """
        for name, step in steps.items():
            if name not in points[0]:
                raise ScenarioError(
                    f"derivative by {name}: it is not varied; {suggest(name, points[0])}"
                )
            values = [point[name] for point in points]
            if any(isinstance(value, str) for value in values):
                raise ScenarioError(f"derivative by {name}: its values are texts; leave it out")
            if step is not None and not 0 < step < np.inf:
                raise ScenarioError(f"derivative by {name}: step = {step:g}; give one above 0")
            if step is None and 0.0 in values:
                raise ScenarioError(
                    f"derivative by {name} at {name} = 0: a twentieth of that is no step; give "
                    f"{name}=STEP"
                )
        return cls(evaluation, dict(steps))

    @property
    def outputs(self) -> tuple[str, ...]:
        """Names of the results: of the evaluation, then ``d(C0_E_E)/d(side)`` and its error."""
        names = [n for n in self.evaluation.outputs if not is_code(n)]
        slopes = [f"d({output})/d({name})" for output in names for name in self.steps]
        return (*self.evaluation.outputs, *slopes, *(f"error of {slope}" for slope in slopes))

    def key(self, point: Point) -> str:
        """Digest of the evaluation's key and the steps."""
        text = f"{self.evaluation.key(point)} {sorted(self.steps.items())} {LEVELS}"
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def group(self, point: Point) -> str:
        """As of the evaluation."""
        return self.evaluation.group(point)

    def __call__(self, point: Point) -> tuple[float, ...]:
        """The results at a point.

        Raises:
            CapSenseError: The evaluation raises it, at the point or a step from it.
        """
        here = self.evaluation(point)
        found = differentiate(self.evaluation, point, self.steps)
        return (*here, *found.values.ravel().tolist(), *found.errors.ravel().tolist())
