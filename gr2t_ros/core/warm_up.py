# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""All kernels of core, compiled before they are needed."""
from __future__ import annotations

from time import perf_counter

import numpy as np

from ..settings import Settings
from .block_removal import without
from .blocks import linked, new_blocks, with_keys
from .camera import Camera
from .next_views import where_next
from .reconstruction import Reconstruction
from .shading import triangle_corners
from .view import View


def warm_up(settings: Settings) -> float:
    """
    Compile the kernels, or load them from the cache, so that the first frame need not wait.

    :return: seconds it took
    """
    began = perf_counter()
    camera = Camera(24, 16, 20.0, 20.0, 12.0, 8.0)
    depth = np.full((16, 24), 1.0, np.float32)
    tiny = Reconstruction(settings.updated({
        'keyframe_translation': 0.0, 'ray_stride': 1, 'depth_bandwidth': 0.01,
        'voxel_size': 0.01, 'depth_min': 0.1, 'depth_max': 2.0}))
    for stamp in range(2):
        tiny.add(View(depth, camera, np.eye(4), stamp))
    tiny.finish()
    for _, mesh in tiny.meshes():
        triangle_corners(
            mesh.vertices, mesh.faces, np.zeros(mesh.vertices.shape, np.uint8), shading=True)
    where_next(tiny, tiny.fused_mesh())
    tiny.close()
    blocks, _ = with_keys(new_blocks(1), np.arange(2), 1)  # it grows: the tiny map did not
    without(blocks, np.zeros(blocks.size, np.bool_), 1)
    linked(new_blocks(1), 1)
    return perf_counter() - began
