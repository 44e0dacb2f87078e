"""``capsense run`` and ``capsense record``: a scenario file in, readings or a recording out."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from capsense.cli import (
    INTERRUPTED,
    OK,
    QUIET,
    RATE,
    BuildProgress,
    Interrupt,
    arg,
    command,
    facts,
    field_figures,
    grouped,
    progress_shown,
    say,
    seconds,
    table,
)
from capsense.errors import RecordingError

if TYPE_CHECKING:
    from capsense.recording.recorder import Recorder
    from capsense.recording.tables import RunWriter
    from capsense.scenario import Sample, Scenario
    from capsense.simulator import Simulator


PRESET = arg(
    "--preset", "how finely surfaces are resolved; default standard",
    choices=("fast", "standard", "fine"),
)  # fmt: skip
SCENARIO = (arg("scenario SCENARIO.toml", "the scenario file", type=Path), RATE, QUIET)


def chosen_scenario(args: argparse.Namespace) -> Scenario:
    """The scenario file of the arguments, at their sample rate if they have one."""
    from capsense.scenario import load_scenario

    scenario = load_scenario(args.scenario)
    return scenario if args.rate is None else scenario.resampled(args.rate)


def _load(args: argparse.Namespace) -> Scenario:
    """The scenario; warns of bodies that it does without."""
    scenario = chosen_scenario(args)
    for warning in absent_bodies(scenario):
        say(f"warning: {warning}")
    return scenario


@command(
    "run",
    "simulate a scenario file and write its readings",
    *SCENARIO,
    PRESET,
    arg("-o --output DIR", "folder for the results", type=Path, required=True),
    arg("--force", "replace the results in a folder that is not empty"),
)
def run(args: argparse.Namespace) -> int:
    """Simulate a scenario: a sensor, bodies that move in front of it, and how it is sampled.

    The output folder receives
      readings.csv   one row per sample: time and capacitances, written as they are computed
      readings.npz   the same as arrays, with full matrices and the bodies' poses
      summary.json   what was computed, how long it took, versions
      plot.png       the signals, and the bodies' way over the electrodes

    Ctrl-C finishes the sample at hand and keeps what was computed.
    The field of a design is computed once, at its first use, and kept in the user's cache.

    examples:
      capsense run examples/hand_approach.toml -o out/
      capsense run examples/steel_bar_triangle.toml -o out/ --force
      capsense run my.toml -o quick/ --rate 2        a quick look: two samples a second
    """
    from capsense.recording.tables import RunWriter, prepare_folder
    from capsense.scene import Scene

    scenario = _load(args)
    made = not args.output.exists()
    prepare_folder(args.output, force=args.force)
    with Interrupt() as interrupt:
        try:
            simulator = build_simulator(scenario, quiet=args.quiet, preset=args.preset)
            recorder = RunWriter(args.output, scenario, simulator.step(Scene()))
        except BaseException:
            if made:
                with contextlib.suppress(OSError):
                    args.output.rmdir()
            raise
        interrupt.deferring = True
        failure: Exception | None = None
        try:
            play_samples(scenario, simulator, recorder.add, interrupt, quiet=args.quiet)
        except Exception as error:
            failure = error
        summary = recorder.summary(
            field_figures(simulator),
            interrupted=interrupt.requested,
            failure=str(failure) if failure is not None else None,
        )
        try:
            recorder.close()
            _write(recorder, summary)
        except OSError as error:
            if failure is None:
                raise
            say(f"error: the results could not be written: {error.strerror}")
    if not args.quiet:
        print(_run_report(summary, args.output))
    if failure is not None:
        time = scenario.times[recorder.count]
        say(
            f"stopped at sample {recorder.count} of {scenario.count} (t = {time:g} s); the "
            f"{recorder.count} before it are in {args.output}"
        )
        raise failure
    return _ending(interrupt, recorder.count, scenario.count)


def _ending(interrupt: Interrupt, count: int, planned: int) -> int:
    """The exit code of what was played so far; says so if it was interrupted."""
    if interrupt.requested and count < planned:
        say(f"interrupted after {count} of {planned} samples, which are kept")
        return INTERRUPTED
    return OK


def absent_bodies(scenario: Scenario) -> list[str]:
    """What to say of bodies that never enter the domain, looked for at up to 500 samples."""
    import numpy as np

    lower, upper = scenario.design.domain.sight
    count = len(scenario.bodies)
    seen, least, nearest = (
        np.zeros(count, dtype=bool),
        np.full(count, np.inf),
        np.zeros((count, 2, 3)),
    )
    stride = max(1, scenario.count // 500)
    for time in scenario.times[::stride]:
        bounds = scenario.scene_at(float(time)).pack().bounds
        apart = np.maximum(bounds[:, 0] - upper, lower - bounds[:, 1])
        seen |= (apart < 0.0).all(axis=1)
        if seen.all():
            break
        way = np.linalg.norm(np.maximum(apart, 0.0), axis=1)
        nearer = way < least
        least[nearer], nearest[nearer] = way[nearer], bounds[nearer]
    return [
        f'body "{b.body.name}" never enters the domain and has no effect: at its nearest it spans '
        f"{_span(nearest[k])} m, and the domain {_span((lower, upper))} m"
        for k, b in enumerate(scenario.bodies)
        if not seen[k]
    ]


def _span(corners: Any) -> str:
    """A box, such as ``x -0.1 to 0.1, y …``."""
    ends = zip("xyz", *corners, strict=True)
    return ", ".join(f"{axis} {low:.3g} to {high:.3g}" for axis, low, high in ends)


def build_simulator(scenario: Scenario, *, quiet: bool, preset: str | None = None) -> Simulator:
    """The simulator that a scenario asks for, with a bar while its field is built."""
    import capsense

    chosen: dict[str, Any] = {} if preset is None else {"preset": preset}
    with BuildProgress(quiet=quiet) as progress:
        return capsense.Simulator(
            scenario.design, method=scenario.method, progress=progress, **chosen
        )


def play_samples(
    scenario: Scenario,
    simulator: Simulator,
    take: Callable[[Sample], object],
    interrupt: Interrupt,
    *,
    quiet: bool,
) -> None:
    """Play the scenario to its end, or until interrupted, and hand out every sample."""
    from tqdm import tqdm

    from capsense.scenario import play

    with tqdm(
        total=scenario.count, unit=" samples", file=sys.stderr, disable=not progress_shown(quiet)
    ) as bar:
        for sample in play(scenario, simulator):
            take(sample)
            bar.update()
            if interrupt.requested:
                break


def _write(recorder: RunWriter, summary: dict[str, Any]) -> None:
    from capsense.plotting import plot_run

    recorder.write_arrays()
    recorder.write_summary(summary)
    if recorder.count:
        plot_run(recorder.run).savefig(recorder.folder / "plot.png", dpi=150)


def _run_report(summary: dict[str, Any], folder: Path) -> str:
    """The summary for people."""
    from capsense.recording.tables import FILES

    field = ", ".join(f"{grouped(value)} {key}" for key, value in summary["field"].items())
    samples = f"{summary['samples']} of {summary['samples_planned']}"
    if summary["interrupted"]:
        samples += ", interrupted"
    if summary["failure"]:
        samples += ", stopped by an error"
    lines = [
        ("scenario", summary["scenario"]),
        ("design", f"{summary['design']}, {len(summary['electrodes'])} electrodes"),
        ("field", field),
        ("samples", f"{samples}, at {summary['sample_rate_Hz']:g} Hz"),
    ]
    step = summary["step_time_s"]
    if step is not None:
        times = [f"{name} {seconds(step[key])}" for name, key in _STEP_TIMES]
        lines.append(("step time", ", ".join(times)))
        error = summary["largest_error_estimate_F"]
        lines.append(("error", f"{error:.2g} F, the largest of the estimates"))
    contact, channels = summary["samples_in_contact"], summary["channels"]
    if contact:
        meant = "are left out below" if contact < summary["samples"] else "are all there is"
        lines.append(
            ("contact", f"{contact} samples mean nothing, since a body touches an electrode; they "
             f"{meant}, and have 1 in the column contact of readings.csv")
        )  # fmt: skip
    blocks = [facts(lines)]
    if step is not None:
        if summary["excitation"] == "matrix":
            blocks.append("Maxwell matrix; the mutual capacitance of a pair is minus its entry")
        header = ("channel", "empty [pF]", "least [pF]", "largest [pF]", "least %", "largest %")
        blocks.append(table(header, [_channel_row(c) for c in channels[:_MAX_ROWS]]))
        if len(channels) > _MAX_ROWS:
            blocks.append(f"and {len(channels) - _MAX_ROWS} more in summary.json")
    if summary["touch"] is not None:
        blocks.append(_touch_table(summary["electrodes"], summary["touch"]))
    written = [name for name in FILES if (folder / name).exists()]
    blocks.append(f"wrote {', '.join(written)} to {folder}")
    return "\n\n".join(blocks)


def _touch_table(electrodes: Sequence[str], touch: dict[str, Any]) -> str:
    """The largest forces on the cover, and its largest compressions."""
    pairs = zip(touch["largest_force_N"], touch["largest_compression_m"], strict=True)
    rows = [[n, f"{f:.4g}", f"{1e3 * d:.3f}"] for n, (f, d) in zip(electrodes, pairs, strict=True)]
    rows = [*rows[:_MAX_ROWS], ["whole cover", f"{touch['largest_total_N']:.4g}", ""]]
    return table(("touch", "largest force [N]", "largest compression [mm]"), rows)


_STEP_TIMES = (("median", "median"), ("95 % below", "p95"), ("longest", "max"))
_MAX_ROWS = 40


def _channel_row(channel: dict[str, Any]) -> list[str]:
    level, low, high = (channel[key] for key in ("baseline_F", "min_F", "max_F"))
    share = [f"{100 * v / level:.2f}" if level else "–" for v in (low, high)]
    return [channel["name"], *(f"{v * 1e12:.5f}" for v in (level, low, high)), *share]


@command(
    "record",
    "simulate a scenario file and record every step as MCAP, for ROS 2 and Foxglove",
    *SCENARIO,
    PRESET,
    arg("-o --output FILE.mcap", "the recording", type=Path, required=True),
    arg("--force", "replace a file that is there"),
    arg("--readout CHIP|FILE.toml", "record what a chip reports, too: its name, or a readout file"),
    arg(
        "--name NAME", "of the sensor: its frame, and the beginning of its topics", default="sensor"
    ),
)
def record(args: argparse.Namespace) -> int:
    """Simulate a scenario, and record every step in an MCAP file of ROS 2 messages: bodies and
    their poses, capacitance matrices, transforms, markers, and the counts of a readout. Foxglove
    and 'ros2 bag' open it; 'capsense replay' simulates it again and compares; 'capsense export'
    makes tables of it.

    Every half second all that was computed is put into the file. Whatever ends the process, the
    rest can be read.

    examples:
      capsense record examples/hand_approach.toml -o hand.mcap
      capsense record examples/hand_approach.toml -o hand.mcap --readout fdc1004 --force
    """
    from capsense.recording import check_name, make_readout
    from capsense.recording.files import check_target
    from capsense.recording.recorder import Recorder
    from capsense.recording.ros import require

    require()
    scenario = _load(args)
    if args.output.suffix != ".mcap":
        raise RecordingError(
            f"--output {args.output}: recordings are MCAP files; give a name that ends in .mcap"
        )
    check_target(args.output, overwrite=args.force)
    check_name(args.name)
    make_readout(args.readout, scenario.design.electrode_names)
    with Interrupt() as interrupt:
        simulator = build_simulator(scenario, quiet=args.quiet, preset=args.preset)
        recorder = Recorder(
            args.output, simulator, name=args.name, readout=args.readout, scenario=scenario,
            overwrite=args.force,
        )  # fmt: skip
        interrupt.deferring = True
        try:
            with recorder:
                play_samples(
                    scenario, simulator,
                    lambda s: recorder.write(s.time, s.scene, s.reading),
                    interrupt, quiet=args.quiet,
                )  # fmt: skip
        except Exception:
            time = scenario.times[min(recorder.count, scenario.count - 1)]
            say(f"stopped at sample {recorder.count} of {scenario.count} (t = {time:g} s)")
            raise
    if not args.quiet:
        print(_record_report(scenario, recorder))
    return _ending(interrupt, recorder.count, scenario.count)


def _record_report(scenario: Scenario, recorder: Recorder) -> str:
    size = recorder.path.stat().st_size
    return facts(
        [
            ("scenario", scenario.name),
            ("design", f"{scenario.design.name}, {len(scenario.design.electrodes)} electrodes"),
            ("samples", f"{recorder.count} of {scenario.count}, at {scenario.sample_rate:g} Hz"),
            ("recording", f"{recorder.path}, {size / 1e6:.2f} MB"),
        ]
    )
