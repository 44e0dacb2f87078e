"""Poses from the arrays of simulators, as kernels of NVIDIA Warp."""

from __future__ import annotations

import warp as wp


@wp.kernel(enable_backward=False)
def compose(
    parents: wp.array2d(dtype=wp.transform), number: wp.array2d(dtype=wp.int32),
    local: wp.array2d(dtype=wp.transform), out: wp.array2d(dtype=wp.transform),
):  # fmt: skip
    """Poses in the world of what is fixed to some of its bodies, -1 for the world itself."""
    w, k = wp.tid()
    at = local[w, k]
    if number[w, k] >= 0:
        at = wp.transform_multiply(parents[w, number[w, k]], at)
    out[w, k] = at


@wp.kernel(enable_backward=False)
def from_matrices(
    position: wp.array2d(dtype=wp.vec3), matrix: wp.array2d(dtype=wp.mat33),
    number: wp.array(dtype=wp.int32), out: wp.array2d(dtype=wp.transform),
):  # fmt: skip
    """Poses of some of what a simulator gives by positions and rotation matrices."""
    w, k = wp.tid()
    n = number[k]
    out[w, k] = wp.transform(position[w, n], wp.quat_from_matrix(matrix[w, n]))
