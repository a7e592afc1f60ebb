# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Open3D's TSDF of the same frames, where it is installed.

Where its options leave a choice, the faster one is taken: voxels up to 4 from the surface (the
default is 8), a ray cast that returns depths only, and surfaces that one frame saw (default: 3).
"""
from __future__ import annotations

from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gr2t_ros.core.view import View


@cache
def installed() -> bool:
    """Tell whether Open3D can be used; where it is installed but cannot be, print why."""
    if find_spec('open3d') is None:
        return False
    try:
        import_module('open3d')
    except ImportError as error:
        print(f'Open3D is installed, but cannot be imported: {error}')
        return False
    return True


_TRUNCATION = 4.0  # voxels
_SEEN = 0.5  # weight; below that of one frame
_BLOCKS = 40000  # at the start; it grows


class Mesh(NamedTuple):
    """
    A triangle mesh.

    :param vertices: (n, 3) world, metres
    :param faces: (m, 3) int
    :param weight: (n,) of the vertices: about how many frames saw them
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int32]
    weight: NDArray[np.float64]


class Frame:
    """A view as Open3D wants it."""

    def __init__(self, view: View) -> None:
        open3d: Any = import_module('open3d')
        core = open3d.core
        camera = view.camera
        self.size = (camera.width, camera.height)
        self.depth = open3d.t.geometry.Image(core.Tensor(
            np.nan_to_num(view.depth)[..., None]))
        self.K = core.Tensor(np.array(
            [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1.0]]))
        self.T_camera_world = core.Tensor(np.linalg.inv(view.T_world_camera))


class Tsdf:
    """
    An empty TSDF.

    :param voxel_size: metres
    :param depth_max: metres
    """

    def __init__(self, voxel_size: float, depth_max: float) -> None:
        open3d: Any = import_module('open3d')
        open3d.utility.set_verbosity_level(open3d.utility.VerbosityLevel.Error)
        one = open3d.core.float32
        self._depth_max = depth_max
        self._voxel_size = voxel_size
        self._grid = open3d.t.geometry.VoxelBlockGrid(
            ('tsdf', 'weight'), (one, one), ((1), (1)), voxel_size, 8, _BLOCKS)
        self._blocks: Any = None

    def integrate(self, frame: Frame) -> None:
        """Add a frame, its blocks allocated."""
        about = (frame.depth, frame.K, frame.T_camera_world, 1.0, self._depth_max, _TRUNCATION)
        self._blocks = self._grid.compute_unique_block_coordinates(*about)
        self._grid.integrate(self._blocks, *about)

    def ray_cast(self, frame: Frame) -> NDArray[np.float32]:
        """Return the depths (metres) of the surface in the frame integrated last."""
        result = self._grid.ray_cast(
            self._blocks, frame.K, frame.T_camera_world, *frame.size, ['depth'], 1.0, 0.1,
            self._depth_max, _SEEN, _TRUNCATION)
        depth: NDArray[np.float32] = result['depth'].numpy()
        return depth

    def mesh(self, weight: float = _SEEN) -> Mesh:
        """
        Return the whole mesh.

        :param weight: of the voxels that count; about how many frames saw them
        """
        mesh = self._grid.extract_triangle_mesh(weight)
        vertices = mesh.vertex.positions.numpy().astype(np.float64)
        return Mesh(vertices, mesh.triangle.indices.numpy(), self._weights(vertices))

    def _weights(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the weights at vertices, each between two voxels of the grid: their lesser."""
        places, flat = self._grid.voxel_coordinates_and_flattened_indices()
        weight = self._grid.attribute('weight').numpy().reshape(-1)[flat.numpy()]
        cells = np.rint(places.numpy() / self._voxel_size).astype(np.int64)
        low, size = cells.min(axis=0), np.ptp(cells, axis=0) + 1
        order = np.argsort(_numbers(cells, low, size))
        keys, weight = _numbers(cells, low, size)[order], weight[order]
        # a vertex lies on a line of the grid, but for rounding
        at = vertices / self._voxel_size
        lesser = np.full(len(vertices), np.inf)
        for ends in (np.floor(at + 1e-3), np.ceil(at - 1e-3)):
            number = _numbers(ends.astype(np.int64), low, size)
            nearest = np.minimum(np.searchsorted(keys, number), len(keys) - 1)
            lesser = np.minimum(lesser, np.where(keys[nearest] == number, weight[nearest], 0))
        return lesser


def _numbers(
    cells: NDArray[np.int64], low: NDArray[np.int64], size: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Return one number for each cell of a box."""
    x, y, z = (cells - low).T
    return (x * size[1] + y) * size[2] + z
