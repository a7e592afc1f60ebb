# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The fused map's samples: distances to the maxima of all keyframes, averaged by weight.

Blocks of 8 x 8 x 8 voxels as in blocks.py. The sums are of whole numbers: what a keyframe added
can be subtracted again when it changes, and no sum depends on how it came about.
"""
from __future__ import annotations

from collections.abc import Callable, Mapping
from math import exp, sqrt
from typing import Any, NamedTuple

from numba import int64, njit, types
from numba.extending import intrinsic
import numpy as np
from numpy.typing import NDArray

from .blocks import find, place_of, SIDE, VOXELS, with_keys
from .camera import project_jet
from .climb import h3_at
from .compiled import uncounted
from .fused_view import Bandwidth, CERTAIN, FusedView, JUMP, REACH, TILE
from .view import View

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

BYTES_PER_BLOCK = 2 * 4 * VOXELS + 8 + 27 * 4 + 4 + 4 * 12
_NEAR = 3.0
_MIN_COSINE = 0.05
# a view's weight is 1 at most, its distance some voxels: thousands of views fit into 31 bits
WEIGHT, DISTANCE = 1 << 17, 1 << 14
PIXEL_WEIGHT = 0xFFFF  # of the word behind a PIXEL's depth


class Grid(NamedTuple):
    """
    The samples; the names that blocks.Blocks has too mean the same.

    :param weight: flat int32, VOXELS a block, x fastest: the sum of the weights, in 1 / WEIGHT
    :param distance: likewise: the weighted sum of the distances, in voxels / DISTANCE, above 0
        outside
    """

    size: int
    table_key: NDArray[np.int64]
    table_block: NDArray[np.int32]
    key: NDArray[np.int64]
    weight: NDArray[np.int32]
    distance: NDArray[np.int32]
    neighbour: NDArray[np.int32]
    touched: NDArray[np.int32]


def new_grid(capacity: int = 1024) -> Grid:
    """Return a grid that holds block 0 only."""
    table = 1 << (4 * capacity - 1).bit_length()
    return Grid(
        1, np.zeros(table, np.int64), np.zeros(table, np.int32), np.full(capacity, -1, np.int64),
        np.zeros(capacity * VOXELS, np.int32), np.zeros(capacity * VOXELS, np.int32),
        np.zeros((capacity, 27), np.int32), np.zeros(capacity, np.int32))


def without_empty(grid: Grid) -> Grid:
    """Return the grid without the blocks in which no view has something to say."""
    weight = grid.weight.reshape(-1, VOXELS)[:grid.size]
    kept = np.flatnonzero(weight.any(axis=1))
    smaller, _ = with_keys(
        new_grid(max(len(kept) + 1, 1024)), grid.key[kept], 1, new=new_grid)
    smaller.weight.reshape(-1, VOXELS)[1:smaller.size] = weight[kept]
    smaller.distance.reshape(-1, VOXELS)[1:smaller.size] = (
        grid.distance.reshape(-1, VOXELS)[kept])
    smaller.touched[:] = 0
    return smaller


class Views(NamedTuple):
    """
    All keyframes in order, for the kernels; their images have to be kept while it is used.

    :param address: (n, 2) int64, where the images are, and their tiles
    :param size: (n, 2) int64, their height and width
    :param depth: (n, 2) float64, the depths between which they have something to say, metres
    :param stride: (n,) float64
    :param T_camera_world: (n, 3, 4) float64
    :param camera: (n, 14) float64, Camera.parameters
    :param pinhole: (n, 4) float64, its focal lengths and principal point, pixels of the images
    """

    address: NDArray[np.int64]
    size: NDArray[np.int64]
    depth: Doubles
    stride: Doubles
    T_camera_world: Doubles
    camera: Doubles
    pinhole: Doubles


def views_of(images: Mapping[View, FusedView]) -> Views:
    """Return keyframes and their images, in order, for the kernels."""
    T = []
    for view in images:
        R_camera_world = view.T_world_camera[:3, :3].T
        T.append(np.hstack([R_camera_world, -R_camera_world @ view.T_world_camera[:3, 3:]]))
    return Views(
        np.array([image.addresses for image in images.values()], np.int64).reshape(-1, 2),
        np.array([image.pixels.shape for image in images.values()], np.int64).reshape(-1, 2),
        np.array([image.depth for image in images.values()], np.float64).reshape(-1, 2),
        np.array([image.stride for image in images.values()], np.float64),
        np.array(T, np.float64).reshape(-1, 3, 4),
        np.array([view.camera.parameters for view in images], np.float64).reshape(-1, 14),
        np.array([view.camera.parameters[1:5] / image.stride for view, image in images.items()],
                 np.float64).reshape(-1, 4))


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


@uncounted()
def moved(T: Doubles, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point after a transform (3, 4)."""
    return (
        T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3],
        T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3],
        T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3])


