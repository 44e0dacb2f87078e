"""Fleets on a GPU: speed, memory, share of a simulator's step, error and roofline, in nine minutes.

    python benchmarks/gpu.py                                         # cuda:0, out/gpu.json
    python benchmarks/gpu.py --write docs/fleets.md                  # the table into the page, too
    python benchmarks/gpu.py --device warp:cpu --counts 8 --budgets 32 --scenes 4   # for tests

A solve is one sensor in one environment: ``six_patch_bare`` before one finger, as in
``benchmarks/fleet.py``, with the poses on the device. Parts that would not end in ``--seconds`` or
not fit into the device's memory are left out; the result names them.

- rates: median step, with and without derivatives, and memory that a sensor takes.
- simulator: a forearm that falls past one sensor in MuJoCo Warp; the sensor's reading over the
  physics' step and the reading together.
- errors: entries of ΔC in scenes of the reference map beside ``Simulator(preset="fine")``, over the
  largest of each scene.
- kernels: time of each kernel of a step, which waits for each here; and of the largest ones, how
  long the device would take at its peak for the floating-point operations and for the bytes of
  :func:`work`, whichever is longer. Peaks are measured: multiply-adds in registers, and copies.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import warp as wp
from machine import describe_machine
from pages import write_between

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "helpers"))

import fleet as benchmark
from reference_scenes import DESIGN, fleet_of, reference_scenes

import capsense as cs
from capsense.fleet.warp_core import known_device

SECONDS = 540.0
STEPS = 5
MARKERS = "<!-- gpu -->", "<!-- end of gpu -->"
CHAINS, LENGTH = 8, 256
"""Multiply-adds of a thread that do not wait for each other, and how many follow each other."""
MEAN, SOURCE = 60, 68
"""Floating-point operations of a mean of 1/r by second moments, and of a source's potential at four
points, a square root or a division counted as one."""


chains = wp.types.vector(length=CHAINS, dtype=wp.float32)
_LENGTH = wp.constant(LENGTH)


@wp.kernel
def _multiply(out: wp.array(dtype=wp.float32)):
    i = wp.tid()
    x = chains(float(i) * 1.0e-9)
    y = chains(1.0e-3)
    for _ in range(_LENGTH):
        x = 0.999 * x + y
    out[i] = wp.dot(x, y)


class Clock:
    """Times of work on a device, and how much of the whole time is left."""

    def __init__(self, device: Any, seconds: float) -> None:
        self.device, self.end = device, perf_counter() + seconds

    @property
    def left(self) -> float:
        """Seconds that are left."""
        return self.end - perf_counter()

    def time(self, work: Any, repeats: int = STEPS) -> float:
        """Median time of some work [s], after a first time that does not count."""
        found = []
        for _ in range(repeats + 1):
            wp.synchronize_device(self.device)
            start = perf_counter()
            work()
            wp.synchronize_device(self.device)
            found.append(perf_counter() - start)
        return float(np.median(found[1:]))


def peaks(clock: Clock) -> dict[str, float]:
    """Floating-point operations and bytes that the device does in a second."""
    device = clock.device
    threads = 2**22 if device.is_cuda else 2**14
    out = wp.zeros(threads, dtype=wp.float32, device=device)
    spent = clock.time(lambda: wp.launch(_multiply, threads, [out], device=device))
    size = 2**28 if device.is_cuda else 2**22
    first, second = (wp.zeros(size, dtype=wp.float32, device=device) for _ in range(2))
    copied = clock.time(lambda: wp.copy(second, first))
    return {"flops": 2 * CHAINS * LENGTH * threads / spent, "bytes": 8.0 * size / copied}


def finger_fleet(clock: Clock, count: int, budget: int) -> tuple[cs.Fleet, Any]:
    """A fleet before one finger, and poses on its device."""
    name = clock.device.alias
    name = name if clock.device.is_cuda else f"warp:{name}"
    fleet = cs.Fleet(DESIGN, [benchmark.FINGER], count, device=name, budget=budget)
    poses = benchmark.fingers(count, np.random.default_rng(count)).astype(np.float32)
    return fleet, wp.array(poses, dtype=wp.float32, device=clock.device)


def rate(clock: Clock, count: int, budget: int) -> dict[str, Any]:
    """Speed of a fleet."""
    fleet, poses = finger_fleet(clock, count, budget)
    plain = clock.time(lambda: fleet.step(poses))
    whole = clock.time(lambda: fleet.step(poses, jacobian=True))
    return {
        "budget": budget, "environments": count, "step": plain, "with_derivatives": whole,
        "solves": count / plain,
    }  # fmt: skip


def work(fleet: cs.Fleet) -> dict[str, tuple[float, float]]:
    """Floating-point operations and bytes of the largest kernels of a fleet's last step.

    Of arrays, each number that a kernel needs is read, and each that it makes is written, once.
    n functions, w columns of φ⁰ and ψ of which m are of ψ, t terminals in c columns, and on leaf i
    s_i sources that count:

    - rows: Σ s_i (68 + 2 w) over clusters; n w numbers.
    - pairs: 60 for each of n (n + 1) / 2 pairs and each body they are of; n² numbers.
    - assemble: m n²; 3 n² / 2 + n m numbers.
    - factorise: n³ / 3; n² numbers.
    - forward, charges: t n² each; n² / 2 + 2 n t numbers.
    - residuals: Σ s_i (68 + 2 c) over parts of clusters, and (60 + 2 c) for each of these and each
      cluster; n c numbers read and n c written.
    """
    core = fleet._warp
    cut, green = core.cut, core.green
    node, near = cut.node.numpy(), cut.near.numpy()
    there = (node >= 0) & (cut.outside_fraction.numpy() < 1.0)
    sources = np.where(near < 1.0, green.far, 0) + np.where(
        near > 0.0, len(green.sources) - green.far, 0
    )
    sources = np.where(there, sources, 0).astype(float)
    total = cut.number.shape[0]
    n = (cut.number.numpy() >= 0).sum(axis=0).astype(float)
    parts = (node[total:] >= 0).sum(axis=0).astype(float)
    w = cut.width.numpy().astype(float)
    m, t, c = w - green.first, float(green.terminals), float(green.phi_columns)
    on, below = sources[:total].sum(axis=0), sources[total:].sum(axis=0)
    count = {
        "rows": (on * (SOURCE + 2 * w), n * w),
        "pairs": (MEAN * n * (n + 1) / 2, n * n),
        "assemble": (m * n * n, 1.5 * n * n + n * m),
        "factorise": (n**3 / 3, n * n),
        "forward": (t * n * n, n * n / 2 + 2 * n * t),
        "charges": (t * n * n, n * n / 2 + 2 * n * t),
        "residuals": (below * (SOURCE + 2 * c) + parts * n * (MEAN + 2 * c), 2 * n * c),
    }
    return {name: (float(f.sum()), 4.0 * float(b.sum())) for name, (f, b) in count.items()}


def kernels(clock: Clock, count: int, budget: int, peak: dict[str, float]) -> list[dict[str, Any]]:
    """Times of the kernels of a step [s], and the least that the device would take."""
    fleet, poses = finger_fleet(clock, count, budget)
    core, spent = fleet._warp, {}
    fleet.step(poses)
    launch = core.launch

    def timed(kernel: Any, dim: Any, *arguments: Any) -> None:
        wp.synchronize_device(clock.device)
        start = perf_counter()
        launch(kernel, dim, *arguments)
        wp.synchronize_device(clock.device)
        name = kernel.func.__name__
        spent[name] = spent.get(name, 0.0) + perf_counter() - start

    core.launch = timed
    try:
        fleet.step(poses)
    finally:
        core.launch = launch
    counted, out = work(fleet), []
    for name, seconds in sorted(spent.items(), key=lambda item: -item[1]):
        row: dict[str, Any] = {"kernel": name, "seconds": seconds}
        if name in counted:
            flops, data = counted[name]
            least = max(flops / peak["flops"], data / peak["bytes"])
            row |= {"flops": flops, "bytes": data, "least": least, "share": least / seconds}
        out.append(row)
    return out


def simulator_share(clock: Clock, worlds: int, budget: int) -> dict[str, Any]:
    """What a reading takes beside a step of MuJoCo Warp.

    Raises:
        ImportError: MuJoCo Warp is not installed.
    """
    import mujoco
    import mujoco_warp as mjw

    sys.path.insert(0, str(Path(__file__).parents[1] / "examples"))
    from fleet_mujoco_warp import MODEL

    from capsense.adapters.mujoco_warp import CapacitiveSensors

    with wp.ScopedDevice(clock.device):
        model = mujoco.MjModel.from_xml_string(MODEL)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        there, on_device = mjw.put_data(model, data, nworld=worlds), mjw.put_model(model)
        sensors = CapacitiveSensors(
            model, there, ["pad"], materials={"forearm": "human"}, budget=budget
        )

        def step() -> None:
            mjw.step(on_device, there)
            mjw.kinematics(on_device, there)

        physics, reading = clock.time(step), clock.time(lambda: sensors.read(there))
    return {
        "worlds": worlds, "budget": budget, "physics": physics, "reading": reading,
        "share": reading / (physics + reading),
    }  # fmt: skip


def errors(clock: Clock, budget: int, scenes: list[Any], truth: list[Any]) -> dict[str, Any]:
    """Differences to ``Simulator(preset="fine")`` [%]."""
    device = clock.device.alias
    device = device if clock.device.is_cuda else f"warp:{device}"
    fleet, poses = fleet_of(scenes, device=device, budget=budget)
    found = fleet.step(poses).delta.numpy()[:, 0].astype(float)
    apart = 100 * (found - truth) / np.abs(truth).max(axis=(1, 2), keepdims=True)
    return {
        "budget": budget, "scenes": len(scenes), "rms": float(np.sqrt((apart**2).mean())),
        "worst": float(np.abs(apart).max()),
    }  # fmt: skip


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """All results; the parts that were left out are under ``left_out``."""
    device = known_device(options.device)
    clock, begun = Clock(device, options.seconds), perf_counter()
    machine = describe_machine(("capsense", "numpy", "warp-lang", "mujoco-warp"))
    total = device.total_memory if device.is_cuda else 0
    out: dict[str, Any] = {
        "machine": machine, "device": device.name, "device_name": options.device,
        "memory": total, "peaks": peaks(clock), "rates": [], "errors": [], "left_out": [],
    }  # fmt: skip
    left_out, small = out["left_out"], min(options.counts)
    known: dict[int, tuple[int, int]] = {}
    some = {"device": options.device}
    for budget in options.budgets:
        if clock.left <= 0.0:
            left_out.append(f"budget {budget}: no time left")
            continue
        known[budget] = benchmark.memory({**some, "budget": budget}, False)
        cost = 0.0
        for count in sorted(options.counts):
            if total and count * known[budget][1] > 0.8 * device.free_memory:
                left_out.append(f"budget {budget}, {count} environments: memory")
            elif 2 * (STEPS + 1) * 4 * cost * count > clock.left:
                left_out.append(f"budget {budget}, {count} environments: no time left")
            else:
                found = rate(clock, count, budget)
                plain, whole = known[budget]
                out["rates"].append({**found, "bytes": plain, "bytes_with_derivatives": whole})
                cost = found["with_derivatives"] / count
                small = max(small, count) if budget == options.budgets[0] else small
    budget = options.budgets[0]
    if clock.left > 0.0 and budget in known:
        out["kernels"] = kernels(clock, small, budget, out["peaks"])
    else:
        left_out.append("kernels: no time left")
    if clock.left > 0.0:
        try:
            out["simulator"] = simulator_share(clock, small, budget)
        except ImportError as error:
            left_out.append(f"simulator: {error}")
    else:
        left_out.append("simulator: no time left")
    scenes = [
        s for s in reference_scenes()
        if all(isinstance(b.shape, benchmark.PRIMITIVES) for b in s.scene)
    ][: options.scenes]  # fmt: skip
    fine = cs.Simulator(DESIGN, preset="fine") if clock.left > 0.0 else None
    truth = np.array([fine.step(s.scene).delta for s in scenes] if fine else [])
    for budget in options.budgets:
        if fine is None or clock.left <= 0.0:
            left_out.append(f"errors at budget {budget}: no time left")
        else:
            out["errors"].append(errors(clock, budget, scenes, truth))
    out["seconds"] = perf_counter() - begun
    return out


def table(found: dict[str, Any]) -> str:
    """The results as Markdown."""
    peak = found["peaks"]
    out = [
        f"`python benchmarks/gpu.py --device {found['device_name']}` on {found['device']}, with "
        f"Warp {found['machine']['versions'].get('warp-lang', 'unknown')}; peaks measured: "
        f"{peak['flops'] / 1e12:.3g} TFLOP/s in single precision, {peak['bytes'] / 1e9:.3g} GB/s.",
        "",
        "| budget | environments | solves a second | step | with derivatives | memory | "
        'rms, worst difference to `"fine"` |',
        "|---|---|---|---|---|---|---|",
    ]
    off = {row["budget"]: row for row in found["errors"]}
    for row in found["rates"]:
        far = off.get(row["budget"])
        told = f"{far['rms']:.2f} %, {far['worst']:.1f} %" if far else "not measured"
        out.append(
            f"| {row['budget']} | {row['environments']:,} | {row['solves']:,.0f} | "
            f"{1e3 * row['step']:.3g} ms | {1e3 * row['with_derivatives']:.3g} ms | "
            f"{row['bytes'] / 1e3:.0f} kB | {told} |"
        )
    if "simulator" in found:
        one = found["simulator"]
        out += ["", (
            f"In {one['worlds']:,} worlds of MuJoCo Warp at budget {one['budget']}, a step of the "
            f"physics takes {1e3 * one['physics']:.3g} ms and a reading {1e3 * one['reading']:.3g} "
            f"ms, {100 * one['share']:.0f} % of both together."
        )]  # fmt: skip
    if "kernels" in found:
        out += ["", "| kernel | time | of a step | of the roofline |", "|---|---|---|---|"]
        whole = sum(row["seconds"] for row in found["kernels"])
        for row in found["kernels"][:8]:
            part = f"{100 * row['share']:.0f} %" if "share" in row else ""
            out.append(
                f"| `{row['kernel']}` | {1e3 * row['seconds']:.3g} ms | "
                f"{100 * row['seconds'] / whole:.0f} % | {part} |"
            )
    if found["left_out"]:
        out += ["", f"Left out: {'; '.join(found['left_out'])}."]
    return "\n".join(out)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--device", default="cuda:0", help="cuda:0, or warp:cpu for tests")
    parser.add_argument("--counts", type=int, nargs="+", default=[1024, 4096, 16384, 65536])
    parser.add_argument("--budgets", type=int, nargs="+", default=[64, 32, 128])
    parser.add_argument("--scenes", type=int, default=1000, help="at most so many scenes")
    parser.add_argument("--seconds", type=float, default=SECONDS, help="at most so long")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/gpu.json"))
    parser.add_argument("--write", type=Path, help="a page with the marks of the table")
    options = parser.parse_args(arguments)
    try:
        known_device(options.device)
    except ValueError as error:
        parser.error(str(error))
    found = measure(options)
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(table(found))
    if options.write is not None:
        write_between(options.write, MARKERS, table(found))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
