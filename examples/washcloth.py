"""Scenario 2 of the paper with a washcloth: six electrodes wash a forearm, the cloth in contact.

Run it: ``python examples/washcloth.py [FOLDER]``; it needs MuJoCo. A tool holds a washcloth in a
frame in front of its electrodes and moves along a person's forearm, so that the cloth lies on the
skin and is bent by it. The same ride is read without the cloth, with a dry and with a wet one. A
plot goes to the folder (``out`` by default).
"""

from __future__ import annotations

import sys
from pathlib import Path

import mujoco
import numpy as np

import capsense as cs
from capsense.humans import Build
from capsense.humans.formats import mjcf_body
from capsense.reproduce.limb_worlds import SPEED, course

GAP = 0.015
"""From the electrodes to the skin below their middle [m]."""
STRETCHED = 0.021
"""From the electrodes to the cloth where the frame holds it [m]."""
COUNT, PITCH = 10, 0.013
"""Vertices along each side of the cloth, and their distance [m]."""
WAY = 0.12
"""Along the forearm [m]."""
RATE = 10.0
"""Readings per second [Hz]."""
LIFT = 0.05
"""Height from which the tool comes down at the beginning, and goes up to at the end [m]."""
DRY = cs.Material("dry washcloth", 1.8)
WET = cs.Material("wet washcloth", 45.0, 0.02)
"""Half water, half fibre; soapy tap water conducts some 0.1 S/m, and fibres leave less paths."""
CLOTHS: dict[str, cs.Material | None] = {"no cloth": None, "dry cloth": DRY, "wet cloth": WET}


def model() -> mujoco.MjModel:
    """The forearm, and the tool with the cloth in its frame, which looks down."""
    place = course(Build("male", percentile=50), "arm")
    arm = mjcf_body(place.limb, place.frame, damping=1e3)
    sides = [COUNT * i + j for i in range(COUNT) for j in (0, COUNT - 1)]  # along the arm
    out = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.002" gravity="0 0 0" integrator="discrete"/>'
        f'<size memory="64M"/><worldbody>{arm}'
        '<body name="tool"><inertial pos="0 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>'
        '<joint name="along" type="slide" axis="1 0 0"/>'
        '<joint name="up" type="slide" axis="0 0 1"/>'
        '<site name="pad" euler="180 0 0"/>'
        f'<flexcomp name="washcloth" type="grid" dim="2" count="{COUNT} {COUNT} 1" '
        f'spacing="{PITCH} {PITCH} {PITCH}" pos="0 0 {-STRETCHED}" radius="0.001" mass="0.05">'
        '<elasticity young="1e5" poisson="0.2" thickness="0.001" elastic2d="both"/>'
        '<contact selfcollide="none" solref="0.01 1"/>'
        f'<pin id="{" ".join(map(str, sides))}"/></flexcomp></body></worldbody><actuator>'
        '<position joint="along" kp="2e4" kv="400"/><position joint="up" kp="2e4" kv="400"/>'
        "</actuator></mujoco>"
    )
    out.jnt_stiffness[: len(place.limb.joints)] = 2e3  # the person keeps the arm where it is
    out.dof_damping[out.nv - 3 * COUNT * (COUNT - 2) :] = 0.02  # cloth does not swing
    return out


def skin_height(m: mujoco.MjModel, d: mujoco.MjData, x: float) -> float:
    """Height of the skin below a place on the way [m]."""
    hit = np.zeros(1, np.int32)
    groups = np.ones(6, np.uint8)
    down = mujoco.mj_ray(
        m, d, np.array([x, 0.0, 0.5]), np.array([0.0, 0.0, -1.0]), groups, 1, -1, hit
    )
    return 0.5 - down


