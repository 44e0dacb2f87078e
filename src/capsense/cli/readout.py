"""``capsense readout``: recorded capacitances, as a chip would have reported them."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from capsense.errors import ReadoutError

if TYPE_CHECKING:
    from collections.abc import Iterable

    from capsense.readout.chips import Chip
    from capsense.readout.counts import Counts
    from capsense.readout.readout import Readout
    from capsense.readout.recording import CapacitanceRecord

NAME = "readout"
HELP = "turn recorded capacitances into what a chip reports"
DESCRIPTION = """\
Turn the capacitances of a recording into what a chip reports: one channel after another, late,
noisy, quantised, within its range.

A recording is the output folder of capsense run, or readings.npz or readings.csv in it. Beside it,
or in the folder given with -o, is written
  counts_CHIP.csv   one row per conversion: time stamp, channel, code, capacitance, flags

Between samples of the recording capacitances are interpolated linearly.
"""
EXAMPLES = """\
  capsense readout --list                               the chips, with sources of their figures
  capsense readout out/ --chip fdc1004
  capsense readout out/ --chip fdc1004 --rate 400 --seed 3 -o counts/
  capsense readout out/ --config my_chip.toml           options from a file
  capsense readout out/ --chip all --plot chips.png     all chips side by side, no tables
"""
PICTURES = (".png", ".svg", ".pdf")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument("recording", metavar="REC", type=Path, nargs="?", help="the recording")
    parser.add_argument(
        "--list", action="store_true", help="list the chips; with --chip, that one's figures"
    )
    parser.add_argument(
        "--chip", metavar="NAME", action="append", default=[],
        help="a chip; may be repeated; 'all' for all of them",
    )  # fmt: skip
    parser.add_argument("--config", metavar="FILE.toml", type=Path, help="a readout file")
    parser.add_argument(
        "--rate", metavar="HZ", type=float, help="conversions per second, one of the chip's"
    )
    parser.add_argument("--seed", metavar="N", type=int, default=0, help="of the noise; default 0")
    parser.add_argument("--no-noise", action="store_true", help="rounding and saturation only")
    parser.add_argument("-o", "--output", metavar="DIR", type=Path, help="folder for the tables")
    parser.add_argument("--force", action="store_true", help="replace tables that are there")
    parser.add_argument(
        "--plot", metavar="PICTURE", type=Path,
        help=f"draw one channel instead of writing tables ({', '.join(PICTURES)})",
    )  # fmt: skip
    parser.add_argument(
        "--electrode", metavar="NAME", help="with --plot: the electrode; default the first"
    )


def execute(args: argparse.Namespace) -> int:
    """Read out, write or draw, and return the exit code."""
    from capsense.cli.main import OK

    if args.list:
        print(_listing(args.chip))
        return OK
    _check(args)
    from capsense.readout.recording import load_recording
    from capsense.recording.tables import write_counts

    recording = load_recording(args.recording)
    readouts = _build(args, recording)
    if args.plot is not None:
        from capsense.cli.readout_plot import plot_chips

        plot_chips(recording, readouts, args.electrode).savefig(args.plot, dpi=150)
        print(f"drawn to {args.plot}")
        return OK
    folder = args.output or recording.path.parent
    targets = {key: folder / f"counts_{key}.csv" for key in readouts}
    _prepare(folder, targets.values(), args.force)
    for key, readout in readouts.items():
        counts = readout(recording.time, recording.channels(readout.bank))
        write_counts(targets[key], counts)
        print(report(readout, counts, targets[key]) + "\n")
    return OK


def _check(args: argparse.Namespace) -> None:
    """Refuse what does not go together before anything is computed."""
    if args.recording is None:
        raise ReadoutError("no recording given; name the output folder of capsense run, or --list")
    if bool(args.chip) == (args.config is not None):
        raise ReadoutError("give --chip NAME or --config FILE.toml, one of them")
    if args.config is not None and (args.rate is not None or args.seed or args.no_noise):
        raise ReadoutError("--rate, --seed and --no-noise go with --chip; write them in the file")
    if args.seed < 0:
        raise ReadoutError(f"--seed {args.seed} must be zero or more")
    if args.electrode is not None and args.plot is None:
        raise ReadoutError("--electrode goes with --plot; the tables hold all channels")
    if args.plot is not None:
        if args.plot.suffix.lower() not in PICTURES:
            raise ReadoutError(
                f"--plot {args.plot} is no picture; give a name that ends in {', '.join(PICTURES)}"
            )
        if not args.plot.parent.is_dir():
            raise ReadoutError(f"--plot {args.plot}: there is no folder {args.plot.parent}")


def _build(args: argparse.Namespace, recording: CapacitanceRecord) -> dict[str, Readout]:
    """The readouts asked for, by a name for files."""
    from capsense.readout.channels import ChannelBank
    from capsense.readout.config import load_readout
    from capsense.readout.presets import (
        ReadoutOptions,
        build,
        chip_of,
        default_patterns,
        expected_of,
    )

    if args.config is not None:
        return {args.config.stem: load_readout(args.config, recording.electrodes)}
    from capsense.readout.chips import CHIPS

    names = list(CHIPS) if "all" in args.chip else args.chip
    out = {}
    for name in names:
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


def report(readout: Readout, counts: Counts, path: Path) -> str:
    """What came out, for people."""
    from capsense.cli.tables import facts, seconds, table

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


def _listing(chosen: list[str]) -> str:
    from capsense.cli.tables import table
    from capsense.readout.chips import CHIPS
    from capsense.readout.presets import chip_of

    if chosen and "all" not in chosen:
        return "\n\n".join(_figures(chip_of(name)) for name in chosen)
    rows = [
        (chip.name, chip.mode, f"{chip.rates[0].per_second:.4g}", chip.title)
        for chip in CHIPS.values()
    ]
    return table(("name", "mode", "conversions/s", "chip"), rows)


def _figures(chip: Chip) -> str:
    from capsense.cli.tables import table

    rows = [(f.quantity, f.status.value, f.value, f.source) for f in chip.facts]
    return f"{chip.title}\n\n" + table(("figure", "status", "value", "source"), rows)
