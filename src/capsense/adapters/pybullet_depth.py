"""Depth images of PyBullet's TinyRenderer: software, no OpenGL."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from capsense.adapters.attached import DepthSensor
from capsense.adapters.pybullet_bodies import (
    BodyWatch,
    Link,
    Mount,
    check_patterns,
    gone,
    links_of,
    matter_of,
)
from capsense.adapters.rules import Image, Rules
from capsense.scene import Pose
from capsense.scene.camera import OrthographicCamera
from capsense.scene.depth import DepthFrame
from capsense.simulator import Simulator

Array = NDArray[np.float64]

_WITHDRAWN = 5.0
"""Distance of the renderer's camera behind the sensor [m]. TinyRenderer drops the faces that are
turned away from the camera as in a perspective view, which erodes silhouettes where it is near."""
_NEAR = 1e-4
"""Depth from which on things are seen [m]; what stands before is cut off."""
_CAMERA = Pose((0.0, 0.0, -_WITHDRAWN), (1.0, 0.0, 0.0, 0.0))
"""The OpenGL camera, which looks along its −z, in the sensor frame."""


class PybulletDepthSensor(DepthSensor):
    """A sensor that sees a depth image; made by :func:`capsense.adapters.pybullet.attach`."""

    def __init__(
        self, client: int, mount: Mount, simulator: Simulator, rules: Rules, image: Image
    ) -> None:
        super().__init__(simulator)
        self.client = client
        """Number of the physics client."""
        self.body, self.link = mount.body, mount.link
        """The body that carries the sensor, and its link, -1 for the base."""
        self._in_link, self._rules, self._image = mount.pose_in_link, rules, image
        far = float(simulator.design.domain.upper[2])
        self._near, self._far = _WITHDRAWN + _NEAR, _WITHDRAWN + far
        self._camera = OrthographicCamera(image.size, image.size, Pose(), near=_NEAR, far=far)
        self._projection = _projection(image.size, self._near, self._far, image.resolution)
        self._watch = BodyWatch(client)
        self._eps_r: dict[int, float] = {}
        check_patterns(rules, self._read_materials())

    def frame(self) -> DepthFrame:
        """The depth image of the present state."""
        import pybullet as p

        if self._watch.changed():
            links = self._read_materials()
            if (self.body, self.link) not in [(k.body, k.link) for k in links]:
                raise gone(self.body)
        n = self._image.resolution
        view = (self.pose @ _CAMERA).inverse().matrix.T.ravel().tolist()
        image = p.getCameraImage(
            n, n, view, self._projection, renderer=p.ER_TINY_RENDERER,
            flags=p.ER_SEGMENTATION_MASK_OBJECT_AND_LINKINDEX, physicsClientId=self.client,
        )  # fmt: skip
        buffer = np.asarray(image[3], dtype=float).reshape(n, n)
        seen = np.asarray(image[4]).reshape(n, n)
        depth = self._far * self._near / (self._far - (self._far - self._near) * buffer)
        depth -= _WITHDRAWN
        eps_r = np.zeros((n, n))
        for code in np.unique(seen[seen >= 0]).tolist():
            eps_r[seen == code] = self._eps_r.get(code, 0.0)
        return DepthFrame(
            depth, eps_r, self._camera, grounding=self._rules.default_grounding,
            back=self._image.back,
        )  # fmt: skip

    @property
    def pose(self) -> Pose:
        import pybullet as p

        if self.link < 0:
            inertial = p.getDynamicsInfo(self.body, -1, physicsClientId=self.client)[3:5]
            mass = p.getBasePositionAndOrientation(self.body, physicsClientId=self.client)
            return Pose(*mass) @ Pose(*inertial).inverse() @ self._in_link
        state = p.getLinkState(
            self.body, self.link, computeForwardKinematics=1, physicsClientId=self.client
        )
        return Pose(*state[4:6]) @ self._in_link

    def _read_materials(self) -> list[Link]:
        """What each code of the segmentation mask is made of: 0 for what is not seen."""
        links = [link for body in self._watch.bodies() for link in links_of(self.client, body)]
        self._eps_r = {}
        for link in links:
            own = (link.body, link.link) == (self.body, self.link)
            code = link.body + ((link.link + 1) << 24)
            if (own and self._rules.exclude_own) or self._rules.excludes(link.names):
                self._eps_r[code] = 0.0
                continue
            matter, _ = matter_of(self.client, link, self._rules)
            conducts = matter.is_conductor()
            self._eps_r[code] = np.inf if conducts else matter.eps_r
        return links


def _projection(size: float, near: float, far: float, resolution: int) -> list[float]:
    """The projection matrix, column by column, that TinyRenderer takes as orthographic.

    It mistreats true orthographic matrices, in which depth is linear (bulletphysics/bullet3 issue
    2628). This one has their rows for x and y and the row of a perspective for z; the shift by
    half a pixel brings its samples to the pixels' centres.
    """
    m = np.diag([2 / size, 2 / size, -(far + near) / (far - near), 1.0])
    m[2, 3] = -2 * far * near / (far - near)
    m[0, 3] = m[1, 3] = -1 / resolution
    return [float(v) for v in m.T.ravel()]
