"""A sensor in MuJoCo, for asv; left out where MuJoCo is not installed."""

from __future__ import annotations

import capsense as cs

WORLD = """
<mujoco>
  <worldbody>
    <body name="robot"><geom type="box" size="0.1 0.1 0.01" pos="0 0 -0.03"/>
      <site name="pad" pos="0 0 0"/></body>
    <body name="finger" pos="0 0 0.05"><freejoint/>
      <geom name="finger" type="capsule" size="0.008 0.03" euler="0 90 0"/></body>
  </worldbody>
</mujoco>
"""


class Attach:
    """Attach, and read."""

    def setup(self) -> None:
        try:
            import mujoco
        except ImportError:
            raise NotImplementedError("MuJoCo is not installed") from None  # asv leaves it out
        self.model = mujoco.MjModel.from_xml_string(WORLD)
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.simulator = cs.Simulator("six_patch")
        self.time_attach()
        self.time_read()

    def time_attach(self) -> None:
        self.sensor = cs.mujoco.attach(self.model, self.data, site="pad", design=self.simulator)

    def time_read(self) -> None:
        self.sensor.read()
