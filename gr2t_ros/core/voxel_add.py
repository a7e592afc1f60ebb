# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A view's term on the lattice: which blocks it needs, and what it adds to their voxels."""
from __future__ import annotations

from math import sqrt
from typing import NamedTuple

from numba import int64, njit, uint64
import numpy as np
from numpy.typing import NDArray

from .blocks import Blocks, key_of, place_of, SIDE, VOXELS, with_room
from .camera import project_jet
from .climb import SEEN
from .compiled import uncounted
from .vector import LANES, window_strip
from .warped import BINS, CELL, CELL_BITS, Scale, Support, Warped, Weights

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

_FAST = {'contract', 'nsz', 'arcp'}


class Place(NamedTuple):
    """One view's geometry, for the kernels."""

    R_camera_world: Doubles
    t_camera_world: Doubles
    camera: Doubles
    width: int
    height: int
    factor: float


@njit(cache=True, nogil=True)
def _ray(rays: Doubles, u: int, v: int) -> tuple[float, float]:
    """Return a pixel's ray, going on in a straight line outside the image; NaN where unknown."""
    height, width = rays.shape[:2]
    u_in, v_in = min(max(u, 0), width - 1), min(max(v, 0), height - 1)
    a, b = rays[v_in, u_in, 0], rays[v_in, u_in, 1]
    if u != u_in and width > 1:
        inner = 1 if u < 0 else width - 2
        a += abs(u - u_in) * (a - rays[v_in, inner, 0])
    if v != v_in and height > 1:
        inner = 1 if v < 0 else height - 2
        b += abs(v - v_in) * (b - rays[inner, u_in, 1])
    return a, b


