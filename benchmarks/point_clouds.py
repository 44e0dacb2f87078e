"""Point clouds as bodies: agreement with the plain shapes, times.

``python benchmarks/point_clouds.py`` prints what ``docs/from_the_paper.md`` tells of point clouds.
Times are of this machine, one process, as found.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

import capsense as cs

BODIES = {
    "forearm, 45 mm radius": (cs.Capsule(0.045, 0.2), (0, np.pi / 2, 0.3), 0.045),
    "ball, 40 mm radius": (cs.Sphere(0.04), (0, 0, 0), 0.04),
}
GAPS = (0.002, 0.005, 0.01, 0.02, 0.05)
FEW, MANY = 2000, 50_000
PIXELS = (64, 128)
SPACING = 0.004
PITCHES = (0.01, 0.005, 0.003)


def surface_points(body: cs.Body, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly at random over a shape, with their normals, in the sensor frame."""
    mesh = body.shape.to_trimesh()
    corners = mesh.triangles
    rng = np.random.default_rng(1)
    face = rng.choice(len(corners), n, p=mesh.area_faces / mesh.area)
    u, v = rng.random((2, n, 1))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    a, b, c = corners[face].transpose(1, 0, 2)
    points = a + u * (b - a) + v * (c - a)
    return body.pose.apply(points), mesh.face_normals[face] @ body.pose.rotation.T


def perspective_depth(body: cs.Body, camera: cs.PerspectiveCamera, n: int) -> np.ndarray:
    """What a camera of n × n pixels sees of a body [m], by marching along the rays."""
    row, column = np.indices((n, n)).reshape(2, -1)
    rays = np.column_stack(
        [(column - camera.cx) / camera.fx, (row - camera.cy) / camera.fy, np.ones(n * n)]
    )
    length = np.linalg.norm(rays, axis=1)
    to_body = body.pose.inverse() @ camera.pose
    z = np.zeros(n * n)
    for _ in range(200):
        z += body.shape.signed_distance(to_body.apply(rays * z[:, None])) / length
    near = body.shape.signed_distance(to_body.apply(rays * z[:, None])) < 1e-6
    return np.where(near, z, np.nan).reshape(n, n)


def camera(n: int, x: float, z: float, turn: float) -> cs.PerspectiveCamera:
    """A camera of n × n pixels and 90° at (x, 0, z), turned about y [rad]."""
    pose = cs.Pose.from_euler((x, 0, z), (0, turn, 0))
    return cs.PerspectiveCamera(n / 2, n / 2, (n - 1) / 2, (n - 1) / 2, pose, far=0.8)


def clouds(body: cs.Body) -> dict[str, cs.Shape]:
    """The shapes that stand for a body."""
    out: dict[str, cs.Shape] = {}
    out[f"{FEW} at random"] = cs.point_surface(*surface_points(body, FEW))
    scan = surface_points(body, MANY)
    for pitch in PITCHES:
        out[f"scan, {1e3 * pitch:g} mm"] = cs.point_surface(*scan, spacing=pitch)
    for n in PIXELS:
        behind = camera(n, 0.0, -0.15, 0.0)
        seen = behind.points(perspective_depth(body, behind, n))
        out[f"camera behind, {n}²"] = cs.point_surface(seen)
        turn = np.arctan2(0.15, 0.08)
        sides = [camera(n, 0.15, 0.0, -turn), camera(n, -0.15, 0.0, turn)]
        both = np.concatenate([side.points(perspective_depth(body, side, n)) for side in sides])
        out[f"two at the sides, {n}²"] = cs.point_surface(both, spacing=SPACING)
    return out


def main() -> None:
    """Print the table, then times."""
    sim = cs.Simulator("six_patch")
    print("largest error of delta, % of its largest entry, worst of four places")
    rng = np.random.default_rng(0)
    places = rng.uniform(-0.02, 0.02, (4, 2))
    for name, (shape, turn, half) in BODIES.items():
        for gap in GAPS:
            worst: dict[str, float] = {}
            for x, y in places:
                pose = cs.Pose.from_euler((x, y, half + gap), turn)
                body = cs.Body(shape, pose)
                plain = sim.step(cs.Scene([body])).delta
                for label, cloud in clouds(body).items():
                    delta = sim.step(cs.Scene([cs.Body(cloud)])).delta
                    error = 100 * np.abs(delta - plain).max() / np.abs(plain).max()
                    worst[label] = max(worst.get(label, 0.0), error)
            cells = " | ".join(f"{v:.2f}" for v in worst.values())
            if gap == GAPS[0]:
                print("| body | gap |", " | ".join(worst), "|")
            print(f"| {name} | {gap * 1e3:g} mm | {cells} |")
    body = cs.Body(cs.Sphere(0.04), cs.Pose((0, 0, 0.05)))
    scan = surface_points(body, MANY)
    for pitch in PITCHES:
        timed(sim, f"scan, {pitch * 1e3:g} mm", lambda p=pitch: cs.point_surface(*scan, spacing=p))
    for n in PIXELS:
        behind = camera(n, 0.0, -0.15, 0.0)
        image = perspective_depth(body, behind, n)
        timed(sim, f"camera, {n}²", lambda b=behind, i=image: cs.point_surface(b.points(i)))


def timed(sim: cs.Simulator, name: str, make: Callable[[], cs.Shape]) -> None:
    """Print how long a ball takes to be made of points, and to be read."""
    times = []
    for _ in range(9):
        start = time.perf_counter()
        cloud = make()
        made = time.perf_counter()
        scene = cs.Scene([cs.Body(cloud)])
        sim.step(scene)
        first = time.perf_counter()
        sim.step(scene)
        times.append((made - start, first - made, time.perf_counter() - first))
    a, b, c = 1e3 * np.median(times, axis=0)
    print(
        f"ball, {name}, {len(cloud.faces)} pieces: shape {a:.1f} ms, first step {b:.1f} ms, "
        f"the next {c:.1f} ms"
    )


if __name__ == "__main__":
    main()
