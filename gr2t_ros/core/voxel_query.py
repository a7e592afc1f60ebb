# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the lattice is asked: the density along rays, and whether it changed there."""
from __future__ import annotations

from typing import Any, NamedTuple

from numba import int64, njit
import numpy as np
from numpy.typing import NDArray

from .blocks import Blocks, COEFFICIENTS, find, key_of, with_room
from .climb import aim, climb, CLIMBER, h3_at, INTERVAL, set_out
from .compiled import uncounted
from .vector import spline_jet

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

LANES = 8  # rays marched side by side


class Lattice(NamedTuple):
    """
    The sampled density, for the kernels.

    :param voxel: metres
    """

    blocks: Blocks
    voxel: float


class Lanes(NamedTuple):
    """
    Rays that are marched side by side, and what they write while they are; made by new_lanes.

    :param ray: (LANES,) CLIMBER
    :param number: (LANES,) which ray it is
    :param direction: (LANES, 3) voxels per metre of depth
    :param jet: (LANES, 3)
    :param origin: (3,) voxels
    :param bases: (4,) of _jet; recent: (1,)
    """

    ray: Any
    number: NDArray[np.int64]
    direction: Doubles
    jet: Doubles
    origin: Doubles
    bases: NDArray[np.int64]
    recent: NDArray[np.int64]


@njit(cache=True, nogil=True)
def new_lanes() -> Lanes:
    """Return lanes without rays."""
    return Lanes(
        np.zeros(LANES, CLIMBER), np.zeros(LANES, np.int64), np.zeros((LANES, 3)),
        np.zeros((LANES, 3)), np.zeros(3), np.zeros(4, np.int64), np.full(1, -1, np.int64))


@njit(inline='always')
def _jet(
    coefficient: Floats, neighbour: NDArray[np.int32], table_key: NDArray[np.int64],
    table_block: NDArray[np.int32], bases: NDArray[np.int64], recent: NDArray[np.int64],
    origin: Doubles, direction: Doubles, distance: float,
) -> tuple[float, float, float]:
    """
    Evaluate the spline at a point of a line; all 0 where there is no block.

    :param bases: (4,), where the blocks of the last point begin
    :param recent: (1,), the key of its first block
    :param origin: (3,) voxels; direction: (3,) voxels per unit of distance
    :return: C f, C f', C f''
    """
    x = origin[0] + distance * direction[0]
    y = origin[1] + distance * direction[1]
    z = origin[2] + distance * direction[2]
    i, j, k = int64(np.floor(x)), int64(np.floor(y)), int64(np.floor(z))
    # the first of the four taps is one before
    key = key_of((i - 1) >> 3, (j - 1) >> 3, (k - 1) >> 3)
    if key != recent[0]:
        recent[0] = key
        block = find(table_key, table_block, key)
        for n, other in enumerate((13, 16, 22, 25)):  # itself, next in y, in z, in both
            bases[n] = int64(neighbour[block, other]) * COEFFICIENTS
    # block 0 holds zeros, so what is not there needs no case of its own
    f, f1, f2 = spline_jet(
        coefficient, bases, (i - 1) & 7, (j - 1) & 7, (k - 1) & 7,
        np.float32(x - i), np.float32(y - j), np.float32(z - k),
        np.float32(direction[0]), np.float32(direction[1]), np.float32(direction[2]))
    return np.float64(f), np.float64(f1), np.float64(f2)


@njit(cache=True, nogil=True)
def _changed_since(
    state: Lattice, origin: Doubles, direction: Doubles, low: float, high: float, change: int
) -> bool:
    """Tell whether the spline on a piece of a line changed after a change."""
    blocks = state.blocks
    steps = int((high - low) / state.voxel) + 1
    last = int64(-1)
    for step in range(steps + 1):
        key = _key_along(state.voxel, origin, direction, low + (high - low) * step / steps)
        if key != last:
            last = key
            if blocks.filtered[find(blocks.table_key, blocks.table_block, key)] > change:
                return True
    return False


@njit(cache=True, nogil=True)
def _key_along(voxel: float, origin: Doubles, direction: Doubles, distance: float) -> np.int64:
    """Return the key of the block that holds the first spline tap of a point of a line."""
    per_voxel = 1.0 / voxel
    i = int64(np.floor((origin[0] + distance * direction[0]) * per_voxel))
    j = int64(np.floor((origin[1] + distance * direction[1]) * per_voxel))
    k = int64(np.floor((origin[2] + distance * direction[2]) * per_voxel))
    return key_of((i - 1) >> 3, (j - 1) >> 3, (k - 1) >> 3)


@njit(cache=True, nogil=True)
def keys_along(
    state: Lattice, origin: Doubles, directions: Doubles, lows: Doubles, highs: Doubles
) -> NDArray[np.int64]:
    """Return the keys of the blocks that pieces of lines need, with repetitions."""
    out = np.zeros(1024, np.int64)
    count = 0
    recent = np.full(4, -1, np.int64)
    for n in range(len(directions)):
        steps = int((highs[n] - lows[n]) / state.voxel) + 1
        for step in range(steps + 1):
            key = _key_along(
                state.voxel, origin, directions[n], lows[n] + (highs[n] - lows[n]) * step / steps)
            if key == recent[0] or key == recent[1] or key == recent[2] or key == recent[3]:
                continue
            recent[count % 4] = key
            out = with_room(out, count)
            out[count] = key
            count += 1
    return out[:count]


