# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
What the fused map takes from a keyframe: an image of its rays' maxima, and how much each counts.

An image has a pixel for each ray that could be, one every ray_stride pixels of the camera's image.
"""
from __future__ import annotations

from concurrent.futures import Executor
from copy import copy
from math import sqrt

import cv2
from numba import int64, njit, uint64
import numpy as np
from numpy.typing import NDArray

from .blocks import key_of, SIDE, with_room
from .camera import Camera
from .climb import h3_at
from .compiled import run_all
from .confidence import confidences, deviations_and_agreements
from .ray_march import Density, Rays

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Bandwidth = tuple[float, float, float]

# A pixel of such an image:
#   depth       of the maximum along the camera's axis, metres
#   weight      (h3 / sigma)^2, at most 1, in steps of 1 / CERTAIN; 0: there is no maximum, or it
#               does not count
#   frontality  the cosine between the ray and the surface's normal, in steps of 1 / 255
#   confidence  in steps of 1 / 255
PIXEL = np.dtype([
    ('depth', 'f4'), ('weight', 'u2'), ('frontality', 'u1'), ('confidence', 'u1')])
CERTAIN = 65535
_MIN_AGREEMENT = 0.05  # less is what an outlier has
JUMP = 4.0  # h3 between neighbours that lie on different surfaces
TILE = 4  # pixels; side of the squares whose depths are known
REACH = 4.0
_SQUARE = 8  # pixels; side of the squares whose blocks are found together
_HALO = 2  # pixels about a square that have a part in what lies within it
_RAYS, _ROWS = 32768, 80  # a task; rows of whole squares and tiles
_BITS = 64


def spread(bandwidth: Bandwidth, voxel: float) -> Bandwidth:
    """Return the bandwidth (as climb.h3_at takes it) of a maximum in the fused map, its sigma."""
    constant, quadratic, floor = bandwidth
    return constant, quadratic, max(floor, 0.75 * voxel)


class FusedView:
    """
    A keyframe's image, empty at first.

    :param camera: of the keyframe
    :param stride: ray_stride

    `pixels` is (h, w) PIXEL; `tiles` is (h / TILE, w / TILE, 2) float32, the least and the largest
    depth in each tile, metres; (inf, -inf) where there is none; `changed` is likewise, of the
    pixels (and their neighbours) that the last update changed, as they were and as they are;
    `rounds` is that of the rays when they were taken in; `former` is the image as it was before
    the last update, where it is kept.
    """

    def __init__(self, camera: Camera, stride: int) -> None:
        self.stride = stride
        self.rounds = 0
        self._table = camera.rays[::stride, ::stride]
        height, width = self._table.shape[:2]
        self.pixels = np.zeros((height, width), PIXEL)
        self.tiles = np.zeros((-(-height // TILE), -(-width // TILE), 2), np.float32)
        self.changed = np.zeros_like(self.tiles)
        self._marches = np.zeros(0, np.uint16)
        self.former: FusedView | None = None
        self.depth = (np.inf, -np.inf)
        self._margin = 2.0 * stride / min(camera.fx, camera.fy)

    @property
    def nbytes(self) -> int:
        """Return the memory it takes."""
        return self.pixels.nbytes + 2 * self.tiles.nbytes + self._marches.nbytes

    @property
    def addresses(self) -> tuple[int, int]:
        """Return where pixels and tiles are in memory."""
        return self.pixels.ctypes.data, self.tiles.ctypes.data

    def forget(self) -> None:
        """Take all rays anew with the next update."""
        self.rounds = 0
        self._marches[:] = 0

    def update(
        self, density: Density, rays: Rays, min_confidence: float, voxel: float,
        pool: Executor | None,
    ) -> NDArray[np.int64]:
        """
        Take in the rays that were marched since the last time.

        :param min_confidence: of the rays that count
        :param voxel: of the fused map, metres
        :return: keys of the blocks where that may change something, with repetitions
        """
        if len(self._marches) == 0:
            self._marches = np.zeros_like(rays.marches)
        which = np.flatnonzero(self._marches != rays.marches)
        self._marches, self.rounds = rays.marches.copy(), rays.rounds
        self.former = copy(self)
        self.pixels, self.tiles = self.pixels.copy(), self.tiles.copy()
        changed = np.zeros(self.pixels.shape, np.uint8)

        def enter(some: NDArray[np.int64]) -> None:
            sigma, agreement = deviations_and_agreements(density, rays, some)
            depth = rays.depth[some]
            confidence = confidences(sigma, density.h3(depth))
            agreement[~rays.converged[some] | (confidence < min_confidence)] = 0
            _enter(
                self.pixels, rays.pixels[some], rays.table.shape[1], self.stride, depth,
                agreement, confidence, changed)

        run_all(pool, enter, [(which[i:i + _RAYS],) for i in range(0, len(which), _RAYS)])
        about = np.asarray(cv2.dilate(changed, np.ones((3, 3), np.uint8)), np.uint8)
        rows = [(v, min(v + _ROWS, len(about))) for v in range(0, len(about), _ROWS)]
        run_all(pool, _turn, [
            (self.pixels, self._table, density.bandwidth, about, *some) for some in rows])
        every = np.ones_like(about)
        for tiles, images, chosen in (
                (self.tiles, [self.pixels], every),
                (self.changed, [self.pixels, self.former.pixels], about)):
            tiles[..., 0], tiles[..., 1] = np.inf, -np.inf
            for pixels in images:
                run_all(pool, _measure, [(pixels, chosen, tiles, *some) for some in rows])
        sigma = spread(density.bandwidth, voxel)
        near, far = float(self.tiles[..., 0].min()), float(self.tiles[..., 1].max())
        reach = REACH * h3_at(sigma, far)
        self.depth = (near - reach, far + reach)
        T = rays.T_world_camera
        return np.concatenate(run_all(pool, _keys, [
            (self.pixels, self.former.pixels, about, self._table, self._margin, T[:3, :3].copy(),
             T[:3, 3].copy(), sigma, SIDE * voxel, *some) for some in rows]))


@njit(cache=True, nogil=True)
def _enter(
    pixels: NDArray[np.void], where: NDArray[np.int32], width: int, stride: int, depth: Floats,
    agreement: Floats, confidence: Floats, changed: NDArray[np.uint8],
) -> None:
    """Write rays' results into the image; their pixels are those of the camera's image."""
    for n in range(len(where)):
        v, u = where[n] // width // stride, where[n] % width // stride
        pixel = pixels[v, u]
        changed[v, u] = 1
        pixel['depth'] = depth[n]
        counts = agreement[n] >= _MIN_AGREEMENT
        ratio = confidence[n] / max(1.0 - confidence[n], 1e-3)  # h3 / sigma
        pixel['weight'] = int(min(ratio * ratio, 1.0) * CERTAIN) if counts else 0
        pixel['confidence'] = int(255 * confidence[n] + 0.5)


@njit(cache=True, nogil=True)
def _turn(
    pixels: NDArray[np.void], table: Doubles, bandwidth: Bandwidth, changed: NDArray[np.uint8],
    first: int, end: int,
) -> None:
    """Compute the frontality in some rows where a pixel or a neighbour has changed."""
    for v in range(first, end):
        for u in range(pixels.shape[1]):
            if pixels[v, u]['weight'] == 0 or changed[v, u] == 0:
                continue
            pixels[v, u]['frontality'] = int(
                255 * _frontality(pixels, table, bandwidth, v, u) + 0.5)


@njit(cache=True, nogil=True)
def _frontality(
    pixels: NDArray[np.void], table: Doubles, bandwidth: Bandwidth, v: int, u: int
) -> float:
    """Return the cosine between the ray and the normal; 0 where there is no normal."""
    most = JUMP * h3_at(bandwidth, pixels[v, u]['depth'])
    x0, y0, z0 = _slope(pixels, table, v, u, 0, 1, most)
    x1, y1, z1 = _slope(pixels, table, v, u, 1, 0, most)
    x, y, z = y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1
    a, b = table[v, u, 0], table[v, u, 1]
    length = sqrt((x * x + y * y + z * z) * (a * a + b * b + 1))
    return min(abs(x * a + y * b + z) / length, 1.0) if length > 0 else 0.0


@njit(cache=True, nogil=True)
def _slope(
    pixels: NDArray[np.void], table: Doubles, v: int, u: int, down: int, across: int,
    most: float,
) -> tuple[float, float, float]:
    """Return the way from the pixel before to the one after, on one surface; 0 where none is."""
    height, width = pixels.shape
    depth = pixels[v, u]['depth']
    v0, u0, v1, u1 = v - down, u - across, v + down, u + across
    if v0 < 0 or u0 < 0 or pixels[v0, u0]['weight'] == 0 or not (
            abs(pixels[v0, u0]['depth'] - depth) <= most):
        v0, u0 = v, u
    if v1 >= height or u1 >= width or pixels[v1, u1]['weight'] == 0 or not (
            abs(pixels[v1, u1]['depth'] - depth) <= most):
        v1, u1 = v, u
    z0, z1 = pixels[v0, u0]['depth'], pixels[v1, u1]['depth']
    return (
        z1 * table[v1, u1, 0] - z0 * table[v0, u0, 0],
        z1 * table[v1, u1, 1] - z0 * table[v0, u0, 1], z1 - z0)


@njit(cache=True, nogil=True)
def _measure(
    pixels: NDArray[np.void], chosen: NDArray[np.uint8], tiles: Floats, first: int, end: int
) -> None:
    """Take the depths of the chosen pixels in some rows into their tiles' least and largest."""
    for v in range(first, end):
        for u in range(pixels.shape[1]):
            if chosen[v, u] != 0 and pixels[v, u]['weight'] > 0:
                tile = tiles[v // TILE, u // TILE]
                depth = pixels[v, u]['depth']
                tile[0], tile[1] = min(tile[0], depth), max(tile[1], depth)


@njit(cache=True, nogil=True)
def _keys(
    pixels: NDArray[np.void], before: NDArray[np.void], changed: NDArray[np.uint8], table: Doubles,
    margin: float, R_world_camera: Doubles, t_world_camera: Doubles, sigma: Bandwidth,
    block: float, top: int, bottom: int,
) -> NDArray[np.int64]:
    """
    Return the keys of the blocks in which changed pixels of some rows count, or counted.

    :param before: (h, w) PIXEL, as they were
    :param changed: (h, w) not 0 where a pixel or a neighbour has changed
    :param margin: more than the slope between the rays of neighbours
    """
    height, width = pixels.shape
    out, count = np.zeros(4096, np.int64), 0
    recent = np.full(16, -1, np.int64)
    origin = t_world_camera / block
    for v0 in range(top, bottom, _SQUARE):
        for u0 in range(0, width, _SQUARE):
            v1, u1 = min(v0 + _SQUARE, bottom), min(u0 + _SQUARE, width)
            if not changed[v0:v1, u0:u1].any():
                continue
            near, far = np.inf, -np.inf
            for v in range(max(v0 - _HALO, 0), min(v1 + _HALO, height)):
                for u in range(max(u0 - _HALO, 0), min(u1 + _HALO, width)):
                    if pixels[v, u]['weight'] > 0:
                        depth = pixels[v, u]['depth']
                        near, far = min(near, depth), max(far, depth)
                    if before[v, u]['weight'] > 0:
                        depth = before[v, u]['depth']
                        near, far = min(near, depth), max(far, depth)
            if far < near:
                continue
            reach = REACH * h3_at(sigma, far)
            near, far = near - reach, far + reach
            step = max((far - near) / _BITS, 0.5 * block)
            bits = min(int((far - near) / step) + 1, _BITS)
            mask = ~uint64(0)
            if far - near > 2 * block + 2 * reach:  # there may be free space between
                mask = _mask(pixels, before, v0, v1, u0, u1, near, step, sigma)
            cone = _cone(table, v0, v1, u0, u1, margin)
            if not cone[0] < cone[1]:
                continue
            for bit in range(bits):
                if mask >> uint64(bit) & uint64(1) == 0:
                    continue
                first, last = _box(
                    R_world_camera, cone, max(near + bit * step, 0.0),
                    near + (bit + 1) * step)
                x0, y0, z0 = _block_at(origin, first, block)
                x1, y1, z1 = _block_at(origin, last, block)
                for z in range(z0, z1 + 1):
                    for y in range(y0, y1 + 1):
                        for x in range(x0, x1 + 1):
                            key = key_of(x, y, z)
                            if (recent == key).any():
                                continue
                            recent[count % len(recent)] = key
                            out = with_room(out, count)
                            out[count] = key
                            count += 1
    return out[:count]


@njit(cache=True, nogil=True)
def _mask(
    pixels: NDArray[np.void], before: NDArray[np.void], v0: int, v1: int, u0: int, u1: int,
    near: float, step: float, sigma: Bandwidth,
) -> np.uint64:
    """Return bits for the steps from near on in which pixels of a square count, or counted."""
    height, width = pixels.shape
    mask = uint64(0)
    for v in range(max(v0 - _HALO, 0), min(v1 + _HALO, height)):
        for u in range(max(u0 - _HALO, 0), min(u1 + _HALO, width)):
            for n in range(2):
                pixel = pixels[v, u] if n == 0 else before[v, u]
                if pixel['weight'] == 0:
                    continue
                depth = pixel['depth']
                reach = REACH * h3_at(sigma, depth)
                first = min(max(int((depth - reach - near) / step), 0), _BITS - 1)
                last = min(max(int((depth + reach - near) / step), 0), _BITS - 1)
                mask |= (~uint64(0) >> uint64(_BITS - 1 - (last - first))) << uint64(first)
    return mask


@njit(cache=True, nogil=True)
def _cone(
    table: Doubles, v0: int, v1: int, u0: int, u1: int, margin: float
) -> tuple[float, float, float, float]:
    """Return the least and the largest x / z, the least and the largest y / z about a tile."""
    a0, a1, b0, b1 = np.inf, -np.inf, np.inf, -np.inf
    for v in range(v0, v1):
        for u in range(u0, u1):
            a, b = table[v, u, 0], table[v, u, 1]
            if abs(a + b) < np.inf:
                a0, a1, b0, b1 = min(a0, a), max(a1, a), min(b0, b), max(b1, b)
    return a0 - margin, a1 + margin, b0 - margin, b1 + margin


@njit(cache=True, nogil=True)
def _box(
    R_world_camera: Doubles, cone: tuple[float, float, float, float], near: float, far: float
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Return the corners of the box about a piece of a cone, relative to the camera, metres."""
    R = R_world_camera
    x0, y0, z0, x1, y1, z1 = np.inf, np.inf, np.inf, -np.inf, -np.inf, -np.inf
    for n in range(8):
        depth = far if n & 1 else near
        a = depth * (cone[1] if n & 2 else cone[0])
        b = depth * (cone[3] if n & 4 else cone[2])
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * depth
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * depth
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * depth
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    return (x0, y0, z0), (x1, y1, z1)


@njit(cache=True, nogil=True)
def _block_at(
    origin: Doubles, point: tuple[float, float, float], block: float
) -> tuple[np.int64, np.int64, np.int64]:
    """Return the numbers of the block at a point (metres) relative to an origin (blocks)."""
    return (
        int64(np.floor(origin[0] + point[0] / block)),
        int64(np.floor(origin[1] + point[1] / block)),
        int64(np.floor(origin[2] + point[2] / block)))
