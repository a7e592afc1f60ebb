# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Maxima of the density along the rays of a view.

A ray starts at its pixel's observed depth, or where that is an outlier at a neighbour's, and
climbs by Newton-Raphson on f (Grogan & Dahyot 2014). Newton is safe only where f'' < 0 and f does
not fall; elsewhere the ray takes the mean-shift step, which always climbs. It stays within 4 h3 of
its start.
"""
from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

from numba import njit
from numba.extending import overload
import numpy as np
from numpy.typing import NDArray

from . import exact_density, voxel_density
from .exact_density import ExactDensity
from .view import View
from .voxel_density import keys_along, VoxelDensity
from .warped import robust_starts, Scale, warped, Weights

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Density = ExactDensity | VoxelDensity

INTERVAL = 4.0  # h3; the search goes this far from the start
MAX_ITERATIONS = 50
_TOLERANCE = 0.02  # h3; a Newton step this short is the last, and good to its cube
_CHUNK = 2048  # rays a task


class Status(IntEnum):
    """How a ray ended."""

    NOT_MARCHED = 0
    CONVERGED = 1
    LEFT_INTERVAL = 2
    NO_SUPPORT = 3
    ITERATION_LIMIT = 4


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
    :param status: (n,) uint8, Status
    :param iterations: (n,) uint8: evaluations of the density
    :param marched: (n,) int32: the density's change up to which the ray is right
    """

    pixels: NDArray[np.int32]
    table: Doubles
    T_world_camera: Doubles
    start: Floats
    depth: Floats
    total: Floats
    status: NDArray[np.uint8]
    iterations: NDArray[np.uint8]
    marched: NDArray[np.int32]

    @property
    def converged(self) -> NDArray[np.bool_]:
        """Return which rays have found their maximum, (n,)."""
        return np.equal(self.status, Status.CONVERGED)

    @property
    def origin(self) -> Doubles:
        """Return where the rays begin, (3,) float64, world, metres."""
        return self.T_world_camera[:3, 3].copy()

    def directions(self, which: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Doubles:
        """Return (n, 3) float64, world, of the length that makes the distance the depth."""
        ab = self.table.reshape(-1, 2)[self.pixels[which]]
        R = self.T_world_camera[:3, :3]
        return np.ascontiguousarray(ab @ R[:, :2].T + R[:, 2])

    def points(self, which: slice | NDArray[np.bool_] | NDArray[np.int64]) -> Doubles:
        """Return the points found on some rays, (n, 3) float64, world, metres."""
        found = self.depth[which].astype(np.float64)[:, None]
        return self.origin + found * self.directions(which)


def rays_of(
    density: Density, view: View, stride: int, start: str, pool: Executor | None = None
) -> Rays:
    """
    Make the rays of a view's valid pixels, at their starts.

    :param stride: every stride-th pixel of every stride-th row
    :param start: robust or observed
    """
    camera = view.camera
    valid = np.isfinite(view.depth) & np.isfinite(camera.rays[..., 0])
    grid = np.zeros_like(valid)
    grid[::stride, ::stride] = True
    pixels = np.flatnonzero(valid & grid).astype(np.int32)
    n = len(pixels)
    depth = np.ascontiguousarray(view.depth, np.float32).ravel()
    starts = depth[pixels]
    if start == 'robust' and n:
        weights = Weights.of(density.pixel_bandwidth)
        image = warped(view, Scale.of(*density.bandwidth, float(starts.max())), weights)
        _over_chunks(
            pool, n, lambda part: robust_starts(
                image, weights, camera.width, depth, pixels[part], starts[part]))
    return Rays(
        pixels, camera.rays, np.array(view.T_world_camera, np.float64), starts, starts.copy(),
        np.zeros(n, np.float32), np.zeros(n, np.uint8), np.zeros(n, np.uint8),
        np.full(n, -1, np.int32))


def march(
    density: Density, rays: Rays, which: NDArray[np.int64], pool: Executor | None = None
) -> None:
    """
    Climb to the maximum on some rays, each from its start.

    :param which: (n,) int64, indices of rays
    :param pool: where to do it; None: in this thread
    """
    _over_chunks(
        pool, len(which), lambda part: _march(
            density.state, density.bandwidth, which[part], rays.pixels, rays.table,
            rays.T_world_camera, rays.start, rays.depth, rays.total, rays.status,
            rays.iterations))
    rays.marched[which] = density.change


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
    _over_chunks(
        pool, len(marched), lambda chunk: _changed(
            density.state, density.bandwidth, pixels[chunk], rays.table, rays.T_world_camera,
            starts[chunk], marched[chunk], changed[chunk]))
    rays.marched[part] = np.where(changed, marched, density.change)
    return np.flatnonzero(changed) + (part.start or 0)


def watched_blocks(
    density: VoxelDensity, rays: Rays, pool: Executor | None = None
) -> NDArray[np.int32]:
    """Return the lattice's blocks that the rays' search intervals need, each once."""
    keys: list[NDArray[np.int64]] = []
    for begin in range(0, len(rays.pixels), 16 * _CHUNK):
        part = slice(begin, begin + 16 * _CHUNK)
        start = rays.start[part].astype(np.float64)
        reach = INTERVAL * density.h3(start)
        keys.append(keys_along(
            density.state, rays.origin, rays.directions(part), start - reach, start + reach))
    return density.cover(np.concatenate(keys) if keys else np.zeros(0, np.int64))


def _over_chunks(pool: Executor | None, count: int, task: Callable[[slice], None]) -> None:
    """Run task(slice) over all chunks; each ray is its own, so any split gives the same bits."""
    parts = [slice(i, min(i + _CHUNK, count)) for i in range(0, count, _CHUNK)]
    if pool is None:
        for part in parts:
            task(part)
    else:
        for done in [pool.submit(task, part) for part in parts]:
            done.result()


# What the kernels below ask of a density; numba chooses by the type of its state.


def _new_scratch(state: Any) -> Any:
    """Make one thread's scratch arrays."""
    raise NotImplementedError


def _prepare(state: Any, scratch: Any, origin: Any, direction: Any, low: Any, high: Any) -> Any:
    """Get ready for a piece of a line."""
    raise NotImplementedError


def _jet(state: Any, scratch: Any, origin: Any, direction: Any, distance: Any, h3: Any) -> Any:
    """Return C f, C f', C f'', and g such that f'/g is the mean-shift step."""
    raise NotImplementedError


def _changed_since(
    state: Any, scratch: Any, origin: Any, direction: Any, low: Any, high: Any, change: Any
) -> Any:
    """Tell whether the density on a piece of a line changed after a change."""
    raise NotImplementedError


def _kind(state: Any) -> Any:
    """Return the module that implements the density of a state's numba type."""
    return {
        exact_density.ViewSum: exact_density, voxel_density.Lattice: voxel_density,
    }[state.instance_class]


@overload(_new_scratch)
def _(state):  # type: ignore[no-untyped-def]
    of_kind = _kind(state).new_scratch
    return lambda state: of_kind(state)


@overload(_prepare)
def _(state, scratch, origin, direction, low, high):  # type: ignore[no-untyped-def]
    of_kind = _kind(state).prepare
    return lambda state, scratch, origin, direction, low, high: of_kind(
        state, scratch, origin, direction, low, high)


@overload(_jet)
def _(state, scratch, origin, direction, distance, h3):  # type: ignore[no-untyped-def]
    of_kind = _kind(state).jet_along
    return lambda state, scratch, origin, direction, distance, h3: of_kind(
        state, scratch, origin, direction, distance, h3)


@overload(_changed_since)
def _(state, scratch, origin, direction, low, high, change):  # type: ignore[no-untyped-def]
    of_kind = _kind(state).changed_since
    return lambda state, scratch, origin, direction, low, high, change: of_kind(
        state, scratch, origin, direction, low, high, change)


@njit(cache=True, nogil=True)
def _h3(bandwidth: tuple[float, float, float], depth: float) -> float:
    return max(bandwidth[0] + bandwidth[1] * depth * depth, bandwidth[2])


@njit(cache=True, nogil=True)
def _aim(table: Doubles, T_world_camera: Doubles, pixel: int, direction: Doubles) -> None:
    """Write the world direction of a pixel's ray."""
    v, u = divmod(pixel, table.shape[1])
    a, b = table[v, u, 0], table[v, u, 1]
    for n in range(3):
        direction[n] = (
            a * T_world_camera[n, 0] + b * T_world_camera[n, 1] + T_world_camera[n, 2])


@njit(cache=True, nogil=True, error_model='numpy')
def _march(
    state: Any, bandwidth: tuple[float, float, float], chosen: NDArray[np.int64],
    pixels: NDArray[np.int32], table: Doubles, T_world_camera: Doubles, starts: Floats,
    depths: Floats, totals: Floats, statuses: NDArray[np.uint8], counts: NDArray[np.uint8],
) -> None:
    scratch = _new_scratch(state)
    origin = T_world_camera[:3, 3].copy()
    direction = np.zeros(3)
    for i in chosen:
        _aim(table, T_world_camera, pixels[i], direction)
        start = float(starts[i])
        h3 = _h3(bandwidth, start)
        low, high = start - INTERVAL * h3, start + INTERVAL * h3
        _prepare(state, scratch, origin, direction, low, high)
        beta = start
        f, f1, f2, g = _jet(state, scratch, origin, direction, beta, h3)
        count = 1
        status = Status.ITERATION_LIMIT if f > 0 else Status.NO_SUPPORT
        stretch = 0.5  # mean-shift steps in a row grow: between two humps they are tiny
        while f > 0 and count < MAX_ITERATIONS:
            newton = f2 < 0
            stretch = 0.5 if newton else 2.0 * stretch
            step = -f1 / f2 if newton else stretch * f1 / g
            if newton and abs(step) <= _TOLERANCE * h3 and low <= beta + step <= high:
                beta += step
                f += 0.5 * f1 * step
                status = Status.CONVERGED
                break
            step = min(max(step, -h3), h3)
            target = min(max(beta + step, low), high)
            if target == beta:
                status = Status.LEFT_INTERVAL
                break
            t, t1, t2, tg = _jet(state, scratch, origin, direction, target, h3)
            count += 1
            if t < f:
                # too far: the plain mean-shift step climbs
                stretch = 0.5
                step = min(max(f1 / g, -h3), h3)
                target = min(max(beta + step, low), high)
                t, t1, t2, tg = _jet(state, scratch, origin, direction, target, h3)
                count += 1
            beta, f, f1, f2, g = target, t, t1, t2, tg
        depths[i] = beta
        totals[i] = f
        statuses[i] = status
        counts[i] = count


@njit(cache=True, nogil=True)
def _changed(
    state: Any, bandwidth: tuple[float, float, float], pixels: NDArray[np.int32],
    table: Doubles, T_world_camera: Doubles, starts: Floats, marched: NDArray[np.int32],
    out: NDArray[np.bool_],
) -> None:
    scratch = _new_scratch(state)
    origin = T_world_camera[:3, 3].copy()
    direction = np.zeros(3)
    for i in range(len(pixels)):
        _aim(table, T_world_camera, pixels[i], direction)
        start = float(starts[i])
        reach = INTERVAL * _h3(bandwidth, start)
        out[i] = marched[i] < 0 or _changed_since(
            state, scratch, origin, direction, start - reach, start + reach, marched[i])
