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

from numba import njit
import numpy as np
from numpy.typing import NDArray

from .exact_density import Doubles, ExactDensity, jet_along, new_scratch, sees, Views
from .kernel import axis_weights, Floats, INVALID_DEPTH, Window, window_value
from .view import View

INTERVAL = 4.0  # h3; the search goes this far from the start
MAX_ITERATIONS = 50
_TOLERANCE = 0.02  # h3; a Newton step this short is the last, and good to its cube
_OUTLIER = 0.2  # an observed depth with less than this share of its window's best density is one
_NEIGHBOURS = 2  # px; the window of the robust start is 5 x 5
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
    :param direction: (n, 3) float64, world, of the length that makes the distance the depth
    :param origin: (3,) float64, world, metres
    :param start: (n,) float32, metres
    :param depth: (n,) float32, metres: the maximum where converged
    :param total: (n,) float32: C times the likelihood there
    :param status: (n,) uint8, Status
    :param iterations: (n,) uint8: evaluations of the density
    """

    pixels: NDArray[np.int32]
    origin: Doubles
    direction: Doubles
    start: Floats
    depth: Floats
    total: Floats
    status: NDArray[np.uint8]
    iterations: NDArray[np.uint8]

    @property
    def converged(self) -> NDArray[np.bool_]:
        """Return which rays have found their maximum, (n,)."""
        return np.equal(self.status, Status.CONVERGED)


def rays_of(
    density: ExactDensity, index: int, view: View, stride: int, start: str,
    pool: Executor | None = None,
) -> Rays:
    """
    Make the rays of a view's valid pixels, at their starts.

    :param index: of the view in the density
    :param stride: every stride-th pixel of every stride-th row
    :param start: robust or observed
    """
    camera = view.camera
    valid = np.isfinite(view.depth) & np.isfinite(camera.rays[..., 0])
    grid = np.zeros_like(valid)
    grid[::stride, ::stride] = True
    pixels = np.flatnonzero(valid & grid).astype(np.int32)
    ab = camera.rays.reshape(-1, 2)[pixels]
    T = np.asarray(view.T_world_camera, np.float64)
    direction = np.ascontiguousarray(
        np.column_stack([ab, np.ones(len(ab))]) @ T[:3, :3].T)
    n = len(pixels)
    starts = view.depth.ravel()[pixels].astype(np.float32)
    if start == 'robust':
        _over_chunks(
            pool, n, lambda part: _robust_starts(
                density.views, density.window, index, pixels[part], starts[part]))
    return Rays(
        pixels, T[:3, 3].copy(), direction, starts, starts.copy(), np.zeros(n, np.float32),
        np.zeros(n, np.uint8), np.zeros(n, np.uint8))


def march(
    density: ExactDensity, rays: Rays, which: NDArray[np.bool_], pool: Executor | None = None
) -> int:
    """
    Climb to the maximum on some rays, each from its start.

    :param which: (n,) bool
    :param pool: where to do it; None: in this thread
    :return: how many rays were marched
    """
    chosen = np.flatnonzero(which).astype(np.int64)
    _over_chunks(
        pool, len(chosen), lambda part: _march(
            density.views, density.window, density.depth_bandwidth,
            density.depth_bandwidth_quadratic, chosen[part], rays.origin, rays.direction,
            rays.start, rays.depth, rays.total, rays.status, rays.iterations))
    return len(chosen)


def affected(
    density: ExactDensity, rays: Rays, index: int, pool: Executor | None = None
) -> NDArray[np.bool_]:
    """
    Tell which rays have a new view's support within their search interval.

    :param index: of the new view in the density
    :return: (n,) bool
    """
    out = np.zeros(len(rays.pixels), np.bool_)
    _over_chunks(
        pool, len(out), lambda part: _affected(
            density.views, density.window, density.depth_bandwidth,
            density.depth_bandwidth_quadratic, index, rays.origin, rays.direction[part],
            rays.start[part], out[part]))
    return out


def _over_chunks(pool: Executor | None, count: int, task: Callable[[slice], None]) -> None:
    """Run task(slice) over all chunks; each ray is its own, so any split gives the same bits."""
    parts = [slice(i, min(i + _CHUNK, count)) for i in range(0, count, _CHUNK)]
    if pool is None:
        for part in parts:
            task(part)
    else:
        for done in [pool.submit(task, part) for part in parts]:
            done.result()


@njit(cache=True, nogil=True)
def _bandwidth(constant: float, quadratic: float, depth: float) -> float:
    return constant + quadratic * depth * depth


@njit(cache=True, nogil=True)
def _march(
    views: Views, window: Window, constant: float, quadratic: float,
    chosen: NDArray[np.int64], origin: Doubles, directions: Doubles, starts: Floats,
    depths: Floats, totals: Floats, statuses: NDArray[np.uint8], counts: NDArray[np.uint8],
) -> None:
    scratch = new_scratch(window, views)
    for i in chosen:
        direction = directions[i]
        start = float(starts[i])
        h3 = _bandwidth(constant, quadratic, start)
        low, high = start - INTERVAL * h3, start + INTERVAL * h3
        nearby = 0
        for c in range(views.size):
            if sees(views, window, c, origin, direction, low, high):
                scratch.nearby[nearby] = c
                nearby += 1
        beta = start
        f, f1, f2, g = jet_along(
            views, window, scratch, nearby, origin, direction, beta, h3)
        count = 1
        status = Status.ITERATION_LIMIT if f > 0 else Status.NO_SUPPORT
        stretch = 0.5  # mean-shift steps in a row grow: between two humps they are tiny
        while f > 0 and count < MAX_ITERATIONS:
            newton = f2 < 0
            stretch = 1.0 if newton else 2.0 * stretch
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
            t, t1, t2, tg = jet_along(
                views, window, scratch, nearby, origin, direction, target, h3)
            count += 1
            if t < f:
                # too far: the plain mean-shift step climbs
                stretch = 0.5
                step = min(max(f1 / g, -h3), h3)
                target = min(max(beta + step, low), high)
                t, t1, t2, tg = jet_along(
                    views, window, scratch, nearby, origin, direction, target, h3)
                count += 1
            beta, f, f1, f2, g = target, t, t1, t2, tg
        depths[i] = beta
        totals[i] = f
        statuses[i] = status
        counts[i] = count


@njit(cache=True, nogil=True)
def _affected(
    views: Views, window: Window, constant: float, quadratic: float, index: int,
    origin: Doubles, directions: Doubles, starts: Floats, out: NDArray[np.bool_],
) -> None:
    for i in range(len(starts)):
        start = float(starts[i])
        reach = INTERVAL * _bandwidth(constant, quadratic, start)
        out[i] = sees(
            views, window, index, origin, directions[i], start - reach, start + reach)


@njit(cache=True, nogil=True)
def _robust_starts(
    views: Views, window: Window, index: int, pixels: NDArray[np.int32], starts: Floats
) -> None:
    """
    Replace observed depths that their own image contradicts.

    The candidates are the depths of the 5 x 5 neighbours; each is weighed by the view's own
    density on the ray there, without the kernel of the pixel that proposes it.
    """
    scratch = new_scratch(window, views)
    stride, before, width = (
        views.layout[index, 1], views.layout[index, 4], views.layout[index, 5])
    column = axis_weights(window, 0.0, 0.0, 0.0, scratch.columns)
    axis_weights(window, 0.0, 0.0, 0.0, scratch.rows)
    side = -column
    depth, precision = views.depth, views.precision
    for n in range(len(pixels)):
        v, u = divmod(pixels[n], width)
        centre = views.layout[index, 0] + (v + before) * stride + u + before
        first = centre + column * stride + column
        observed = window_value(
            depth, precision, first, stride, window, depth[centre],
            scratch.columns, scratch.rows, scratch.sums) - precision[centre]
        best, best_depth = observed, depth[centre]
        # no depth can have more than all kernels at their peaks: most pixels need no search
        bound = 0.0
        for row in range(-side, side + 1):
            line = 0.0
            for a in range(-side, side + 1):
                line += scratch.columns[0, a + side] * precision[centre + row * stride + a]
            bound += scratch.rows[0, row + side] * line
        if observed < _OUTLIER * bound:
            for row in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
                for a in range(-_NEIGHBOURS, _NEIGHBOURS + 1):
                    pixel = centre + row * stride + a
                    if depth[pixel] == INVALID_DEPTH or pixel == centre:
                        continue
                    share = window_value(
                        depth, precision, first, stride, window, depth[pixel],
                        scratch.columns, scratch.rows, scratch.sums)
                    share -= (
                        scratch.rows[0, row + side] * scratch.columns[0, a + side]
                        * precision[pixel])
                    if share > best:
                        best, best_depth = share, depth[pixel]
            if observed < _OUTLIER * best:
                starts[n] = best_depth