class Ride:
    """The tool's way in simulated time: down onto the skin, along the forearm, and up again."""

    def __init__(self) -> None:
        self.model = model()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.time = 0.0
        self._heights = np.array(
            [skin_height(self.model, self.data, x) for x in np.linspace(-WAY, WAY, 65)]
        )
        self.place(0.0)
        tool = [self.model.joint(name).qposadr[0] for name in ("along", "up")]
        self.data.qpos[tool] = self.data.ctrl
        mujoco.mj_forward(self.model, self.data)

    @property
    def duration(self) -> float:
        """Of the whole ride [s]."""
        return 2 * LIFT / SPEED + WAY / SPEED

    def place(self, time: float) -> None:
        """Tell the tool where to be at a time [s]."""
        pause = LIFT / SPEED
        along = np.clip((time - pause) * SPEED, 0.0, WAY) - WAY / 2
        up = max(0.0, LIFT - SPEED * time, LIFT - SPEED * (self.duration - time))
        height = np.interp(along, np.linspace(-WAY, WAY, 65), self._heights)
        self.data.ctrl[:] = along, height + GAP + up

    def go_on(self) -> None:
        """Simulate up to the next reading."""
        for _ in range(round(1 / (RATE * self.model.opt.timestep))):
            self.time += self.model.opt.timestep
            self.place(self.time)
            mujoco.mj_step(self.model, self.data)

    @property
    def contacts(self) -> int:
        """Places where the cloth touches the skin."""
        flex = self.data.contact.flex if self.data.ncon else np.zeros((0, 2))
        return int((np.asarray(flex).reshape(-1, 2) >= 0).any(axis=1).sum())


def attach(ride: Ride, cloth: cs.Material | None) -> cs.AttachedSensor:
    """Six electrodes that feel the person on 100 pF, and the cloth, if there is one."""
    rules = {"right_arm*": "human"}
    return cs.mujoco.attach(
        ride.model, ride.data, site="pad", design="six_patch",
        materials=rules if cloth is None else rules | {"washcloth": cloth},
        grounding={"right_arm*": 100e-12} | ({} if cloth is None else {"washcloth": "floating"}),
        exclude=["washcloth"] if cloth is None else [],
    )  # fmt: skip


def record() -> tuple[np.ndarray, np.ndarray, dict[str, np.ndarray]]:
    """Times [s], contacts, and for each cloth the changes of the six electrodes [F], (n, 6)."""
    ride = Ride()
    sensors = {name: attach(ride, cloth) for name, cloth in CLOTHS.items()}
    times, contacts = [], []
    changes: dict[str, list[np.ndarray]] = {name: [] for name in sensors}
    while ride.time < ride.duration:
        ride.go_on()
        times.append(ride.time)
        contacts.append(ride.contacts)
        for name, sensor in sensors.items():
            changes[name].append(np.diag(sensor.read().delta)[:6])
    return np.array(times), np.array(contacts), {k: np.array(v) for k, v in changes.items()}


def draw(
    file: Path, times: np.ndarray, contacts: np.ndarray, changes: dict[str, np.ndarray]
) -> None:
    """Six panels as the electrodes lie, three curves each; grey where the cloth is in contact."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with plt.style.context("capsense.plotting.capsense"):
        figure, axes = plt.subplots(2, 3, figsize=(9, 4.6), sharex=True, sharey=True)
        for k, panel in enumerate(axes[::-1].ravel()):
            panel.fill_between(
                times, 0, 1, where=contacts > 0, color="0.92", transform=panel.get_xaxis_transform()
            )
            for name, values in changes.items():
                panel.plot(times, 1e12 * values[:, k], label=name)
            panel.set_title(f"E{k + 1}", loc="left")
        for panel in axes[:, 0]:
            panel.set_ylabel("change, pF")
        for panel in axes[1]:
            panel.set_xlabel("time, s")
        axes[0, 0].legend()
        figure.tight_layout()
        figure.savefig(file)
        plt.close(figure)


def main() -> None:
    """Ride, print a table, and draw."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "out")
    folder.mkdir(parents=True, exist_ok=True)
    times, contacts, changes = record()
    touched = contacts > 0
    print(f"{len(times)} readings, {int(touched.sum())} with the cloth in contact")
    bare = changes["no cloth"]
    for name, values in changes.items():
        more = values[touched].mean() / bare[touched].mean() - 1.0
        print(f"{name:10s} in contact {1e12 * values[touched].mean():6.3f} pF ({more:+.1%}), "
              f"in the air {1e15 * values[0].mean():6.1f} fF")  # fmt: skip
    draw(folder / "washcloth.png", times, contacts, changes)


if __name__ == "__main__":
    main()
