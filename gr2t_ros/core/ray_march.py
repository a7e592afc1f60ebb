# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Maxima of the density along the rays of a view.

A ray starts at its pixel's observed depth, or where that is an outlier at a neighbour's, and
climbs within 4 h3 of its start, as climb.py says.
"""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from copy import copy
from dataclasses import dataclass, field
from types import ModuleType

from numba import njit
import numpy as np
from numpy.typing import NDArray

from . import exact_query, voxel_query
from .climb import aim, INTERVAL, Status
from .compiled import run_all
from .exact_density import ExactDensity
from .view import View
from .voxel_density import VoxelDensity
from .voxel_query import keys_along
from .warped import robust_starts, Scale, Warped, warped, Weights

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Density = ExactDensity | VoxelDensity

_CHUNK = 8192  # rays a task


@dataclass(eq=False)
class Rays:
    """
    The rays of one view and what was found on them.

    :param pixels: (n,) int32, flat pixel indices v * width + u
    :param table: (h, w, 2) float64, Camera.rays
    :param T_world_camera: (4, 4) float64
    :param start: (n,) float32, metres
    :param depth: (n,) float32, metres: the maximum where converged
    :param total: (n,) float32: C times the likelihood there
    :param curvature: (n,) float32: its second derivative along the depth, 1/m^2, where it was
        evaluated last
    :param status: (n,) uint8, Status
    :param iterations: (n,) uint8: evaluations of the density
    :param marched: (n,) int32: the density's change up to which the ray is right
    :param marches: (n,) uint16: how often it was marched, modulo 2^16
    :param rounds: how often some of them were
    """

    pixels: NDArray[np.int32]
    table: Doubles
    T_world_camera: Doubles
    start: Floats
    depth: Floats
    total: Floats
    curvature: Floats
    status: NDArray[np.uint8]
    iterations: NDArray[np.uint8]
    marched: NDArray[np.int32]
    marches: NDArray[np.uint16] = field(init=False)
    rounds: int = field(init=False)

    def __post_init__(self) -> None:
        self.marches = (self.iterations > 0).astype(np.uint16)
        self.rounds = int(self.marches.any())

    @property
    def converged(self) -> NDArray[np.bool_]:
        """Return which rays have found their maximum, (n,)."""
        return np.equal(self.status, Status.CONVERGED)

    def copy(self) -> Rays:
        """Return rays with results of their own."""
        own = copy(self)
        own.depth, own.total = self.depth.copy(), self.total.copy()
        own.curvature, own.status = self.curvature.copy(), self.status.copy()
        own.iterations, own.marched = self.iterations.copy(), self.marched.copy()
        own.marches = self.marches.copy()
        return own

    @property
    def origin(self) -> Doubles:
        """Return where the rays begin, (3,) float64, world, metres."""
        return self.T_world_camera[:3, 3].copy()

    def directions(self, which: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Doubles:
        """Return (n, 3) float64, world, of the length that makes the distance the depth."""
        pixels = self.pixels[which]
        directions = np.zeros((len(pixels), 3))
        _aim_all(self.table, self.T_world_camera, pixels, directions)
        return directions

    def points(self, which: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Doubles:
        """Return the points found on some rays, (n, 3) float64, world, metres."""
        points = self.directions(which)
        points *= self.depth[which][:, None]
        points += self.origin
        return points


@njit(cache=True, nogil=True)
def _aim_all(
    table: Doubles, T_world_camera: Doubles, pixels: NDArray[np.int32], directions: Doubles
) -> None:
    for n in range(len(pixels)):
        aim(table, T_world_camera, pixels[n], directions[n])


def rays_of(
    density: Density, view: View, stride: int, start: str, pool: Executor | None = None
) -> Rays:
    """
    Make the rays of a view's valid pixels, at their starts.

    :param stride: every stride-th pixel of every stride-th row
    :param start: robust or observed
    """
    camera = view.camera
    depth = np.ascontiguousarray(view.depth, np.float32)
    pixels = _valid_pixels(depth, camera.rays, stride)
    n = len(pixels)
    depth = depth.ravel()
    starts = depth[pixels]
    if start == 'robust' and n:
        image, weights = _own_image(density, view, float(starts.max()), pool)
        _over_chunks(
            pool, n, lambda part: robust_starts(
                image, weights, camera.width, depth, pixels[part], starts[part]))
    return Rays(
        pixels, camera.rays, np.array(view.T_world_camera, np.float64), starts, starts.copy(),
        np.zeros(n, np.float32), np.zeros(n, np.float32), np.zeros(n, np.uint8),
        np.zeros(n, np.uint8), np.full(n, -1, np.int32))


@njit(cache=True, nogil=True)
def _valid_pixels(depth: Floats, table: Doubles, stride: int) -> NDArray[np.int32]:
    """Return the flat indices of the pixels that have a depth and a ray."""
    height, width = depth.shape
    pixels = np.zeros(-(-height // stride) * -(-width // stride), np.int32)
    count = 0
    for v in range(0, height, stride):
        for u in range(0, width, stride):
            pixels[count] = v * width + u
            count += np.isfinite(depth[v, u]) and np.isfinite(table[v, u, 0])
    return pixels[:count].copy()


def _own_image(
    density: Density, view: View, deepest: float, pool: Executor | None
) -> tuple[Warped, Weights]:
    """Return a view's depth image in units of its bandwidth, and the lateral kernel."""
    if isinstance(density, VoxelDensity):
        return density.image_of(view, pool), density.weights
    weights = Weights.of(density.pixel_bandwidth)
    return warped(view, Scale.of(*density.bandwidth, deepest), weights, pool), weights


