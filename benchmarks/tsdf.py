# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Open3D's TSDF of the same frames, where it is installed.

Where its options leave a choice, the faster one is taken: voxels up to 4 from the surface (the
default is 8), a ray cast that returns depths only, and surfaces that one frame saw (default: 3).
"""
from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gr2t_ros.core.view import View

INSTALLED = find_spec('open3d') is not None
_TRUNCATION = 4.0  # voxels
_SEEN = 0.5  # weight; below that of one frame
_BLOCKS = 40000  # at the start; it grows


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

    def vertices(self, weight: float = _SEEN) -> NDArray[np.float64]:
        """
        Return the vertices (n, 3) of the whole mesh.

        :param weight: of the voxels that count; about how many frames saw them
        """
        mesh = self._grid.extract_triangle_mesh(weight)
        positions: NDArray[np.float32] = mesh.vertex.positions.numpy()
        return positions.astype(np.float64)
