# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The density sampled on a sparse lattice: a view costs the same however many came before.

A view adds its term to the voxels within its support, each once; between voxels the density is a
cubic spline. Nothing of the view is kept, and remove() subtracts the same numbers again.
"""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from math import pi, sqrt
from typing import Any, NamedTuple

from numba import int64, njit, uint64
import numpy as np
from numpy.typing import NDArray

from ..errors import FrameError, InputError
from . import blocks as lattice
from .blocks import Blocks, find, key_of, place_of, SIDE, VOXELS
from .camera import Camera, project_jet
from .climb import aim, climb, h3_at, INTERVAL, MAX_ITERATIONS, set_out, Status
from .vector import LANES, spline_jet, window_strip
from .view import View
from .warped import (
    BINS,
    CELL,
    depth_ranges,
    empty_support,
    find_support,
    Scale,
    Support,
    Warped,
    warped,
    Weights,
)

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

_ROWS_OF_CELLS = 15  # a task
_BLOCKS = 64  # a task
_POINTS = 4096  # a task
_CELL_BITS = 2  # of CELL
_FINEST = 1.5  # voxels wider than this many lateral bandwidths alias


class Lattice(NamedTuple):
    """
    The sampled density, for the kernels.

    :param voxel: metres
    """

    blocks: Blocks
    voxel: float


class Place(NamedTuple):
    """One view's geometry, for the kernels."""

    R_camera_world: Doubles
    t_camera_world: Doubles
    camera: Doubles
    width: int
    height: int
    factor: float