@njit(cache=True, nogil=True, error_model='numpy')
def keys_of_view(
    support: Support, rays: Doubles, R_world_camera: Doubles, t_world_camera: Doubles,
    depth_of_bins: Doubles, block_size: float, rim: int, first: int, end: int,
) -> NDArray[np.int64]:
    """
    Return the keys of the blocks that some rows of cells have support in, with repetitions.

    A ray in the middle of each cell, of every second where they are narrow against a block, is
    followed through the runs of its mask, in steps that miss no block by more than a corner. More
    rays are where a cell, or a pixel, is wide against a block, where some pixels have no ray, and
    at the border, where kernels reach rim pixels out of the image.
    """
    out = np.zeros(4096, np.int64)
    count = 0
    last, before = int64(-1), int64(-1)
    columns = support.columns
    rows = (len(support.mask) - 1) // columns
    R, per_block = R_world_camera, 1.0 / block_size
    x0, y0, z0 = (
        t_world_camera[0] * per_block, t_world_camera[1] * per_block,
        t_world_camera[2] * per_block)
    for j in range(first, end):
        for i in range(columns):
            cell = j * columns + i
            mask = support.mask[cell]
            if mask == 0:
                continue
            u0, v0, u1, v1 = CELL * i, CELL * j, CELL * (i + 1), CELL * (j + 1)
            a, b = _ray(rays, u0, v0)
            c, d = _ray(rays, u1, v1)
            spread = abs(c - a) + abs(d - b)
            inside = 0 < i < columns - 1 and 0 < j < rows - 1 and np.isfinite(
                spread + _ray(rays, u0, v1)[0] + _ray(rays, u1, v0)[0])
            base, shift = support.base[cell], support.shift[cell]
            bit = 0
            while bit < 64 and (mask >> uint64(bit)) != 0:
                while (mask >> uint64(bit)) & uint64(1) == 0:
                    bit += 1
                start = bit
                while bit < 64 and (mask >> uint64(bit)) & uint64(1) == 1:
                    bit += 1
                top = len(depth_of_bins) - 1
                near = depth_of_bins[min(max(base + (start << shift), 0), top)]
                far = depth_of_bins[min(max(base + (bit << shift), 0), top)]
                steps = int(2.5 * (far - near) * per_block) + 1
                pace = (far - near) / steps
                stride, lines, pixel_a, pixel_b = 1, 1, 0.0, 0.0
                if inside and 2 * spread * far <= block_size:
                    # an even cell's mask speaks for what surrounds it, too
                    if (i | j) & 1:
                        continue
                    stride = 2 * CELL
                elif spread * far <= block_size:
                    stride = CELL if inside else 2
                elif inside and spread * far > CELL * block_size:
                    # pixels wider than blocks: several lines each
                    lines = int(spread * far / (CELL * block_size)) + 1
                    pixel_a, pixel_b = (c - a) / CELL, (d - b) / CELL
                beside = max(stride // 2 + 1, CELL)
                for v in range(v0 + stride // 2 - rim * (j == 0),
                               v0 + beside + rim * (j == rows - 1), stride):
                    for u in range(u0 + stride // 2 - rim * (i == 0),
                                   u0 + beside + rim * (i == columns - 1), stride):
                        middle_a, middle_b = _ray(rays, u, v)
                        if not abs(middle_a + middle_b) < np.inf:
                            continue
                        for line in range(lines * lines):
                            row, column = divmod(line, lines) if lines > 1 else (0, 0)
                            p = middle_a + ((column + 0.5) / lines - 0.5) * pixel_a
                            q = middle_b + ((row + 0.5) / lines - 0.5) * pixel_b
                            x = (R[0, 0] * p + R[0, 1] * q + R[0, 2]) * per_block
                            y = (R[1, 0] * p + R[1, 1] * q + R[1, 2]) * per_block
                            z = (R[2, 0] * p + R[2, 1] * q + R[2, 2]) * per_block
                            for step in range(steps + 1):
                                depth = near + step * pace
                                key = key_of(
                                    int(np.floor(x0 + depth * x)), int(np.floor(y0 + depth * y)),
                                    int(np.floor(z0 + depth * z)))
                                if key in (last, before):
                                    continue
                                before, last = last, key
                                if count == len(out):
                                    out = with_room(out, count)
                                out[count] = key
                                count += 1
    return out[:count]


class Scratch(NamedTuple):
    """
    What one thread knows of the voxels of the block at hand, 512 each.

    :param u: pixels, counted from `rim` before the image; likewise v
    :param z: depth, metres
    :param t: depth in units of its bandwidth, as in Warped.image
    :param cell: of the support
    :param sample: of Scale.table before the depth; fraction: of the way to the next
    :param chosen: the voxels that the view's support holds, and room for one more
    """

    u: Floats
    v: Floats
    z: Floats
    t: Floats
    cell: NDArray[np.int32]
    sample: NDArray[np.int32]
    fraction: Floats
    chosen: NDArray[np.int32]


@njit(cache=True, nogil=True)
def add_to_blocks(
    blocks: Blocks, voxel: float, chosen: NDArray[np.int32], place: Place, image: Warped,
    support: Support, scale: Scale, weights: Weights,
) -> None:
    """Add a view's term to the voxels of some blocks that its support holds."""
    scratch = Scratch(
        np.zeros(VOXELS, np.float32), np.zeros(VOXELS, np.float32), np.zeros(VOXELS, np.float32),
        np.zeros(VOXELS, np.float32), np.zeros(VOXELS, np.int32), np.zeros(VOXELS, np.int32),
        np.zeros(VOXELS, np.float32), np.zeros(VOXELS + 1, np.int32))
    rim = weights.lanes // 2  # pixels that kernels reach out of the image
    for block in chosen:
        _project(blocks.key[block], voxel, place, rim, scratch)
        _locate(place, support, scale, rim, scratch)
        count = _choose(support, scale, scratch)
        _add_windows(
            int64(block) * VOXELS, count, blocks.value, blocks.expected, place.factor, image,
            scale, weights, scratch)


@uncounted(fastmath=_FAST, error_model='numpy')
def _project(key: np.int64, voxel: float, place: Place, rim: int, scratch: Scratch) -> None:
    """Project a block's voxels into the view; u is negative where that cannot be done."""
    R, t, camera = place.R_camera_world, place.t_camera_world, place.camera
    all_u, all_v, all_z = scratch.u, scratch.v, scratch.z
    fx, fy = np.float32(camera[1]), np.float32(camera[2])
    cx, cy = np.float32(camera[3] + rim), np.float32(camera[4] + rim)
    # offsets within a block are small: float32 holds them
    step_x = np.float32(R[0, 0] * voxel)
    step_y = np.float32(R[1, 0] * voxel)
    step_z = np.float32(R[2, 0] * voxel)
    bx, by, bz = place_of(key)
    for line in range(SIDE * SIDE):
        px = bx * SIDE * voxel
        py = (by * SIDE + line % SIDE) * voxel
        pz = (bz * SIDE + line // SIDE) * voxel
        x0 = np.float32(R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0])
        y0 = np.float32(R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1])
        z0 = np.float32(R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2])
        for i in range(SIDE):
            n = uint64(line * SIDE + i)
            along = np.float32(i)
            z = z0 + along * step_z
            closeness = np.float32(1) / z
            all_z[n] = z
            all_u[n] = fx * (x0 + along * step_x) * closeness + cx
            all_v[n] = fy * (y0 + along * step_y) * closeness + cy
        if camera[0] != 0:  # no pinhole
            for i in range(SIDE):
                n = uint64(line * SIDE + i)
                along = np.float32(i)
                seen, u, _, _, v, _, _ = project_jet(
                    camera, float(x0 + along * step_x), 0.0, float(y0 + along * step_y), 0.0,
                    float(all_z[n]), 0.0)
                all_u[n] = np.float32(u + rim) if seen else np.float32(-1)
                all_v[n] = np.float32(v + rim) if seen else np.float32(-1)


