# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Triangles with their corners written out, and darker where they turn away from a light."""
from __future__ import annotations

from math import sqrt

from numba import njit
import numpy as np
from numpy.typing import NDArray

_LIGHT = (0.36, 0.48, 0.8)  # towards it, in the world: shared faces of views look alike
_DARKEST = 0.45  # what a face turned away from the light keeps of its colour


def triangle_corners(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], colours: NDArray[np.uint8],
    shading: bool,
) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """
    Return the corners of triangles, one triangle after the other.

    :param vertices: (n, 3) float64
    :param faces: (m, 3) int32, indices of vertices
    :param colours: (n, 3) uint8, of the vertices
    :param shading: whether faces turned away from a light of the world are darker (Lambert)
    :return: (3 m, 3) float64 points and (3 m, 3) uint8 colours
    """
    points = np.empty((faces.size, 3))
    shaded = np.empty((faces.size, 3), np.uint8)
    _write(vertices, faces, colours, _DARKEST if shading else 1.0, points, shaded)
    return points, shaded


@njit(cache=True, nogil=True, error_model='numpy')
def _write(
    vertices: NDArray[np.float64], faces: NDArray[np.int32], colours: NDArray[np.uint8],
    darkest: float, points: NDArray[np.float64], shaded: NDArray[np.uint8],
) -> None:
    for m in range(len(faces)):
        a, b, c = faces[m]
        x, y, z = vertices[a]
        x1, y1, z1 = vertices[b, 0] - x, vertices[b, 1] - y, vertices[b, 2] - z
        x2, y2, z2 = vertices[c, 0] - x, vertices[c, 1] - y, vertices[c, 2] - z
        nx, ny, nz = y1 * z2 - z1 * y2, z1 * x2 - x1 * z2, x1 * y2 - y1 * x2
        length = max(sqrt(nx * nx + ny * ny + nz * nz), 1e-20)
        cosine = (nx * _LIGHT[0] + ny * _LIGHT[1] + nz * _LIGHT[2]) / length
        brightness = min(darkest + 0.5 * (1.0 - darkest) * (1.0 + cosine), 1.0)
        for k in range(3):
            vertex = faces[m, k]
            for axis in range(3):
                points[3 * m + k, axis] = vertices[vertex, axis]
                shaded[3 * m + k, axis] = np.uint8(brightness * colours[vertex, axis])