class VoxelDensity:
    """
    The likelihood of world points given the views added so far, on a lattice.

    :param pixel_bandwidth: h1 = h2, pixels
    :param depth_bandwidth: h3 at depth 0, metres
    :param depth_bandwidth_quadratic: growth of h3 with the squared depth, 1/metres
    :param voxel_size: metres; h3 is never below it
    :param depth_max: metres; larger depths count as invalid
    :raises InputError: if a bandwidth or the voxel size is not positive
    """

    def __init__(
        self, pixel_bandwidth: float, depth_bandwidth: float, depth_bandwidth_quadratic: float,
        voxel_size: float, depth_max: float,
    ) -> None:
        if not (pixel_bandwidth > 0 and depth_bandwidth > 0 and depth_bandwidth_quadratic >= 0):
            raise InputError('bandwidths must be positive')
        if not voxel_size > 0:
            raise InputError('voxel_size must be positive')
        self.voxel_size = voxel_size
        self.pixel_bandwidth = pixel_bandwidth
        self.depth_max = depth_max
        # h3(z) = max(constant + quadratic z^2, floor)
        self.bandwidth = (
            float(depth_bandwidth), float(depth_bandwidth_quadratic), float(voxel_size))
        self.scale = Scale.of(*self.bandwidth, depth_max)
        self.weights = Weights.of(pixel_bandwidth)
        self.blocks = lattice.new_blocks()
        self.size = 0  # views
        self.pixels = 0
        self.aliased_pixels = 0  # nearer than the lattice can follow
        self._depth_of_bins = self.scale.depth_of_bins()
        self._change = 0
        self._stale: list[NDArray[np.int32]] = []

    @property
    def state(self) -> Lattice:
        """Return what the kernels need."""
        return Lattice(self.blocks, self.voxel_size)

    @property
    def change(self) -> int:
        """Return the number of the last change of the lattice."""
        return self._change

    def h3(self, depth: Doubles | Floats) -> Doubles:
        """Return the bandwidth along the depth, metres, at depths in metres."""
        constant, quadratic, floor = self.bandwidth
        return np.maximum(constant + quadratic * np.asarray(depth, np.float64) ** 2, floor)

    def add(self, view: View, pool: Executor | None = None) -> None:
        """Add a view's kernels."""
        self._accumulate(view, 1, pool)

    def cover(self, keys: NDArray[np.int64]) -> NDArray[np.int32]:
        """
        Make sure that blocks exist, so that whoever watches them learns of every change there.

        :param keys: (n,) int64, in any order, repeated or not
        :return: the blocks' numbers, each once
        """
        before = self.blocks.size
        self._change += 1
        self.blocks, found = lattice.with_keys(self.blocks, keys, self._change)
        if self.blocks.size > before:
            self._stale.append(np.arange(before, self.blocks.size, dtype=np.int32))
        return found

    def finest_voxel(self, depth: float, camera: Camera) -> float:
        """Return the widest voxel (metres) that follows the lateral kernel at a depth."""
        return _FINEST * self.pixel_bandwidth * depth / max(camera.fx, camera.fy)

    def share_changed(self, watched: NDArray[np.int32], change: int) -> float:
        """Return the share of some blocks whose spline changed after a change."""
        return float(np.mean(self.blocks.filtered[watched] > change)) if len(watched) else 0.0

    def remove(self, view: View, pool: Executor | None = None) -> None:
        """Subtract what add() added for the same view."""
        self._accumulate(view, -1, pool)

    def refresh(self, pool: Executor | None = None) -> None:
        """Bring the spline up to date with the samples; before asking for anything."""
        if not self._stale:
            return
        changed = np.unique(np.concatenate(self._stale))
        self._stale.clear()
        chosen = np.sort(lattice.with_neighbours(self.blocks, changed, self._change))
        parts = [chosen[i:i + _BLOCKS] for i in range(0, len(chosen), _BLOCKS)]
        _all(pool, lattice.prefilter, [(self.blocks, part) for part in parts])
        _all(pool, lattice.copy_margins, [(self.blocks, part) for part in parts])

    def likelihood(self, points: Doubles, pool: Executor | None = None) -> Doubles:
        """
        Evaluate the likelihood at points.

        :param points: (n, 3) float64, world, metres
        :return: (n,) float64, 1 / (px^2 m)
        """
        points = np.ascontiguousarray(points, np.float64)
        directions = np.zeros((1, 3))
        jets = np.zeros((len(points), 3))
        _all(pool, _jets, [
            (self.state, points[i:i + _POINTS], directions, np.zeros(1), jets[i:i + _POINTS])
            for i in range(0, len(points), _POINTS)])
        return jets[:, 0] / max(self.size, 1)

    def along(
        self, origins: Doubles, directions: Doubles, distances: Doubles
    ) -> tuple[Doubles, Doubles, Doubles]:
        """
        Evaluate the likelihood and its derivatives along lines.

        :param origins: (n, 3) float64, world, metres; directions likewise
        :param distances: (n,) float64, in units of the directions' lengths
        :return: f, f', f'', each (n,) float64; f in 1 / (px^2 m)
        """
        jets = np.zeros((len(origins), 3))
        _jets(
            self.state, np.ascontiguousarray(origins, np.float64),
            np.ascontiguousarray(directions, np.float64),
            np.ascontiguousarray(distances, np.float64), jets)
        jets /= max(self.size, 1)
        return jets[:, 0], jets[:, 1], jets[:, 2]

    def _check_reach(self, view: View) -> None:
        """Refuse a camera from where a block's number could not be written down."""
        reach = 2.0 ** 20 * SIDE * self.voxel_size
        away = float(np.abs(view.T_world_camera[:3, 3]).max())
        if not away + 4 * self.depth_max < reach:
            raise FrameError(
                'out_of_range', f'the camera is {away:.0f} m from the origin of the world frame; '
                f'with voxels of {1000 * self.voxel_size:g} mm a map reaches {reach:.0f} m: '
                'choose a nearer world_frame')

    def _accumulate(self, view: View, sign: int, pool: Executor | None) -> None:
        height, width = view.depth.shape
        self._check_reach(view)
        T = np.asarray(view.T_world_camera, np.float64)
        R_world_camera = np.ascontiguousarray(T[:3, :3])
        R_camera_world = np.ascontiguousarray(R_world_camera.T)
        # the weights sum to 1 where the Gaussian's values sum to 2 pi h1^2
        factor = sign / sqrt(2 * pi) / (width * height)
        place = Place(
            R_camera_world, -R_camera_world @ T[:3, 3], view.camera.parameters, width, height,
            factor)
        image = warped(view, self.scale, self.weights)
        support = empty_support(height, width)
        rows = [
            (i, min(i + _ROWS_OF_CELLS, len(support.mask)))
            for i in range(0, len(support.mask), _ROWS_OF_CELLS)]
        ranges = depth_ranges(image.bins)
        _all(pool, find_support, [
            (image.bins, *ranges, self.weights.lanes, support, *part) for part in rows])
        keys = _all(pool, _keys, [
            (support, view.camera.rays, R_world_camera, T[:3, 3].copy(), self._depth_of_bins,
             SIDE * self.voxel_size, self.weights.lanes // 2, *part) for part in rows])
        self.size += sign
        self.pixels += sign * int(np.count_nonzero(np.isfinite(view.depth)))
        nearest = self.voxel_size / self.finest_voxel(1.0, view.camera)
        self.aliased_pixels += sign * int(np.count_nonzero(view.depth < nearest))
        self._change += 1
        self.blocks, touched = lattice.with_keys(
            self.blocks, np.concatenate(keys), self._change)
        if len(touched) == 0:
            return
        _all(pool, _add_to_blocks, [
            (self.state, touched[i:i + _BLOCKS], place, image, support, self.scale, self.weights)
            for i in range(0, len(touched), _BLOCKS)])
        self._stale.append(touched)


def _all(
    pool: Executor | None, task: Callable[..., Any], arguments: list[tuple[Any, ...]]
) -> list[Any]:
    """Run a kernel for all tuples of arguments; results in their order."""
    if pool is None:
        return [task(*one) for one in arguments]
    return [done.result() for done in [pool.submit(task, *one) for one in arguments]]


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
def _keys(
    support: Support, rays: Doubles, R_world_camera: Doubles, t_world_camera: Doubles,
    depth_of_bins: Doubles, block_size: float, rim: int, first: int, end: int,
) -> NDArray[np.int64]:
    """
    Return the keys of the blocks that some rows of cells have support in, with repetitions.

    A ray in the middle of each cell is followed through the runs of its mask, in steps that miss
    no block by more than a corner. More rays are where a cell is wide against a block, where some
    of its pixels have no ray, and at the border, where kernels reach rim pixels out of the image.
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
                stride = 1
                if spread * far <= block_size:
                    stride = CELL if inside else 2
                for v in range(v0 + stride // 2 - rim * (j == 0), v1 + rim * (j == rows - 1),
                               stride):
                    for u in range(u0 + stride // 2 - rim * (i == 0),
                                   u1 + rim * (i == columns - 1), stride):
                        a, b = _ray(rays, u, v)
                        if not abs(a + b) < np.inf:
                            continue
                        x = R[0, 0] * a + R[0, 1] * b + R[0, 2]
                        y = R[1, 0] * a + R[1, 1] * b + R[1, 2]
                        z = R[2, 0] * a + R[2, 1] * b + R[2, 2]
                        for step in range(steps + 1):
                            depth = near + (far - near) * step / steps
                            key = key_of(
                                int(np.floor((t[0] + depth * x) / block_size)),
                                int(np.floor((t[1] + depth * y) / block_size)),
                                int(np.floor((t[2] + depth * z) / block_size)))
                            if key != last and key != before:
                                before, last = last, key
                                if count == len(out):
                                    longer = np.zeros(2 * count, np.int64)
                                    longer[:count] = out
                                    out = longer
                                out[count] = key
                                count += 1
    return out[:count]


@njit(cache=True, nogil=True, fastmath={'contract', 'nsz', 'arcp'}, error_model='numpy')
def _add_to_blocks(
    state: Lattice, chosen: NDArray[np.int32], place: Place, image: Warped, support: Support,
    scale: Scale, weights: Weights,
) -> None:
    """Add a view's term to the voxels of some blocks that its support holds."""
    R, t, voxel = place.R_camera_world, place.t_camera_world, state.voxel
    # taken out once: in the inner loop each would be counted as in use
    value, key = state.blocks.value, state.blocks.key
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


@njit(inline='always')
def _jet(
    coefficient: Floats, neighbour: NDArray[np.int32], table_key: NDArray[np.int64],
    table_block: NDArray[np.int32], voxel: float, bases: NDArray[np.int64],
    recent: NDArray[np.int64], origin: Doubles, direction: Doubles, distance: float,
) -> tuple[float, float, float]:
    """
    Evaluate the spline at a point of a world line; all 0 where there is no block.

    The lattice's arrays come one by one: taken out of it in the inner loop, each would be counted
    as in use, which costs more than the evaluation.

    :param bases: (4,), where the blocks of the last point begin
    :param recent: (1,), the key of its first block
    :return: C f, C f', C f''
    """
    per_voxel = 1.0 / voxel
    x = (origin[0] + distance * direction[0]) * per_voxel
    y = (origin[1] + distance * direction[1]) * per_voxel
    z = (origin[2] + distance * direction[2]) * per_voxel
    i, j, k = int64(np.floor(x)), int64(np.floor(y)), int64(np.floor(z))
    # the first of the four taps is one before
    key = key_of((i - 1) >> 3, (j - 1) >> 3, (k - 1) >> 3)
    if key != recent[0]:
        recent[0] = key
        block = find(table_key, table_block, key)
        for n, other in enumerate((13, 16, 22, 25)):  # itself, next in y, in z, in both
            bases[n] = int64(neighbour[block, other]) * lattice.COEFFICIENTS
    # block 0 holds zeros, so what is not there needs no case of its own
    f, f1, f2 = spline_jet(
        coefficient, bases, (i - 1) & 7, (j - 1) & 7, (k - 1) & 7,
        np.float32(x - i), np.float32(y - j), np.float32(z - k),
        np.float32(direction[0] * per_voxel), np.float32(direction[1] * per_voxel),
        np.float32(direction[2] * per_voxel))
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
            if count == len(out):
                longer = np.zeros(2 * count, np.int64)
                longer[:count] = out
                out = longer
            out[count] = key
            count += 1
    return out[:count]


@njit(cache=True, nogil=True)
def _jets(
    state: Lattice, origins: Doubles, directions: Doubles, distances: Doubles, out: Doubles
) -> None:
    """Write the jets of lines to out (n, 3); one direction and distance may serve all."""
    bases, recent = np.zeros(4, np.int64), np.full(1, -1, np.int64)
    coefficient, neighbour = state.blocks.coefficient, state.blocks.neighbour
    table_key, table_block = state.blocks.table_key, state.blocks.table_block
    for n in range(len(origins)):
        m = min(n, len(directions) - 1)
        f, f1, f2 = _jet(
            coefficient, neighbour, table_key, table_block, state.voxel, bases, recent,
            origins[n], directions[m], distances[m])
        out[n, 0], out[n, 1], out[n, 2] = f, f1, f2


@njit(cache=True, nogil=True, error_model='numpy')
def march_rays(
    state: Lattice, bandwidth: tuple[float, float, float], chosen: NDArray[np.int64],
    pixels: NDArray[np.int32], table: Doubles, T_world_camera: Doubles, starts: Floats,
    depths: Floats, totals: Floats, statuses: NDArray[np.uint8], counts: NDArray[np.uint8],
) -> None:
    """Climb from the starts of chosen rays; see ray_march.Rays for the arrays."""
    bases, recent = np.zeros(4, np.int64), np.full(1, -1, np.int64)
    coefficient, neighbour = state.blocks.coefficient, state.blocks.neighbour
    table_key, table_block = state.blocks.table_key, state.blocks.table_block
    origin = T_world_camera[:3, 3].copy()
    direction = np.zeros(3)
    for i in chosen:
        aim(table, T_world_camera, pixels[i], direction)
        start = np.float64(starts[i])
        h3 = h3_at(bandwidth, start)
        ray = set_out(start)
        count = 0
        while ray.status == 0 and count < MAX_ITERATIONS:
            f, f1, f2 = _jet(
                coefficient, neighbour, table_key, table_block, state.voxel, bases, recent,
                origin, direction, ray.target)
            # the mean-shift's g, as on a surface that faces its cameras
            ray = climb(ray, start, h3, f, f1, f2, f / (h3 * h3))
            count += 1
        depths[i] = ray.beta
        totals[i] = ray.value
        statuses[i] = ray.status if ray.status != 0 else Status.ITERATION_LIMIT
        counts[i] = count


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
