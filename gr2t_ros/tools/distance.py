# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Exact distances of points to the triangles of a mesh.

Own code, since no library of this package does it: trimesh needs a minute for a million points,
embreex does not offer Embree's point queries, and a k-d tree of the triangles' centres is slow
where small and large triangles meet.
"""
from __future__ import annotations

from numba import njit
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Vector = tuple[float, float, float]

_LEAF = 4  # triangles: fewer are faster, and take more memory


class Surface:
    """
    A set of triangles that tells how far points are from it.

    A binary tree of boxes over the triangles in Morton order: the children of box i are the boxes
    2 i and 2 i + 1, those of the last level hold _LEAF triangles each.

    :param triangles: (m, 3, 3) float64, metres; at least one
    """

    def __init__(self, triangles: ArrayLike) -> None:
        triangles = np.asarray(triangles, np.float64)
        order = np.argsort(_morton_codes(triangles.mean(axis=1)), kind='stable')
        leaves = 1
        while leaves * _LEAF < len(triangles):
            leaves *= 2
        # what is left over in the last leaves are copies of the last triangle
        order = np.append(order, np.full(leaves * _LEAF - len(order), order[-1]))
        self._triangles = np.ascontiguousarray(triangles[order])
        low, high = self._triangles.min(axis=1), self._triangles.max(axis=1)
        self._boxes = np.zeros((2 * leaves, 2, 3))
        low = low.reshape(leaves, _LEAF, 3).min(axis=1)
        high = high.reshape(leaves, _LEAF, 3).max(axis=1)
        while True:
            self._boxes[len(low):2 * len(low), 0] = low
            self._boxes[len(low):2 * len(low), 1] = high
            if len(low) == 1:
                break
            low, high = np.minimum(low[::2], low[1::2]), np.maximum(high[::2], high[1::2])

    def distances(self, points: ArrayLike) -> Floats:
        """
        Return the distance of each point to the nearest triangle.

        :param points: (n, 3), metres
        :return: (n,) float64, metres
        """
        points = np.asarray(points, np.float64).reshape(-1, 3)
        # neighbours one after the other look at the same triangles
        order = np.argsort(_morton_codes(points))
        result = np.empty(len(points))
        result[order] = np.sqrt(
            _squared_distances(points[order], self._boxes, self._triangles))
        return result


def _morton_codes(points: Floats) -> NDArray[np.uint64]:
    """Return the points' places on a curve through space that keeps neighbours together."""
    if len(points) == 0:
        return np.zeros(0, np.uint64)
    low = points.min(axis=0)
    size = max(float(np.max(points.max(axis=0) - low)), 1e-300)
    codes = np.zeros(len(points), np.uint64)
    for axis, cell in enumerate(((points - low) / size * (2 ** 21 - 1)).astype(np.uint64).T):
        # spread 21 bits to every third of 63
        for shift, mask in (
                (32, 0x1F00000000FFFF), (16, 0x1F0000FF0000FF), (8, 0x100F00F00F00F00F),
                (4, 0x10C30C30C30C30C3), (2, 0x1249249249249249)):
            cell = (cell | cell << np.uint64(shift)) & np.uint64(mask)
        codes |= cell << np.uint64(axis)
    return codes


@njit(cache=True, nogil=True)
def _squared_distances(points: Floats, boxes: Floats, triangles: Floats) -> Floats:
    result = np.empty(len(points))
    stack = np.empty(64, np.int64)
    bounds = np.empty(64)
    leaves = len(boxes) // 2
    near = 0  # a triangle near the last point is near this one too, mostly
    for i in range(len(points)):
        p = _point(points[i])
        best = _to_triangle(p, triangles[near])
        stack[0], bounds[0] = 1, 0.0
        depth = 1
        while depth > 0:
            depth -= 1
            if bounds[depth] >= best:
                continue
            box = stack[depth]
            if box >= leaves:
                for t in range((box - leaves) * _LEAF, (box - leaves + 1) * _LEAF):
                    d = _to_triangle(p, triangles[t])
                    if d < best:
                        best, near = d, t
                continue
            first, second = 2 * box, 2 * box + 1
            a, b = _to_box(p, boxes[first]), _to_box(p, boxes[second])
            if a < b:  # the nearer one is looked at first: it lies on top
                first, second, a, b = second, first, b, a
            stack[depth], bounds[depth] = first, a
            stack[depth + 1], bounds[depth + 1] = second, b
            depth += 2
        result[i] = best
    return result


@njit(cache=True, nogil=True)
def _to_box(p: Vector, box: Floats) -> float:
    """Return the squared distance of a point to a box."""
    x = max(box[0, 0] - p[0], p[0] - box[1, 0], 0.0)
    y = max(box[0, 1] - p[1], p[1] - box[1, 1], 0.0)
    z = max(box[0, 2] - p[2], p[2] - box[1, 2], 0.0)
    return x * x + y * y + z * z


@njit(cache=True, nogil=True)
def _to_triangle(p: Vector, triangle: Floats) -> float:
    """Return the squared distance of a point to a triangle, which may be degenerate."""
    a, b, c = _point(triangle[0]), _point(triangle[1]), _point(triangle[2])
    n = _cross(_minus(b, a), _minus(c, a))
    squared = _dot(n, n)
    above = squared > 0.0
    least = np.inf
    for start, end in ((a, b), (b, c), (c, a)):
        side, to = _minus(end, start), _minus(p, start)
        above = above and _dot(n, _cross(side, to)) >= 0.0
        length = _dot(side, side)
        t = min(max(_dot(side, to) / length, 0.0), 1.0) if length > 0.0 else 0.0
        off = _minus(to, (t * side[0], t * side[1], t * side[2]))
        least = min(least, _dot(off, off))
    return _dot(n, _minus(p, a)) ** 2 / squared if above else least


# numba keeps tuples in registers; small arrays would cost an allocation each

@njit(cache=True, nogil=True)
def _point(a: Floats) -> Vector:
    return a[0], a[1], a[2]


@njit(cache=True, nogil=True)
def _minus(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@njit(cache=True, nogil=True)
def _cross(a: Vector, b: Vector) -> Vector:
    return (
        a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@njit(cache=True, nogil=True)
def _dot(a: Vector, b: Vector) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