@njit(cache=True, nogil=True)
def jets(
    state: Lattice, origins: Doubles, directions: Doubles, distances: Doubles, out: Doubles
) -> None:
    """Write the jets of lines to out (n, 3); one direction and distance may serve all."""
    _jets(state, origins, directions, distances, out, new_lanes())


@uncounted()
def _jets(
    state: Lattice, origins: Doubles, directions: Doubles, distances: Doubles, out: Doubles,
    lanes: Lanes,
) -> None:
    blocks, per_voxel = state.blocks, 1.0 / state.voxel
    origin, direction = lanes.origin, lanes.direction[0]
    for n in range(len(origins)):
        m = min(n, len(directions) - 1)
        for axis in range(3):
            origin[axis] = origins[n, axis] * per_voxel
            direction[axis] = directions[m, axis] * per_voxel
        out[n, 0], out[n, 1], out[n, 2] = _jet(
            blocks.coefficient, blocks.neighbour, blocks.table_key, blocks.table_block,
            lanes.bases, lanes.recent, origin, direction, distances[m])


@njit(cache=True, nogil=True)
def march_rays(
    state: Lattice, bandwidth: tuple[float, float, float], chosen: NDArray[np.int64],
    pixels: NDArray[np.int32], table: Doubles, T_world_camera: Doubles, starts: Floats,
    depths: Floats, totals: Floats, curvatures: Floats, statuses: NDArray[np.uint8],
    counts: NDArray[np.uint8],
) -> None:
    """Climb from the starts of chosen rays; see ray_march.Rays for the arrays."""
    _march_lanes(
        state, bandwidth, chosen, pixels, table, T_world_camera, starts, depths, totals,
        curvatures, statuses, counts, new_lanes())


@uncounted(error_model='numpy')
def _march_lanes(
    state: Lattice, bandwidth: tuple[float, float, float], chosen: NDArray[np.int64],
    pixels: NDArray[np.int32], table: Doubles, T_world_camera: Doubles, starts: Floats,
    depths: Floats, totals: Floats, curvatures: Floats, statuses: NDArray[np.uint8],
    counts: NDArray[np.uint8], lanes: Lanes,
) -> None:
    """March several rays side by side: a step of one has to wait, but not for the others."""
    blocks, per_voxel = state.blocks, 1.0 / state.voxel
    origin, jet = lanes.origin, lanes.jet
    for axis in range(3):
        origin[axis] = T_world_camera[axis, 3] * per_voxel
    begun, active = 0, 0
    while True:
        while active < LANES and begun < len(chosen):
            i = chosen[begun]
            direction = lanes.direction[active]
            aim(table, T_world_camera, pixels[i], direction)
            for axis in range(3):
                direction[axis] *= per_voxel
            start = np.float64(starts[i])
            lanes.number[active] = i
            set_out(lanes.ray[active], start, h3_at(bandwidth, start))
            begun += 1
            active += 1
        if active == 0:
            return
        for n in range(active):
            jet[n, 0], jet[n, 1], jet[n, 2] = _jet(
                blocks.coefficient, blocks.neighbour, blocks.table_key, blocks.table_block,
                lanes.bases, lanes.recent, origin, lanes.direction[n], lanes.ray[n].target)
        for n in range(active - 1, -1, -1):
            ray = lanes.ray[n]
            # the mean-shift's g, as on a surface that faces its cameras
            climb(ray, jet[n, 0], jet[n, 1], jet[n, 2], jet[n, 0] / (ray.h3 * ray.h3))
            if ray.status != 0:
                i = lanes.number[n]
                depths[i] = ray.beta
                totals[i] = ray.value
                curvatures[i] = ray.second
                statuses[i] = ray.status
                counts[i] = ray.evaluations
                # the last lane, which has climbed already, takes its place
                active -= 1
                lanes.number[n] = lanes.number[active]
                lanes.ray[n] = lanes.ray[active]
                for axis in range(3):
                    lanes.direction[n, axis] = lanes.direction[active, axis]


@njit(cache=True, nogil=True)
def changed_rays(
    state: Lattice, bandwidth: tuple[float, float, float], pixels: NDArray[np.int32],
    table: Doubles, T_world_camera: Doubles, starts: Floats, marched: NDArray[np.int32],
    out: NDArray[np.bool_],
) -> None:
    """Tell of each ray whether the density in its interval changed since it was marched."""
    origin = T_world_camera[:3, 3].copy()
    direction = np.zeros(3)
    for i in range(len(pixels)):
        aim(table, T_world_camera, pixels[i], direction)
        start = np.float64(starts[i])
        reach = INTERVAL * h3_at(bandwidth, start)
        out[i] = marched[i] < 0 or _changed_since(
            state, origin, direction, start - reach, start + reach, marched[i])
