# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
A z-buffer: triangles to pixels without a GPU, OpenGL or a display.

Own code, since the renderers among the libraries want OpenGL (pyrender, VTK, Open3D) or take
minutes for a million triangles (matplotlib).
"""
from __future__ import annotations

from dataclasses import dataclass
from math import ceil, floor

from numba import njit
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float32]

# layers this close behind the nearest one, as a share of its depth, are averaged with it: the
# meshes of several views overlap, and would speckle
_LAYERS = 0.004


@dataclass(frozen=True, eq=False)
class Raster:
    """
    What each pixel sees.

    :param depth: (h, w) float32, metres, infinite where nothing is seen
    :param normal: (h, w, 3) float32 unit vectors in the camera's frame, towards the camera
    :param colour: (h, w, 3) float32, 0 to 255
    """

    depth: Floats
    normal: Floats
    colour: Floats


def rasterise(
    points: Floats, normals: Floats, faces: NDArray[np.int32], colours: NDArray[np.uint8],
    focal: float, width: int, height: int,
) -> Raster:
    """
    Draw triangles, seen from both sides, through a pinhole in the middle of the image.

    :param points: (n, 3) float32, camera's frame, metres; triangles that reach behind the camera
        are left out
    :param normals: (n, 3) float32, camera's frame
    :param faces: (m, 3) int32
    :param colours: (n, 3) uint8
    :param focal: pixels
    """
    inverse = np.zeros(len(points), np.float32)
    np.divide(1.0, points[:, 2], out=inverse, where=points[:, 2] > 1e-6)
    pixels = np.column_stack([
        points[:, 0] * inverse * focal + (width - 1) / 2,
        points[:, 1] * inverse * focal + (height - 1) / 2, inverse]).astype(np.float32)
    away = np.einsum('ij,ij->i', normals, points) > 0
    attributes = np.column_stack([
        np.where(away[:, None], -normals, normals), colours]).astype(np.float32)
    nearest = np.zeros((height, width), np.float32)
    sums = np.zeros((height, width, 7), np.float32)
    _draw(pixels, faces, attributes, nearest, sums, False)
    _draw(pixels, faces, attributes, nearest, sums, True)
    seen = nearest > 0
    depth = np.full((height, width), np.inf, np.float32)
    np.divide(1.0, nearest, out=depth, where=seen)
    sums /= np.where(seen, sums[..., 6], np.float32(1))[..., None]
    normal, colour = sums[..., :3], sums[..., 3:6]
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-6)
    return Raster(depth, normal, colour)


@njit(cache=True, nogil=True, error_model='numpy')
def _draw(
    pixels: Floats, faces: NDArray[np.int32], attributes: Floats, nearest: Floats, sums: Floats,
    shade: bool,
) -> None:
    """
    Find the nearest surface, or add up what lies at it.

    :param pixels: (n, 3) u, v in pixels, 1 / depth (0: not in front of the camera)
    :param attributes: (n, 6)
    :param nearest: (h, w) 1 / depth; found where not shade, used where shade
    :param sums: (h, w, 7) weighted attributes and weight; used where shade
    """
    height, width = nearest.shape
    for f in range(len(faces)):
        a, b, c = faces[f]
        xa, ya, wa = pixels[a]
        xb, yb, wb = pixels[b]
        xc, yc, wc = pixels[c]
        area = (xb - xa) * (yc - ya) - (yb - ya) * (xc - xa)
        if not min(wa, wb, wc) > 0.0 or area == 0.0:
            continue
        left, right = min(xa, xb, xc), max(xa, xb, xc)
        top, bottom = min(ya, yb, yc), max(ya, yb, yc)
        if not (right >= 0.0 and bottom >= 0.0 and left <= width - 1 and top <= height - 1):
            continue
        scale = 1.0 / area
        for y in range(max(ceil(top), 0), min(floor(bottom), height - 1) + 1):
            for x in range(max(ceil(left), 0), min(floor(right), width - 1) + 1):
                pa = ((xb - x) * (yc - y) - (yb - y) * (xc - x)) * scale
                pb = ((xc - x) * (ya - y) - (yc - y) * (xa - x)) * scale
                pc = 1.0 - pa - pb
                if pa < -1e-5 or pb < -1e-5 or pc < -1e-5:
                    continue
                # 1 / depth is linear in the image, and so are attributes times 1 / depth
                w = pa * wa + pb * wb + pc * wc
                if not shade:
                    if w > nearest[y, x]:
                        nearest[y, x] = w
                    continue
                weight = 1.0 - (nearest[y, x] / w - 1.0) / _LAYERS
                if weight <= 0.0:
                    continue
                pa *= weight * wa / w
                pb *= weight * wb / w
                pc *= weight * wc / w
                for k in range(6):
                    sums[y, x, k] += (
                        pa * attributes[a, k] + pb * attributes[b, k] + pc * attributes[c, k])
                sums[y, x, 6] += weight


@njit(cache=True, nogil=True)
def vertex_normals(points: Floats, faces: NDArray[np.int32]) -> Floats:
    """
    Return the mean normals of each vertex's triangles, weighted by their areas.

    :param points: (n, 3) float32
    :param faces: (m, 3) int32, counter-clockwise seen from outside
    :return: (n, 3) float32 unit vectors; 0 where a vertex has no triangle
    """
    normals = np.zeros_like(points)
    for f in range(len(faces)):
        a, b, c = faces[f]
        ux, uy, uz = points[b] - points[a]
        vx, vy, vz = points[c] - points[a]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        for i in (a, b, c):
            normals[i, 0] += nx
            normals[i, 1] += ny
            normals[i, 2] += nz
    for i in range(len(points)):
        length = np.sqrt(np.sum(normals[i] ** 2))
        if length > 0:
            normals[i] /= length
    return normals
