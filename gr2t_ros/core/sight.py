# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What would be seen from a place, past the cells of a surface."""
from __future__ import annotations

from numba import njit
import numpy as np
from numpy.typing import NDArray

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Pose = NDArray[np.float64]

_GRAZING = 0.2  # cosine; what is seen more slantwise is not measured


@njit(cache=True, nogil=True)
def nearest(points: Doubles, others: Doubles) -> Doubles:
    """Return the distances (n,) of points to the nearest of others, metres."""
    found = np.full(len(points), np.inf)
    for n in range(len(points)):
        for m in range(len(others)):
            squared = 0.0
            for axis in range(3):
                squared += (points[n, axis] - others[m, axis]) ** 2
            found[n] = min(found[n], np.sqrt(squared))
    return found


@njit(cache=True, nogil=True)
def look(
    T_world_camera: Pose, slopes: Doubles, surface: Doubles, side: float, points: Doubles,
    normals: Doubles, depth_min: float, depth_max: float, depths: Doubles, gain: Floats,
) -> None:
    """
    Write what a view sees of each target: its cosine, 0 where it is not seen.

    :param slopes: (2,) half the width and height of the image at a depth of 1
    :param surface: (k, 3) float64, middles of cells that may be in the way
    :param side: of these, metres
    :param depths: (h, w) float64, infinite: room for the depths of these
    """
    height, width = depths.shape
    fx, fy = 0.5 * width / slopes[0], 0.5 * height / slopes[1]
    for k in range(len(surface)):
        x, y, z = 0.0, 0.0, 0.0
        for axis in range(3):
            way = surface[k, axis] - T_world_camera[axis, 3]
            x += way * T_world_camera[axis, 0]
            y += way * T_world_camera[axis, 1]
            z += way * T_world_camera[axis, 2]
        if z < side:
            continue
        u, v = fx * x / z + 0.5 * width, fy * y / z + 0.5 * height
        ru, rv = 0.5 * fx * side / z, 0.5 * fy * side / z
        for j in range(max(int(np.floor(v - rv)), 0), min(int(np.floor(v + rv)) + 1, height)):
            for i in range(max(int(np.floor(u - ru)), 0), min(int(np.floor(u + ru)) + 1, width)):
                depths[j, i] = min(depths[j, i], z)
    for n in range(len(points)):
        x, y, z, towards, squared = 0.0, 0.0, 0.0, 0.0, 0.0
        for axis in range(3):
            way = points[n, axis] - T_world_camera[axis, 3]
            x += way * T_world_camera[axis, 0]
            y += way * T_world_camera[axis, 1]
            z += way * T_world_camera[axis, 2]
            towards -= way * normals[n, axis]
            squared += way * way
        if not depth_min <= z <= depth_max or towards <= _GRAZING * np.sqrt(squared):
            continue
        u, v = fx * x / z + 0.5 * width, fy * y / z + 0.5 * height
        if 0 <= u < width and 0 <= v < height and z <= depths[int(v), int(u)] + 2 * side:
            gain[n] = towards / np.sqrt(squared)
