"""``capsense optimise``: sizes and gaps of electrodes for a task, by search."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capsense.cli.console import OK, Command, add_quiet, table
from capsense.errors import ScenarioError

if TYPE_CHECKING:
    from capsense.learning.optimise import Bound, DesignTask


def _arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("task", metavar="TASK.toml", type=Path, help="what is to be found")
    parser.add_argument(
        "-o", "--output", metavar="DESIGN.toml", type=Path, required=True,
        help="the design that was found",
    )  # fmt: skip
    parser.add_argument(
        "--evaluations", metavar="N", type=int, help="candidates to try, instead of the task's"
    )
    parser.add_argument(
        "--no-check", action="store_true", help="leave out the check at full accuracy"
    )
    add_quiet(parser)


def _execute(args: argparse.Namespace) -> int:
    """Search, check, write, and return the exit code."""
    from dataclasses import replace

    from capsense.learning.optimise import load_task, search, to_toml

    if args.output.suffix.lower() != ".toml" or not args.output.parent.is_dir():
        raise ScenarioError(
            f"--output {args.output}: give a name that ends in .toml, in a folder that is there"
        )
    task = load_task(args.task)
    if args.evaluations is not None:
        if args.evaluations < 1:
            raise ScenarioError(f"--evaluations {args.evaluations}: give 1 or more")
        task = replace(task, evaluations=args.evaluations)
    count = 0

    def each(values: Any, bound: Bound) -> None:
        nonlocal count
        count += 1
        if not args.quiet:
            print(f"{count:4d}  {_parameters(task, values)}  cost {bound.cost:.4f}",
                  file=sys.stderr, flush=True)  # fmt: skip

    values, coarse = search(task, each)
    found = task.content(values)
    head = f"# {task.name}: found by `capsense optimise {args.task.name}`, {count} candidates.\n"
    args.output.write_text(head + to_toml(found) + "\n", encoding="utf-8")
    if not args.quiet:
        rows = {"found": (values, coarse)}
        if not args.no_check:
            rows = {
                "start": (task.start, task.bound(task.start, 1.0, "fine")),
                "found": (values, task.bound(values, 1.0, "fine")),
            }
        _print(task, rows, "the search" if args.no_check else "full accuracy")
        print(f"\nthe search had {coarse.cost:.4f}; written to {args.output}")
    return OK


def _parameters(task: DesignTask, values: Any) -> str:
    return "  ".join(
        f"{name} {1e3 * value:.2f}" for name, value in zip(task.parameters, values, strict=True)
    )


def _print(task: DesignTask, rows: dict[str, tuple[Any, Bound]], accuracy: str) -> None:
    """What was found beside the start."""
    import numpy as np

    lines = []
    for name, (values, bound) in rows.items():
        lateral, vertical, pitch, yaw = bound.pose
        numbers = (1e3 * lateral, 1e3 * vertical, np.degrees(pitch), np.degrees(yaw))
        told = [*(f"{1e3 * v:.2f}" for v in values), *(f"{v:.2f}" for v in numbers)]
        lines.append([name, *told, f"{bound.cost:.4f}"])
    header = [
        f"least errors, {accuracy}", *(f"{n} [mm]" for n in task.parameters), "lateral [mm]",
        "vertical [mm]", "pitch [°]", "yaw [°]", "cost",
    ]  # fmt: skip
    print(table(header, lines))


OPTIMISE = Command(
    "optimise",
    "choose sizes and gaps of electrodes for a task",
    """\
Choose sizes and gaps of electrodes so that they tell the pose of a limb best. TASK.toml
holds a design whose lengths are expressions of parameters, the parameters' ranges, where
the limb will be, and the noise of a channel. A candidate is judged by the Cramér-Rao bound
of lateral and vertical position, pitch and yaw: the least errors that this sensor and this
noise allow. Each candidate takes some seconds, for its field is built anew, coarsely; what
is found is checked at full accuracy, beside the start, and written as a design file.
""",
    """\
  capsense optimise examples/designs/forearm_pads.toml -o pads.toml
  capsense optimise task.toml -o pads.toml --evaluations 200
  capsense optimise task.toml -o pads.toml --evaluations 20 --no-check
""",
    _arguments,
    _execute,
)
