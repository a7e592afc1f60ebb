# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The fused map's samples: distances to the maxima of all keyframes, averaged by weight.

Blocks of 8 x 8 x 8 voxels as in blocks.py. Each sum over keyframes is taken anew, in their order,
when one of them has changed there, so that a sample does not depend on how it came about.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from math import exp, sqrt
from typing import Any, NamedTuple

from numba import int64, types
from numba.extending import intrinsic
import numpy as np
from numpy.typing import NDArray

from .blocks import place_of, SIDE, VOXELS
from .camera import project_jet
from .climb import h3_at
from .compiled import uncounted
from .fused_view import AGREEMENT, Bandwidth, FusedView, JUMP, REACH, TILE
from .view import View

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

BYTES_PER_BLOCK = 2 * 4 * VOXELS + 8 + 27 * 4 + 4 + 4 * 12
_NEAR = 4.0  # sigma from the surface, across it, within which a maximum counts
_MIN_COSINE = 0.05
_AGREEMENT = 0xFFFF  # of the word behind a PIXEL's depth


class Grid(NamedTuple):
    """
    The samples; the names that blocks.Blocks has too mean the same.

    :param weight: flat float32, VOXELS a block, x fastest: the sum of the weights
    :param distance: likewise: the weighted sum of the distances, metres, above 0 outside
    """

    size: int
    table_key: NDArray[np.int64]
    table_block: NDArray[np.int32]
    key: NDArray[np.int64]
    weight: Floats
    distance: Floats
    neighbour: NDArray[np.int32]
    touched: NDArray[np.int32]


def new_grid(capacity: int = 1024) -> Grid:
    """Return a grid that holds block 0 only."""
    table = 1 << (4 * capacity - 1).bit_length()
    return Grid(
        1, np.zeros(table, np.int64), np.zeros(table, np.int32), np.full(capacity, -1, np.int64),
        np.zeros(capacity * VOXELS, np.float32), np.zeros(capacity * VOXELS, np.float32),
        np.zeros((capacity, 27), np.int32), np.zeros(capacity, np.int32))


class Views(NamedTuple):
    """
    All keyframes in order, for the kernels; their images have to be kept while it is used.

    :param address: (n, 2) int64, where the images are, and their tiles
    :param size: (n, 2) int64, their height and width
    :param stride: (n,) float64
    :param T_camera_world: (n, 3, 4) float64
    :param camera: (n, 14) float64, Camera.parameters
    """

    address: NDArray[np.int64]
    size: NDArray[np.int64]
    stride: Doubles
    T_camera_world: Doubles
    camera: Doubles


def views_of(images: Mapping[View, FusedView]) -> Views:
    """Return keyframes and their images, in order, for the kernels."""
    T = []
    for view in images:
        R_camera_world = view.T_world_camera[:3, :3].T
        T.append(np.hstack([R_camera_world, -R_camera_world @ view.T_world_camera[:3, 3:]]))
    return Views(
        np.array([image.addresses for image in images.values()], np.int64).reshape(-1, 2),
        np.array([image.pixels.shape for image in images.values()], np.int64).reshape(-1, 2),
        np.array([image.stride for image in images.values()], np.float64),
        np.array(T, np.float64).reshape(-1, 3, 4),
        np.array([view.camera.parameters for view in images], np.float64).reshape(-1, 14))


@intrinsic
def _float_at(typing_context, address) -> Any:  # type: ignore[no-untyped-def]
    """Return the float32 at an address."""
    return types.float32(types.int64), _load


@intrinsic
def _word_at(typing_context, address) -> Any:  # type: ignore[no-untyped-def]
    """Return the uint32 at an address."""
    return types.uint32(types.int64), _load


