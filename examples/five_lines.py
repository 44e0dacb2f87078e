"""A grounded steel bar 30 mm above six electrodes: what each of them reads."""

import capsense as cs

sim = cs.Simulator("six_patch")
bar = cs.Body(cs.Box((0.15, 0.15, 0.02)), pose=cs.Pose((0, 0, 0.04)), material="steel")
reading = sim.step(cs.Scene([bar]))
for name, change in zip(sim.electrode_names, reading.delta.diagonal(), strict=True):
    print(f"{name}: {change * 1e15:+.1f} fF")