@uncounted(error_model='numpy')
def projected(
    views: Views, view: int, x: float, y: float, z: float
) -> tuple[bool, float, float]:
    """Return whether a point (metres, in a view's frame) is before it, and where in its image."""
    if views.camera[view, 0] == 0.0:  # without distortion
        pinhole = views.pinhole[view]
        inverse = 1.0 / z
        return z > 1e-9, pinhole[0] * x * inverse + pinhole[2], pinhole[1] * y * inverse + (
            pinhole[3])
    seen, u, _, _, v, _, _ = project_jet(views.camera[view], x, 0.0, y, 0.0, z, 0.0)
    return seen, u / views.stride[view], v / views.stride[view]


@uncounted(error_model='numpy')
def said(
    pixels: int, height: int, width: int, bandwidth: Bandwidth, sigma: Bandwidth,
    u: float, v: float, x: float, y: float, z: float,
) -> tuple[float, float, float, float, float]:
    """
    Return what a view says of a point (metres, in its frame) that is at (u, v) in its image.

    :param pixels: the image's address
    :return: the weight, 0 if it says nothing; the distance to the view's surface, metres; h3
        there, metres; the cosine between ray and normal; the confidence
    """
    nothing = (0.0, 0.0, 0.0, 0.0, 0.0)
    if not (-0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
        return nothing
    nearest = pixels + 8 * (int(v + 0.5) * width + int(u + 0.5))
    middle = np.float64(float_at(nearest))
    h3 = h3_at(bandwidth, middle)
    width_here = max(h3, sigma[2])
    if abs(middle - z) > REACH * width_here or word_at(nearest + 4) & PIXEL_WEIGHT == 0:
        return nothing
    jump = JUMP * h3
    u0, v0 = int(u + 1.0) - 1, int(v + 1.0) - 1
    right, below = u - u0, v - v0
    total, depth, certainty, cosine, confidence = 0.0, 0.0, 0.0, 0.0, 0.0
    for n in range(4):
        row, column = v0 + (n >> 1), u0 + (n & 1)
        share = (right if n & 1 else 1.0 - right) * (below if n >> 1 else 1.0 - below)
        if not (0 <= row < height and 0 <= column < width):
            continue
        pixel = pixels + 8 * (row * width + column)
        there, word = float_at(pixel), word_at(pixel + 4)
        # those that lie on another surface do not count
        if word & PIXEL_WEIGHT == 0 or not abs(there - middle) <= jump:
            continue
        total += share
        depth += share * there
        certainty += share * (word & PIXEL_WEIGHT)
        cosine += share * (word >> 16 & 255)
        confidence += share * (word >> 24)
    inverse = 1.0 / total
    cosine *= inverse / 255
    across = (depth * inverse - z) * sqrt(1.0 + (x * x + y * y) / (z * z)) * cosine
    if not (cosine >= _MIN_COSINE and abs(across) <= _NEAR * width_here):
        return nothing
    part = across / width_here
    weight = certainty * inverse / CERTAIN * cosine * cosine * exp(-0.5 * part * part)
    return weight, across, h3, cosine, confidence * inverse / 255


@uncounted()
def _corner_of(part: int) -> int:
    """Return the first corner, of 3 x 3 x 3, of an eighth of a cube."""
    return (part & 1) + 3 * (part >> 1 & 1) + 9 * (part >> 2)


@uncounted(error_model='numpy')
def sees(
    views: Views, view: int, sigma: Bandwidth, corners: Doubles, first: int, step: int,
    through: bool,
) -> bool:
    """
    Tell whether a view may have something to say in a box.

    :param corners: (27, 4), whether they are before it, u, v, z (metres); a lattice of 3 x 3 x 3
    :param first: corner of the box; step: to the next in x; 3 and 9 of it in y and z
    :param through: whether it counts, too, that it sees through the box
    """
    u0, u1, v0, v1, near, far = np.inf, -np.inf, np.inf, -np.inf, np.inf, -np.inf
    before, behind = 0, 0
    for n in range(8):
        corner = corners[first + step * _corner_of(n)]
        near, far = min(near, corner[3]), max(far, corner[3])
        if corner[0] == 0:
            behind += 1
            continue
        before += 1
        u0, u1 = min(u0, corner[1]), max(u1, corner[1])
        v0, v1 = min(v0, corner[2]), max(v1, corner[2])
    if far <= 0:
        return False
    if through:
        far = np.inf
    if near > views.depth[view, 1] or far < views.depth[view, 0]:
        return False
    height, width = views.size[view, 0], views.size[view, 1]
    rows, columns = (height + TILE - 1) // TILE, (width + TILE - 1) // TILE
    if behind > 0:
        u0, u1, v0, v1 = 0.0, 1.0 * width, 0.0, 1.0 * height
    # straight lines stay straight but for distortion
    margin = 1.0 if views.camera[view, 0] == 0.0 else 2.0 + 0.1 * (u1 - u0 + v1 - v0)
    first_row = int(max((v0 - margin) / TILE, 0.0))
    first_column = int(max((u0 - margin) / TILE, 0.0))
    last_row = min(int(min((v1 + margin) / TILE, 1e6) + 1.0) - 1, rows - 1)
    last_column = min(int(min((u1 + margin) / TILE, 1e6) + 1.0) - 1, columns - 1)
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            tile = views.address[view, 1] + 8 * (row * columns + column)
            low, high = float_at(tile), float_at(tile + 4)
            reach = REACH * h3_at(sigma, high)
            if low - reach <= far and high + reach >= near and low <= high:
                return True
    return False


@uncounted(error_model='numpy')
def find_corners(
    views: Views, view: int, x: float, y: float, z: float, side: float, corners: Doubles
) -> None:
    """Write what sees() needs of a cube from (x, y, z) on, metres, in the world."""
    T = views.T_camera_world[view]
    for n in range(27):
        at = moved(
            T, x + 0.5 * side * (n % 3), y + 0.5 * side * (n // 3 % 3), z + 0.5 * side * (n // 9))
        corner = corners[n]
        before, corner[1], corner[2] = projected(views, view, at[0], at[1], at[2])
        corner[0], corner[3] = before, at[2]


@njit(cache=True, nogil=True)
def add_view(
    grid: Grid, chosen: NDArray[np.int32], views: Views, bandwidth: Bandwidth, sigma: Bandwidth,
    voxel: float, view: int, sign: int,
) -> None:
    """Add what a view says of the voxels of some blocks, or subtract it (sign -1)."""
    _add_view(grid, chosen, views, bandwidth, sigma, voxel, view, sign, np.zeros((27, 4)))


@uncounted(error_model='numpy')
def _add_view(
    grid: Grid, chosen: NDArray[np.int32], views: Views, bandwidth: Bandwidth, sigma: Bandwidth,
    voxel: float, view: int, sign: int, corners: Doubles,
) -> None:
    for block in chosen:
        i, j, k = place_of(grid.key[block])
        x, y, z = i * SIDE * voxel, j * SIDE * voxel, k * SIDE * voxel
        find_corners(views, view, x, y, z, SIDE * voxel, corners)
        for part in range(8):
            if sees(views, view, sigma, corners, _corner_of(part), 1, False):
                _add(
                    grid, int64(block) * VOXELS, part, views, view, x, y, z, bandwidth, sigma,
                    voxel, sign)


@uncounted(error_model='numpy')
def _add(
    grid: Grid, first: int, part: int, views: Views, view: int, x: float, y: float, z: float,
    bandwidth: Bandwidth, sigma: Bandwidth, voxel: float, sign: int,
) -> None:
    """Add a view to one of the 8 parts of a block, whose first voxel is at (x, y, z), metres."""
    T = views.T_camera_world[view]
    pixels, height, width = views.address[view, 0], views.size[view, 0], views.size[view, 1]
    per_voxel = DISTANCE / voxel
    distorted = views.camera[view, 0] != 0.0
    fx, fy, cx, cy = (
        views.pinhole[view, 0], views.pinhole[view, 1], views.pinhole[view, 2],
        views.pinhole[view, 3])
    i0, j0, k0 = 4 * (part & 1), 4 * (part >> 1 & 1), 4 * (part >> 2)
    step_x, step_y, step_z = T[0, 0] * voxel, T[1, 0] * voxel, T[2, 0] * voxel
    for line in range(16):
        j, k = j0 + (line & 3), k0 + (line >> 2)
        row = moved(T, x + i0 * voxel, y + j * voxel, z + k * voxel)
        to = first + (k * SIDE + j) * SIDE + i0
        for i in range(4):
            at_x, at_y, at_z = row[0] + i * step_x, row[1] + i * step_y, row[2] + i * step_z
            if distorted:
                before, u, v = projected(views, view, at_x, at_y, at_z)
            else:
                before, inverse = at_z > 1e-9, 1.0 / at_z
                u, v = fx * at_x * inverse + cx, fy * at_y * inverse + cy
            if not before:
                continue
            weight, distance, _, _, _ = said(
                pixels, height, width, bandwidth, sigma, u, v, at_x, at_y, at_z)
            if weight > 0:
                grid.weight[to + i] += sign * int(weight * WEIGHT + 0.5)
                grid.distance[to + i] += sign * int(np.floor(
                    weight * distance * per_voxel + 0.5))


@njit(cache=True, nogil=True)
def reached(
    grid: Grid, keys: NDArray[np.int64], views: Views, bandwidth: Bandwidth, sigma: Bandwidth,
    voxel: float, view: int,
) -> NDArray[np.int64]:
    """Return the keys of the blocks that are there, or in which a view has something to say."""
    kept = np.zeros(len(keys), np.bool_)
    corners = np.zeros((27, 4))
    for n in range(len(keys)):
        kept[n] = find(grid.table_key, grid.table_block, keys[n]) != 0
        if not kept[n]:
            i, j, k = place_of(keys[n])
            find_corners(
                views, view, i * SIDE * voxel, j * SIDE * voxel, k * SIDE * voxel, SIDE * voxel,
                corners)
            for part in range(8):
                kept[n] = kept[n] or sees(
                    views, view, sigma, corners, _corner_of(part), 1, False)
    return keys[kept]