def _load(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    kind = context.get_value_type(signature.return_type)
    return builder.load(builder.inttoptr(arguments[0], kind.as_pointer()))


# for type checkers: callers do not pass the first argument
float_at: Callable[..., float] = _float_at
word_at: Callable[..., int] = _word_at


@uncounted(error_model='numpy')
def sees(views: Views, view: int, sigma: Bandwidth, centre: Any, radius: float) -> bool:
    """Tell whether a view may have something to say within a ball, metres, in its frame."""
    x, y, z = centre
    near, far = z - radius, z + radius
    if far <= 0:
        return False
    height, width = views.size[view]
    rows, columns = (height + TILE - 1) // TILE, (width + TILE - 1) // TILE
    tiles = views.address[view, 1]
    v0, v1, u0, u1 = int64(0), rows - 1, int64(0), columns - 1
    seen, u, u_x, _, v, v_x, _ = project_jet(views.camera[view], x, 1.0, y, 0.0, z, 0.0)
    if seen and near > 0.25 * z:
        _, _, u_y, _, _, v_y, _ = project_jet(views.camera[view], x, 0.0, y, 1.0, z, 0.0)
        _, _, u_z, _, _, v_z, _ = project_jet(views.camera[view], x, 0.0, y, 0.0, z, 1.0)
        # the slopes grow towards the camera
        wide = 1.5 * z / near * radius
        per_tile = 1.0 / (views.stride[view] * TILE)
        reach_u = wide * sqrt(u_x * u_x + u_y * u_y + u_z * u_z) + 2 * views.stride[view]
        reach_v = wide * sqrt(v_x * v_x + v_y * v_y + v_z * v_z) + 2 * views.stride[view]
        u0 = max(u0, int64(np.floor((u - reach_u) * per_tile)))
        u1 = min(u1, int64(np.floor((u + reach_u) * per_tile)))
        v0 = max(v0, int64(np.floor((v - reach_v) * per_tile)))
        v1 = min(v1, int64(np.floor((v + reach_v) * per_tile)))
    for row in range(v0, v1 + 1):
        for column in range(u0, u1 + 1):
            tile = tiles + 8 * (row * columns + column)
            low, high = float_at(tile), float_at(tile + 4)
            reach = REACH * h3_at(sigma, high)
            if low - reach <= far and high + reach >= near and low <= high:
                return True
    return False


@uncounted(error_model='numpy')
def found_at(
    views: Views, view: int, bandwidth: Bandwidth, sigma: Bandwidth, x: float, y: float, z: float,
) -> tuple[float, float, float, float, float]:
    """
    Return what a view says of a point (metres, in its frame).

    :return: the weight, 0 if it says nothing; the distance to the view's surface, metres; the
        depth there, metres; the cosine between ray and normal; the confidence
    """
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0)
    if not z > 1e-9:
        return nothing
    height, width = views.size[view]
    stride, camera = views.stride[view], views.camera[view]
    if camera[0] == 0.0:  # without distortion
        u = (camera[1] * x / z + camera[3]) / stride
        v = (camera[2] * y / z + camera[4]) / stride
    else:
        seen, u, _, _, v, _, _ = project_jet(camera, x, 0.0, y, 0.0, z, 0.0)
        if not seen:
            return nothing
        u, v = u / stride, v / stride
    if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
        return nothing
    pixels = views.address[view, 0]
    nearest = pixels + 8 * (int64(v + 0.5) * width + int64(u + 0.5))
    if word_at(nearest + 4) & _AGREEMENT == 0:
        return nothing
    middle = np.float64(float_at(nearest))
    jump = JUMP * h3_at(bandwidth, middle)
    if abs(middle - z) > REACH * h3_at(sigma, middle + jump) + jump:
        return nothing
    u0, v0 = int64(np.floor(u)), int64(np.floor(v))
    total, depth, agreement, cosine, confidence = 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(4):
        row, column = v0 + n // 2, u0 + n % 2
        if not (0 <= row < height and 0 <= column < width):
            continue
        pixel = pixels + 8 * (row * width + column)
        there, word = float_at(pixel), word_at(pixel + 4)
        if word & _AGREEMENT == 0 or not abs(there - middle) <= jump:
            continue
        share = (1.0 - abs(u - column)) * (1.0 - abs(v - row))
        total += share
        depth += share * there
        agreement += share * (word & _AGREEMENT)
        cosine += share * (word >> 16 & 255)
        confidence += share * (word >> 24)
    if total <= 0:
        return nothing
    depth /= total
    cosine /= 255 * total
    width_here = h3_at(sigma, depth)
    along = (depth - z) * sqrt(x * x + y * y + z * z) / z
    across = along * cosine
    if cosine < _MIN_COSINE or abs(across) > _NEAR * width_here or (
            abs(along) > REACH * width_here):
        return nothing
    weight = agreement / (AGREEMENT * total) * cosine * cosine * exp(
        -0.5 * (across / width_here) ** 2)
    return weight, across, depth, cosine, confidence / (255 * total)


@uncounted(error_model='numpy')
def sum_blocks(
    grid: Grid, chosen: NDArray[np.int32], views: Views, bandwidth: Bandwidth, sigma: Bandwidth,
    voxel: float,
) -> None:
    """Sum what all views say of the voxels of some blocks."""
    radius = 0.5 * (SIDE - 1) * sqrt(3.0) * voxel
    middle = 0.5 * (SIDE - 1) * voxel
    for block in chosen:
        first = int64(block) * VOXELS
        for n in range(VOXELS):
            grid.weight[first + n] = 0
            grid.distance[first + n] = 0
        i, j, k = place_of(grid.key[block])
        x, y, z = i * SIDE * voxel, j * SIDE * voxel, k * SIDE * voxel
        for view in range(len(views.stride)):
            T = views.T_camera_world[view]
            centre = moved(T, x + middle, y + middle, z + middle)
            if sees(views, view, sigma, centre, radius):
                _add(grid, first, views, view, T, moved(T, x, y, z), bandwidth, sigma, voxel)


@uncounted()
def moved(T: Doubles, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point after a transform (3, 4)."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3])


@uncounted(error_model='numpy')
def _add(
    grid: Grid, first: int, views: Views, view: int, T: Doubles, corner: Any,
    bandwidth: Bandwidth, sigma: Bandwidth, voxel: float,
) -> None:
    """Add one view to one block, whose first voxel is at a corner (metres, in its frame)."""
    for n in range(VOXELS):
        i, j, k = (n & 7) * voxel, (n >> 3 & 7) * voxel, (n >> 6) * voxel
        weight, distance, _, _, _ = found_at(
            views, view, bandwidth, sigma,
            corner[0] + T[0, 0] * i + T[0, 1] * j + T[0, 2] * k,
            corner[1] + T[1, 0] * i + T[1, 1] * j + T[1, 2] * k,
            corner[2] + T[2, 0] * i + T[2, 1] * j + T[2, 2] * k)
        if weight > 0:
            grid.weight[first + n] += weight
            grid.distance[first + n] += weight * distance
