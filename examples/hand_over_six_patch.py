"""A tracked hand over six electrodes: joints from a file, filtered, sensed, drawn.

Run it: ``python examples/hand_over_six_patch.py [FOLDER]``; the plot goes to the folder (``out`` by
default). With ``--show`` it plays in the live view instead, in a browser, until Ctrl-C. Another
recording: ``--recording FILE`` (.npz, .json, .csv; see docs/humans.md).

The recording, ``examples/hands/reach.npz``, is synthetic: ``examples/hands/make_reach.py`` made it,
in the format of an OpenXR tracker, with noise, hidden fingertips, and half a second in which the
hand is lost.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import capsense as cs
from capsense._style import COLOURS, LEGEND, dress
from capsense.humans import Build, HandFilter, HandRecording, HandSample, TrackedHand

NAMES = [f"E{k}" for k in range(1, 7)]
RECORDING = Path(__file__).parent / "hands" / "reach.npz"


@dataclass
class Played:
    """What came of n frames."""

    samples: list[HandSample]
    """The hand, n."""
    raw: np.ndarray
    """Landmarks before the filter [m], (n, 21, 3)."""
    delta: np.ndarray
    """Changes of the self-capacitances [F], (n, 6)."""
    step_time: np.ndarray
    """Wall time of the steps of the simulator [s], (n,)."""
    hand_time: np.ndarray
    """Wall time from joints to bodies [s], (n,)."""


def play(
    recording: HandRecording, step: Callable[..., cs.Reading], *, real_time: bool = False
) -> Played:
    """Sense the hand of a recording, frame by frame.

    Args:
        recording: Joints of a tracker.
        step: Takes a scene and its time; that of a simulator, or of a page of the live view.
        real_time: Whether to wait for the time of each frame.
    """
    hand = TrackedHand(Build("female"), recording.side, recording.convention)
    smooth = HandFilter()
    samples, raw, delta, steps, hands = [], [], [], [], []
    began = time.perf_counter()
    for now, joints, confidence in recording:
        start = time.perf_counter()
        seen = hand.landmarks(joints)
        sample = smooth.update(now, seen, confidence)
        scene = cs.Scene(hand.bodies(sample.landmarks))
        middle = time.perf_counter()
        delta.append(np.diag(step(scene, time=now).delta))
        steps.append(time.perf_counter() - middle)
        hands.append(middle - start)
        samples.append(sample)
        raw.append(seen)
        if real_time:
            time.sleep(max(0.0, began + now - time.perf_counter()))
    return Played(samples, np.array(raw), np.array(delta), np.array(steps), np.array(hands))


def show(recording: HandRecording, port: int, preset: str = "standard") -> None:
    """Play in the live view, again and again."""
    with cs.show(cs.Simulator("six_patch", preset=preset), port=port) as page:
        print(f"{page.url}, Ctrl-C ends it", flush=True)
        length = recording.time[-1] + 1.0 / 60.0
        with suppress(KeyboardInterrupt):
            for begin in itertools.count(0.0, length):

                def step(scene: cs.Scene, *, time: float, begin: float = begin) -> cs.Reading:
                    return page.step(scene, time=begin + time)

                play(recording, step, real_time=True)


def report(recording: HandRecording, played: Played) -> None:
    """Print what happened."""
    status = [s.status for s in played.samples]
    runs = [0, *(k for k in range(1, len(status)) if status[k] != status[k - 1])]
    print("status:", ", ".join(f"{status[k]} from {recording.time[k]:.2f} s" for k in runs))
    print(f"from joints to bodies: median {1e3 * np.median(played.hand_time):.2f} ms")
    near = played.delta.max(axis=1) > 0.1 * played.delta.max()
    print(
        f"step: median {1e3 * np.median(played.step_time[10:]):.1f} ms, "
        f"near the sensor {1e3 * np.median(played.step_time[near]):.1f} ms"
    )
    print("largest change of each electrode [fF]:", np.round(1e15 * played.delta.max(axis=0), 1))


def draw(recording: HandRecording, played: Played, path: Path) -> None:
    """Height of the index fingertip, and signals, over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 6), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    nothing = np.full((21, 3), np.nan)
    shown = np.array([nothing if s.landmarks is None else s.landmarks for s in played.samples])
    above.plot(recording.time, 1e3 * played.raw[:, 8, 2], ".", ms=3, color=COLOURS[1], label="raw")
    above.plot(recording.time, 1e3 * shown[:, 8, 2], color=COLOURS[0], label="filtered")
    above.set(ylabel="height of the index fingertip [mm]", ylim=(-5, 180))
    for k, name in enumerate(NAMES):
        below.plot(recording.time, 1e15 * played.delta[:, k], label=name, color=COLOURS[k])
    below.set(xlabel="time [s]", ylabel="change of self-capacitance [fF]")
    below.set_yscale("symlog", linthresh=10.0)
    lost = np.array([s.status != "tracked" for s in played.samples])
    for axes in (above, below):
        axes.fill_between(
            recording.time, 0, 1, where=lost, transform=axes.get_xaxis_transform(), alpha=0.15,
            color="k", lw=0, label="hand lost, or on its way",
        )  # fmt: skip
        dress(axes)
        axes.legend(**LEGEND)
    figure.savefig(path, dpi=110)


def main(folder: Path, recording: Path = RECORDING, preset: str = "standard") -> Played:
    """Play, print and draw."""
    found = HandRecording.load(recording)
    played = play(found, cs.Simulator("six_patch", preset=preset).step)
    report(found, played)
    folder.mkdir(parents=True, exist_ok=True)
    draw(found, played, folder / "hand_over_six_patch.png")
    print(folder / "hand_over_six_patch.png")
    return played


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path("out"))
    parser.add_argument("--recording", type=Path, default=RECORDING)
    parser.add_argument("--preset", default="standard", help="of the simulator")
    parser.add_argument("--show", type=int, nargs="?", const=8080, metavar="PORT")
    words = parser.parse_args()
    if words.show is None:
        main(words.folder, words.recording, words.preset)
    else:
        show(HandRecording.load(words.recording), words.show, words.preset)
