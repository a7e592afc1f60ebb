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
from .vector import LANES, window_strip
from .warped import BINS, CELL, Scale, Support, Warped, Weights

Doubles = NDArray[np.float64]

_CELL_BITS = 2  # of CELL
_SEEN = 4.0  # bandwidths between a voxel and its pixel's depth at which it counts as seen


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

    A ray in the middle of each cell is followed through the runs of its mask, in steps that miss
    no block by more than a corner. More rays are where a cell, or a pixel, is wide against a
    block, where some pixels have no ray, and at the border, where kernels reach rim pixels out of
    the image.
    """
    out = np.zeros(4096, np.int64)
    count = 0
    last, before = int64(-1), int64(-1)
    rows, columns = support.mask.shape
    R, t = R_world_camera, t_world_camera
    for j in range(first, end):
        for i in range(columns):
            mask = support.mask[j, i]
            if mask == 0:
                continue
            u0, v0, u1, v1 = CELL * i, CELL * j, CELL * (i + 1), CELL * (j + 1)
            a, b = _ray(rays, u0, v0)
            c, d = _ray(rays, u1, v1)
            spread = abs(c - a) + abs(d - b)
            inside = 0 < i < columns - 1 and 0 < j < rows - 1 and np.isfinite(
                spread + _ray(rays, u0, v1)[0] + _ray(rays, u1, v0)[0])
            base, shift = support.base[j, i], support.shift[j, i]
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
                steps = int(2.5 * (far - near) / block_size) + 1
                stride, lines, pixel_a, pixel_b = 1, 1, 0.0, 0.0
                if spread * far <= block_size:
                    stride = CELL if inside else 2
                elif inside and spread * far > CELL * block_size:
                    # pixels wider than blocks: several lines each
                    lines = int(spread * far / (CELL * block_size)) + 1
                    pixel_a, pixel_b = (c - a) / CELL, (d - b) / CELL
                for v in range(v0 + stride // 2 - rim * (j == 0), v1 + rim * (j == rows - 1),
                               stride):
                    for u in range(u0 + stride // 2 - rim * (i == 0),
                                   u1 + rim * (i == columns - 1), stride):
                        middle_a, middle_b = _ray(rays, u, v)
                        if not abs(middle_a + middle_b) < np.inf:
                            continue
                        for sample in range(lines * lines * (steps + 1)):
                            line, step = divmod(sample, steps + 1)
                            row, column = divmod(line, lines)
                            p = middle_a + ((column + 0.5) / lines - 0.5) * pixel_a
                            q = middle_b + ((row + 0.5) / lines - 0.5) * pixel_b
                            x = R[0, 0] * p + R[0, 1] * q + R[0, 2]
                            y = R[1, 0] * p + R[1, 1] * q + R[1, 2]
                            z = R[2, 0] * p + R[2, 1] * q + R[2, 2]
                            depth = near + (far - near) * step / steps
                            key = key_of(
                                int(np.floor((t[0] + depth * x) / block_size)),
                                int(np.floor((t[1] + depth * y) / block_size)),
                                int(np.floor((t[2] + depth * z) / block_size)))
                            if key != last and key != before:
                                before, last = last, key
                                out = with_room(out, count)
                                out[count] = key
                                count += 1
    return out[:count]


@njit(cache=True, nogil=True, fastmath={'contract', 'nsz', 'arcp'}, error_model='numpy')
def add_to_blocks(
    blocks: Blocks, voxel: float, chosen: NDArray[np.int32], place: Place, image: Warped,
    support: Support, scale: Scale, weights: Weights,
) -> None:
    """Add a view's term to the voxels of some blocks that its support holds."""
    R, t = place.R_camera_world, place.t_camera_world
    # taken out once: in the inner loop each would be counted as in use
    value, expected, key = blocks.value, blocks.expected, blocks.key
    pixels, stride = image.image, image.stride
    table, weight = scale.table, weights.table
    base, shift, masks = support.base, support.shift, support.mask
    camera = place.camera
    pinhole = camera[0] == 0
    lanes = weights.lanes
    rim = lanes // 2  # pixels that kernels reach out of the image
    margin = np.float32(rim)
    fx, fy = np.float32(camera[1]), np.float32(camera[2])
    cx, cy = np.float32(camera[3]) + margin, np.float32(camera[4]) + margin
    line_z, line_u, line_v = (
        np.zeros(SIDE, np.float32), np.zeros(SIDE, np.float32), np.zeros(SIDE, np.float32))
    # offsets within a block are small: float32 holds them
    step_x = np.float32(R[0, 0] * voxel)
    step_y = np.float32(R[1, 0] * voxel)
    step_z = np.float32(R[2, 0] * voxel)
    # from a point's pixel, counted from rim before the image, to its window's first
    offset = image.pad - rim - (lanes // 2 - 1)
    corner = image.pad - rim
    half, near = np.float32(0.5), np.float32(_SEEN / sqrt(32.0))
    phases = np.float32(len(weight) // lanes)
    right, bottom = np.float32(place.width + 2 * rim - 1), np.float32(place.height + 2 * rim - 1)
    last_row, last_column = masks.shape[0] - 1, masks.shape[1] - 1
    per_metre, deepest = np.float32(scale.per_metre), np.float32(len(table) - 1)
    constant, quadratic = np.float32(scale.constant), np.float32(scale.quadratic)
    floor, factor = np.float32(scale.floor), np.float32(place.factor)
    to_bin = np.float32(BINS * sqrt(32.0))
    shifted = np.float32(1 / sqrt(32.0))
    for block in chosen:
        bx, by, bz = place_of(key[block])
        for line in range(64):
            px = bx * SIDE * voxel
            py = (by * SIDE + line % SIDE) * voxel
            pz = (bz * SIDE + line // SIDE) * voxel
            x0 = np.float32(R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz + t[0])
            y0 = np.float32(R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz + t[1])
            z0 = np.float32(R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz + t[2])
            first_voxel = int64(block) * VOXELS + line * SIDE
            for i in range(SIDE):  # a loop of its own, as it is one vector operation
                n = uint64(i)
                along = np.float32(i)
                line_z[n] = z0 + along * step_z
                closeness = np.float32(1) / line_z[n]
                line_u[n] = fx * (x0 + along * step_x) * closeness + cx
                line_v[n] = fy * (y0 + along * step_y) * closeness + cy
            for i in range(SIDE):
                z = line_z[i]
                depth_at = z * per_metre
                if not np.float32(0) < depth_at < deepest:
                    continue
                # (margin is in cx, cy already)
                u_up, v_up = line_u[i], line_v[i]
                if not pinhole:
                    along = np.float32(i)
                    seen, u, _, _, v, _, _ = project_jet(
                        camera, float(x0 + along * step_x), 0.0,
                        float(y0 + along * step_y), 0.0, float(z), 0.0)
                    if not seen:
                        continue
                    u_up, v_up = np.float32(u) + margin, np.float32(v) + margin
                # truncation is floor, as these are positive
                if not (np.float32(0) <= u_up < right and np.float32(0) <= v_up < bottom):
                    continue
                u_whole, v_whole = int(u_up), int(v_up)
                row = min(max(v_whole - rim, 0) >> _CELL_BITS, last_row)
                column = min(max(u_whole - rim, 0) >> _CELL_BITS, last_column)
                mask = masks[row, column]
                if mask == uint64(0):
                    continue
                sample = int(depth_at)
                at = table[sample] + (depth_at - np.float32(sample)) * (
                    table[sample + 1] - table[sample])
                bit = (int(at * to_bin) - base[row, column]) >> shift[row, column]
                if bit < 0 or bit > 63 or (mask >> uint64(bit)) & uint64(1) == 0:
                    continue
                h3 = constant + quadratic * z * z
                slope = np.float32(2) * quadratic * z
                if h3 < floor:
                    h3, slope = floor, np.float32(0)
                in_u = int((u_up - np.float32(u_whole)) * phases) * lanes
                in_v = int((v_up - np.float32(v_whole)) * phases) * lanes
                start = (v_whole + offset) * stride + u_whole + offset
                total = np.float32(0)
                for strip in range(0, lanes, LANES):
                    total += window_strip(
                        pixels, start + strip, stride, weight, in_v, lanes,
                        weight, in_u + strip, at - slope * shifted)
                value[first_voxel + i] += factor * total / h3
                # the nearest pixel tells whether the view sees the surface here
                nearest = pixels[
                    (int(v_up + half) + corner) * stride + int(u_up + half) + corner]
                if abs(nearest - at) <= near:
                    expected[first_voxel + i] += factor / h3