def march(
    density: Density, rays: Rays, which: NDArray[np.int64], pool: Executor | None = None
) -> None:
    """
    Climb to the maximum on some rays, each from its start.

    :param which: (n,) int64, indices of rays
    :param pool: where to do it; None: in this thread
    """
    kernels = _kernels(density)
    _over_chunks(
        pool, len(which), lambda part: kernels.march_rays(
            density.state, density.bandwidth, which[part], rays.pixels, rays.table,
            rays.T_world_camera, rays.start, rays.depth, rays.total, rays.curvature,
            rays.status, rays.iterations))
    rays.marched[which] = density.change
    rays.marches[which] += np.uint16(1)
    rays.rounds += 1


def stale(
    density: Density, rays: Rays, part: slice, pool: Executor | None = None
) -> NDArray[np.int64]:
    """
    Tell which rays saw the density change within their search interval since they were marched.

    :param part: which of the rays to ask
    :return: (n,) int64, indices of rays, ascending; the others are right up to the last change
    """
    marched = rays.marched[part]
    changed = np.zeros(len(marched), np.bool_)
    pixels, starts = rays.pixels[part], rays.start[part]
    kernels = _kernels(density)
    _over_chunks(
        pool, len(marched), lambda chunk: kernels.changed_rays(
            density.state, density.bandwidth, pixels[chunk], rays.table, rays.T_world_camera,
            starts[chunk], marched[chunk], changed[chunk]))
    rays.marched[part] = np.where(changed, marched, density.change)
    return np.flatnonzero(changed) + (part.start or 0)


def watched_blocks(
    density: VoxelDensity, rays: Rays, pool: Executor | None = None
) -> NDArray[np.int32]:
    """Return the lattice's blocks that the rays' search intervals need, each once."""
    keys = [np.zeros(0, np.int64)] * -(-len(rays.pixels) // _CHUNK)

    def find(part: slice) -> None:
        start = rays.start[part].astype(np.float64)
        reach = INTERVAL * density.h3(start)
        keys[part.start // _CHUNK] = keys_along(
            density.state, rays.origin, rays.directions(part), start - reach, start + reach)

    _over_chunks(pool, len(rays.pixels), find)
    return density.cover(np.concatenate(keys) if keys else np.zeros(0, np.int64))


def _kernels(density: Density) -> ModuleType:
    """Return the module whose march_rays and changed_rays take the density's state."""
    return voxel_query if isinstance(density, VoxelDensity) else exact_query


def _over_chunks(pool: Executor | None, count: int, task: Callable[[slice], None]) -> None:
    """Run task(slice) over all chunks; each ray is its own, so any split gives the same bits."""
    run_all(pool, task, [
        (slice(i, min(i + _CHUNK, count)),) for i in range(0, count, _CHUNK)])
