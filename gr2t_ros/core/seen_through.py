# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Free space: what keyframes see through is no surface, whatever others say."""
from __future__ import annotations

from numba import njit
import numpy as np
from numpy.typing import NDArray

from .blocks import place_of, SIDE
from .climb import h3_at
from .compiled import uncounted
from .fused_grid import find_corners, float_at, Grid, PIXEL_WEIGHT, sees, Views, word_at
from .fused_view import Bandwidth, REACH


@uncounted(error_model='numpy')
def sees_through(
    views: Views, view: int, bandwidth: Bandwidth, sigma: Bandwidth, u: float, v: float, z: float
) -> bool:
    """
    Tell whether a view sees through a point that is at (u, v) in its image, z metres before it.

    All maxima about it have to be farther behind it than they reach: where one is missing, or on
    the nearer side of a jump, the view does not tell.
    """
    height, width = views.size[view, 0], views.size[view, 1]
    if not (0.5 <= u < width - 1.5 and 0.5 <= v < height - 1.5):
        return False
    first = views.address[view, 0] + 8 * (int(v - 0.5) * width + int(u - 0.5))
    least = np.inf
    for n in range(9):
        pixel = first + 8 * (n // 3 * width + n % 3)
        if word_at(pixel + 4) & PIXEL_WEIGHT == 0:
            return False
        least = min(least, float_at(pixel))
    beyond: bool = least - z > REACH * max(h3_at(bandwidth, least), sigma[2])
    return beyond


@njit(cache=True, nogil=True)
def blocks_seen_through(
    grid: Grid, blocks: NDArray[np.int32], views: Views, sigma: Bandwidth, voxel: float
) -> NDArray[np.bool_]:
    """Tell which blocks the only view of `views` may see through, or have something to say in."""
    out = np.zeros(len(blocks), np.bool_)
    corners = np.zeros((27, 4))
    side = SIDE * voxel
    for n in range(len(blocks)):
        x, y, z = place_of(grid.key[blocks[n]])
        find_corners(views, 0, x * side, y * side, z * side, side, corners)
        out[n] = sees(views, 0, sigma, corners, 0, 2, True)
    return out