@uncounted(fastmath=_FAST, error_model='numpy')
def _locate(place: Place, support: Support, scale: Scale, rim: int, scratch: Scratch) -> None:
    """Find each voxel's cell, the last one for what the view does not see, and depth sample."""
    per_metre, deepest = np.float32(scale.per_metre), np.float32(len(scale.table) - 2)
    columns, last = np.int32(support.columns), np.int32(len(support.mask) - 1)
    last_column, last_row = np.int32(columns - 1), np.int32(last // columns - 1)
    zero, inner = np.float32(0), np.int32(rim)
    right, bottom = np.float32(place.width + 2 * rim - 1), np.float32(place.height + 2 * rim - 1)
    all_u, all_v, all_z = scratch.u, scratch.v, scratch.z
    all_cell, all_sample, all_fraction = scratch.cell, scratch.sample, scratch.fraction
    for i in range(VOXELS):
        n = uint64(i)
        u, v, depth_at = all_u[n], all_v[n], all_z[n] * per_metre
        inside = (
            (depth_at > zero) & (depth_at < deepest) & (u >= zero) & (u < right) & (v >= zero)
            & (v < bottom))
        # numbers that are out of range must not be rounded
        u, v, depth_at = u if inside else zero, v if inside else zero, depth_at if inside else zero
        column = np.int32(np.int32(np.int32(u) - inner) >> CELL_BITS)
        row = np.int32(np.int32(np.int32(v) - inner) >> CELL_BITS)
        column = min(max(column, np.int32(0)), last_column)
        row = min(max(row, np.int32(0)), last_row)
        all_cell[n] = np.int32(row * columns + column) if inside else last
        sample = np.int32(depth_at)
        all_sample[n] = sample
        all_fraction[n] = depth_at - np.float32(sample)


@uncounted(fastmath=_FAST, error_model='numpy')
def _choose(support: Support, scale: Scale, scratch: Scratch) -> int:
    """
    List the voxels that the view's support holds; return how many there are.

    Without a branch: which voxels these are is hard to predict.
    """
    masks, base, shift, table = support.mask, support.base, support.shift, scale.table
    all_cell, all_sample, all_fraction = scratch.cell, scratch.sample, scratch.fraction
    all_t, chosen = scratch.t, scratch.chosen
    to_bin = np.float32(BINS * sqrt(32.0))
    count = uint64(0)
    for i in range(VOXELS):
        n = uint64(i)
        cell, sample = uint64(all_cell[n]), uint64(all_sample[n])
        low = table[sample]
        t = low + all_fraction[n] * (table[sample + uint64(1)] - low)
        all_t[n] = t
        # below the first bit it is a large number
        bit = uint64((int64(t * to_bin) - base[cell]) >> shift[cell])
        chosen[count] = i
        count += uint64(bit < uint64(64)) & (masks[cell] >> (bit & uint64(63)))
    return int(count)


@uncounted(fastmath=_FAST, error_model='numpy')
def _add_windows(
    first_voxel: int, count: int, value: Floats, expected: Floats, factor_of_view: float,
    image: Warped, scale: Scale, weights: Weights, scratch: Scratch,
) -> None:
    """Add the view's kernels about the chosen voxels."""
    pixels, stride, weight, lanes = image.image, image.stride, weights.table, weights.lanes
    constant, quadratic = np.float32(scale.constant), np.float32(scale.quadratic)
    floor, factor = np.float32(scale.floor), np.float32(factor_of_view)
    # from a point's pixel, counted from the rim before the image, to its window's first
    offset = image.pad - lanes // 2 - (lanes // 2 - 1)
    corner = image.pad - lanes // 2
    phases = np.float32(len(weight) // lanes)
    zero, half, near = np.float32(0), np.float32(0.5), np.float32(SEEN / sqrt(32.0))
    shifted = np.float32(1 / sqrt(32.0))
    for m in range(count):
        n = uint64(scratch.chosen[uint64(m)])
        u, v, z, t = scratch.u[n], scratch.v[n], scratch.z[n], scratch.t[n]
        u_whole, v_whole = int64(u), int64(v)  # truncation is floor, as these are positive
        h3 = constant + quadratic * z * z
        slope = np.float32(2) * quadratic * z
        slope = slope if h3 >= floor else zero
        share = factor / max(h3, floor)
        in_u = int64((u - np.float32(u_whole)) * phases) * lanes
        in_v = int64((v - np.float32(v_whole)) * phases) * lanes
        start = (v_whole + offset) * stride + u_whole + offset
        total = zero
        for strip in range(0, lanes, LANES):
            total += window_strip(
                pixels, start + strip, stride, weight, in_v, lanes, weight, in_u + strip,
                t - slope * shifted)
        # the nearest pixel tells whether the view sees the surface here
        nearest = pixels[uint64(
            (int64(v + half) + corner) * stride + int64(u + half) + corner)]
        at = uint64(first_voxel) + n
        value[at] += total * share
        expected[at] += share if abs(nearest - t) <= near else zero
