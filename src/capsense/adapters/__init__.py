"""Sensors attached to robot simulators: MuJoCo, PyBullet, Assistive Gym, CoppeliaSim.

Every adapter hands out an :class:`~capsense.adapters.attached.AttachedSensor`. What they share:

- :mod:`~capsense.adapters.rules`: what things are made of, by the patterns of their names
- :mod:`~capsense.adapters.world`: the solids of a simulator, placed in the sensor frame
- :mod:`~capsense.adapters.meshes`: triangle meshes made into solids
"""
