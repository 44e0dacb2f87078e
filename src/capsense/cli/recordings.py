"""``capsense replay``, ``export`` and ``readout``: what becomes of recorded capacitances."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.cli import (
    DIFFERS,
    OK,
    PICTURES,
    QUIET,
    BuildProgress,
    arg,
    check_picture,
    command,
    facts,
    progress_shown,
    say,
    seconds,
    table,
)
from capsense.errors import ReadoutError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from capsense.readout import Readout
    from capsense.readout.conversions import Counts
    from capsense.readout.presets import Chip
    from capsense.readout.recording import CapacitanceRecord


@command(
    "replay",
    "simulate a recording again and verify that every reading is the same",
    arg("recording FILE.mcap", "the recording", type=Path),
    arg(
        "--tolerance F",
        "difference of a capacitance that is allowed, in farads; default 0",
        type=float,
        default=0.0,
    ),
    arg(
        "--method",
        "simulate with this method instead of the recorded one",
        choices=("surface", "fem_masked"),
    ),
    QUIET,
)
def replay(args: argparse.Namespace) -> int:
    """Simulate a recording again, from the design, settings and bodies in it, and compare every
    reading bit for bit; and the counts of a readout given by a chip's name or a file. The first
    difference is printed.

    Exit code 0: all the same. 3: something differs. 2: the file is no recording, or damaged.

    Of a skin, all sensors are replayed, one after the other.

    Another processor, or another version of numba or NumPy, may change the last digits;
    --tolerance allows for that. A recording that was cut short is compared as far as it goes.

    examples:
      capsense replay hand.mcap
      capsense replay hand.mcap --tolerance 1e-19    differences up to 0.1 aF are allowed
      capsense replay old.mcap --method surface      recorded by a version with other methods
    """
    from tqdm import tqdm

    from capsense.recording.reader import open_all, replay

    recordings = open_all(args.recording)
    if not recordings[0].complete:
        say(f"warning: {args.recording} was not closed; what was written until then is compared")
    shown = progress_shown(args.quiet)
    with (
        tqdm(unit=" steps", file=sys.stderr, disable=not shown) as bar,
        BuildProgress(quiet=args.quiet) as progress,
    ):
        results = {
            recording.session.name: replay(
                recording,
                method=args.method,
                tolerance=args.tolerance,
                progress=progress,
                each=lambda _: bar.update(),
            )
            for recording in recordings
        }
    several = len(results) > 1
    for name, found in results.items():
        if not args.quiet:
            print(f"sensor       {name}\n{found}" if several else found)
        if not found.same:
            say(f"the readings{f' of {name}' if several else ''} differ; first, {found.first}")
            for key, (then, now) in found.changed.items():
                say(f"recorded with {key} {then}, replayed with {now}")
    return OK if all(found.same for found in results.values()) else DIFFERS


@command(
    "export",
    "turn a recording into .csv, .npz or .parquet, or make one whole that was cut short",
    arg("recording FILE.mcap", "the recording", type=Path),
    arg("-o --output FILE", "what to write", type=Path, required=True),
    arg("--counts", "the conversions of the readout in place of the readings (.csv, .parquet)"),
    arg("--sensor NAME", "which sensor of a recorded skin"),
    arg("--force", "replace a file that is there"),
)
def export(args: argparse.Namespace) -> int:
    """Turn a recording into another file. The ending chooses the format:
      .csv, .parquet   the columns of readings.csv of capsense run, and the episode
      .npz             the arrays of readings.npz, the episode, and the counts of a readout;
                       capsense readout takes it
      .mcap            the recording again; one whose recorder was killed gets its index
      .json            a layout in which Foxglove shows the recording

    examples:
      capsense export hand.mcap -o hand.parquet
      capsense export hand.mcap -o counts.csv --counts
      capsense export killed.mcap -o whole.mcap
      capsense export hand.mcap -o layout.json
      capsense export skin.mcap --sensor front -o front.csv
    """
    from capsense.recording.export import export
    from capsense.recording.files import check_target
    from capsense.recording.reader import open_all, open_recording

    whole = args.sensor is None and args.output.suffix.lower() == ".mcap"
    recording = (
        open_all(args.recording)[0] if whole else open_recording(args.recording, args.sensor)
    )
    check_target(args.output, overwrite=args.force)
    if not recording.complete:
        say(f"warning: {args.recording} was not closed; what was written until then is exported")
    count = export(recording, args.output, counts=args.counts)
    what = {".mcap": "messages", ".json": "layout"}.get(args.output.suffix.lower(), "rows")
    print(f"{count} {what} in {args.output}")
    return OK


@command(
    "readout",
    "turn recorded capacitances into what a chip reports",
    arg("recording REC", "the recording", type=Path, nargs="?"),
    arg("--list", "list the chips; with --chip, that one's figures"),
    arg(
        "--chip NAME|FILE.toml",
        "a chip, or a readout file; may be repeated; 'all' for all chips",
        action="append",
        default=[],
    ),
    arg("--config FILE.toml", "a readout file", type=Path),
    arg("--rate HZ", "conversions per second, one of the chip's", type=float),
    arg("--seed N", "of the noise; default 0", type=int, default=0),
    arg("--no-noise", "rounding and saturation only"),
    arg("-o --output DIR", "folder for the tables", type=Path),
    arg("--force", "replace tables that are there"),
    arg(
        "--plot PICTURE",
        f"draw one channel instead of writing tables ({', '.join(PICTURES)})",
        type=Path,
    ),
    arg("--electrode NAME", "with --plot: the electrode; default the first"),
)
def readout(args: argparse.Namespace) -> int:
    """Turn the capacitances of a recording into what a chip reports: one channel after another,
    late, noisy, quantised, within its range.

    A recording is the output folder of capsense run, or readings.npz or readings.csv in it.
    Beside it, or in the folder given with -o, is written
      counts_CHIP.csv   one row per conversion: time stamp, channel, code, capacitance, flags

    Between samples of the recording capacitances are interpolated linearly.

    examples:
      capsense readout --list                               the chips, with sources of their figures
      capsense readout out/ --chip fdc1004
      capsense readout out/ --chip fdc1004 --rate 400 --seed 3 -o counts/
      capsense readout out/ --config my_chip.toml           options from a file
      capsense readout out/ --chip all --plot chips.png     all chips side by side, no tables
    """

    if args.list:
        print(_chips(args.chip))
        return OK
    _check_options(args)
    from capsense.readout.recording import load_recording
    from capsense.recording.tables import write_counts

    recording = load_recording(args.recording)
    readouts = _build(args, recording)
    if args.plot is not None:
        from capsense.plotting.designs import plot_chips

        plot_chips(recording, readouts, args.electrode).savefig(args.plot, dpi=150)
        print(f"drawn to {args.plot}")
        return OK
    folder = args.output or recording.path.parent
    targets = {key: folder / f"counts_{key}.csv" for key in readouts}
    _prepare(folder, targets.values(), args.force)
    for key, readout in readouts.items():
        counts = readout(recording.time, recording.channels(readout.bank))
        write_counts(targets[key], counts)
        print(_readout_report(readout, counts, targets[key]) + "\n")
    return OK


def _check_options(args: argparse.Namespace) -> None:
    """Refuse what does not go together before anything is computed."""
    if args.recording is None:
        raise ReadoutError("no recording given; name the output folder of capsense run, or --list")
    if bool(args.chip) == (args.config is not None):
        raise ReadoutError("give --chip NAME or --config FILE.toml, one of them")
    files = args.config is not None or any(name.endswith(".toml") for name in args.chip)
    if files and (args.rate is not None or args.seed or args.no_noise):
        raise ReadoutError(
            "--rate, --seed and --no-noise go with a chip's name; write them in the file"
        )
    if args.seed < 0:
        raise ReadoutError(f"--seed {args.seed} must be zero or more")
    if args.electrode is not None and args.plot is None:
        raise ReadoutError("--electrode goes with --plot; the tables hold all channels")
    if args.plot is not None:
        check_picture("--plot", args.plot, ReadoutError)


def _build(args: argparse.Namespace, recording: CapacitanceRecord) -> dict[str, Readout]:
    """The readouts asked for, by a name for files."""
    from capsense.readout.channels import ChannelBank
    from capsense.readout.config import load_readout
    from capsense.readout.presets import ReadoutOptions, chip_of, default_patterns, expected_of
    from capsense.readout.readout import build

    if args.config is not None:
        return {args.config.stem: load_readout(args.config, recording.electrodes)}
    from capsense.readout.presets import CHIPS

    names = list(CHIPS) if "all" in args.chip else args.chip
    out = {}
    for name in names:
        if name.endswith(".toml"):
            out[Path(name).stem] = load_readout(name, recording.electrodes)
            continue
        chip = chip_of(name)
        patterns = default_patterns(chip, recording.electrodes)
        empty = recording.empty_channels(ChannelBank(patterns, recording.electrodes))
        options = ReadoutOptions(
            patterns=patterns, rate=args.rate, seed=args.seed, noise=not args.no_noise,
            expected=expected_of(empty),
        )  # fmt: skip
        out[chip.name] = build(chip, recording.electrodes, options)
    return out


def _prepare(folder: Path, targets: Iterable[Path], force: bool) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for target in targets:
        if target.exists() and not force:
            raise ReadoutError(f"{target} is there already; give -o DIR, or --force to replace it")


def _readout_report(readout: Readout, counts: Counts, path: Path) -> str:
    """What came out, for people."""

    plan = readout.schedule
    head = [
        ("readout", readout.name),
        ("conversions", f"{len(counts)}, {seconds(plan.conversion)} each"),
        ("a channel's period", seconds(plan.period)),
    ]
    rows = []
    for name in counts.channel_names:
        one = counts.of(name)
        if not len(one):
            continue
        low, high = one.capacitance.min(), one.capacitance.max()
        rows.append(
            (name, f"{low * 1e12:.5f}", f"{high * 1e12:.5f}", str(one.code.min()),
             str(one.code.max()), str(int(one.saturated.sum())))
        )  # fmt: skip
    header = ("channel", "least [pF]", "largest [pF]", "least code", "largest code", "saturated")
    return "\n\n".join([facts(head), table(header, rows), f"wrote {path}"])


def _chips(chosen: list[str]) -> str:
    from capsense.readout.presets import CHIPS, chip_of

    if chosen and "all" not in chosen:
        return "\n\n".join(_figures(chip_of(name)) for name in chosen)
    rows = [
        (chip.name, chip.mode, f"{chip.rates[0].per_second:.4g}", chip.title)
        for chip in CHIPS.values()
    ]
    return table(("name", "mode", "conversions/s", "chip"), rows)


def _figures(chip: Chip) -> str:

    rows = [(f.quantity, f.status.value, f.value, f.source) for f in chip.facts]
    return f"{chip.title}\n\n" + table(("figure", "status", "value", "source"), rows)
