# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The density as the sum over its views, evaluated when asked: the reference of all other ways.

    lik(Theta) = 1/C sum_c 1/N_c sum_i p(u_i - U, v_i - V, z_i - Z)        (Grogan & Dahyot 2014)

Kernels end at 4 bandwidths. What exact_query computes leaves out the 1/C, so that what does not
see a new view does not change; ExactDensity puts it in.
"""
from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from math import ceil, pi
from typing import Any

from numba import njit
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .compiled import run_all
from .exact_query import CELL, jets, sum_expected, values, Views, ViewSum
from .kernel import Floats, INVALID_DEPTH, RESIDUAL_SCALE, Window
from .view import View

Doubles = NDArray[np.float64]

TRUNCATION = 4.0  # bandwidths
_CHUNK = 4096  # points a task


class ExactDensity:
    """
    The likelihood of world points given the views added so far.

    :param pixel_bandwidth: h1 = h2, pixels
    :param depth_bandwidth: h3 at depth 0, metres
    :param depth_bandwidth_quadratic: growth of h3 with the squared depth, 1/metres
    :param truncation: bandwidths at which a kernel ends
    :raises InputError: if a bandwidth is not positive
    """

    def __init__(
        self, pixel_bandwidth: float, depth_bandwidth: float,
        depth_bandwidth_quadratic: float = 0.0, truncation: float = TRUNCATION,
    ) -> None:
        if not (pixel_bandwidth > 0 and depth_bandwidth > 0 and depth_bandwidth_quadratic >= 0):
            raise InputError('bandwidths must be positive')
        # h3(z) = max(constant + quadratic z^2, floor)
        self.bandwidth = (float(depth_bandwidth), float(depth_bandwidth_quadratic), 0.0)
        self.truncation = truncation
        self.pixel_bandwidth = float(pixel_bandwidth)
        self.window = Window.of(pixel_bandwidth, truncation)
        self._views = Views(
            0, np.zeros((1, 3, 4)), np.zeros((1, 14)), np.zeros((1, 7), np.int64), np.zeros(1),
            np.zeros(1, np.float32), np.zeros(1, np.float32), np.zeros(1), np.zeros(1))
        self._pixels = 0
        self._cells = 0

    @property
    def state(self) -> ViewSum:
        """Return what the kernels need."""
        return ViewSum(self._views, self.window)

    @property
    def size(self) -> int:
        """Return the number of views added so far."""
        return self._views.size

    @property
    def change(self) -> int:
        """Return the number of the last change: rays marched before it may be stale."""
        return self._views.size

    def h3(self, depth: Doubles | Floats) -> Doubles:
        """Return the bandwidth along the depth, metres, at depths in metres."""
        constant, quadratic, _ = self.bandwidth
        return constant + quadratic * np.asarray(depth, np.float64) ** 2

    def add(self, view: View, pool: Executor | None = None) -> None:
        """Add a view's kernels."""
        width, height = view.camera.width, view.camera.height
        stride, before, cells_wide, rows, cells_high = self._padding(width, height)
        depth = np.full((rows, stride), INVALID_DEPTH)
        inside = (slice(before, before + height), slice(before, before + width))
        seen = np.isfinite(view.depth) & np.isfinite(view.camera.rays[..., 0])
        depth[inside] = np.where(seen, view.depth, INVALID_DEPTH)
        precision = np.zeros_like(depth)
        precision[inside] = RESIDUAL_SCALE / self.h3(np.where(seen, view.depth, 0))

        near, far = _depth_ranges(
            depth, precision, before, ceil(self.window.reach), self.truncation * RESIDUAL_SCALE,
            cells_high, cells_wide)

        T_world_camera = np.asarray(view.T_world_camera, np.float64)
        R_camera_world = T_world_camera[:3, :3].T
        T_camera_world = np.column_stack(
            [R_camera_world, -R_camera_world @ T_world_camera[:3, 3]])
        h1 = self.window.bandwidth
        factor = 1.0 / (
            (2 * pi) ** 1.5 * h1 * h1 * RESIDUAL_SCALE * width * height)

        v, c = self._views, self._views.size
        layout = np.array(
            [self._pixels, stride, self._cells, cells_wide, before, width, height])
        self._views = Views(
            c + 1,
            _appended(v.T_camera_world, c, T_camera_world[None]),
            _appended(v.camera, c, view.camera.parameters[None]),
            _appended(v.layout, c, layout[None]),
            _appended(v.factor, c, np.array([factor])),
            _appended(v.depth, self._pixels, depth.ravel()),
            _appended(v.precision, self._pixels, precision.ravel()),
            _appended(v.near, self._cells, near.ravel()),
            _appended(v.far, self._cells, far.ravel()))
        self._pixels += depth.size
        self._cells += near.size

    def refresh(self, pool: Executor | None = None) -> None:
        """Do nothing: the sum is always up to date."""

    @property
    def used(self) -> dict[str, int]:
        """Return how much of each of the arrays of Views is in use."""
        return {
            **dict.fromkeys(('T_camera_world', 'camera', 'layout', 'factor'), self._views.size),
            **dict.fromkeys(('depth', 'precision'), self._pixels),
            **dict.fromkeys(('near', 'far'), self._cells)}

    def restore(self, views: int, arrays: Mapping[str, NDArray[Any]]) -> None:
        """
        Become what another density was when its arrays were saved.

        :param arrays: of Views, as far as they are in use
        :raises ValueError: if they do not fit each other
        """
        self._views = Views(views, **arrays)
        self._pixels, self._cells = len(arrays['depth']), len(arrays['near'])
        if {name: len(array) for name, array in arrays.items()} != self.used:
            raise ValueError('sizes of the views')
        pixels, cells = 0, 0
        for pixel, stride, cell, cells_wide, before, width, height in arrays['layout'].tolist():
            expected = self._padding(width, height)
            if width < 1 or height < 1 or (
                    pixel, cell, stride, before, cells_wide) != (pixels, cells, *expected[:3]):
                raise ValueError('layout of the views')
            pixels, cells = pixels + expected[3] * stride, cells + expected[4] * cells_wide
        if (pixels, cells) != (self._pixels, self._cells):
            raise ValueError('layout of the views')

    def merge(self, other: ExactDensity) -> None:
        """Add the views of another density with the same bandwidths, after those that are here."""
        ours, theirs = self._views, other.state.views
        layout = theirs.layout[:theirs.size].copy()
        layout[:, 0] += self._pixels
        layout[:, 2] += self._cells
        here = self.used
        self._views = Views(ours.size + theirs.size, **{
            name: _appended(
                getattr(ours, name), here[name],
                layout if name == 'layout' else getattr(theirs, name)[:count])
            for name, count in other.used.items()})
        self._pixels += other.used['depth']
        self._cells += other.used['near']

    def _padding(self, width: int, height: int) -> tuple[int, int, int, int, int]:
        """Return an image's row stride, padding, cells in a row, padded rows, rows of cells."""
        before, reach = ceil(2 * self.window.reach), ceil(self.window.reach)
        return (
            width + before + self.window.lanes, before, (width + 2 * reach) // CELL + 1,
            height + before + self.window.lanes, (height + 2 * reach) // CELL + 1)

    def likelihood(self, points: Doubles, pool: Executor | None = None) -> Doubles:
        """
        Evaluate the likelihood at points.

        :param points: (n, 3) float64, world, metres
        :param pool: where to do it; None: in this thread
        :return: (n,) float64, 1 / (px^2 m)
        """
        points = np.ascontiguousarray(points, np.float64)
        out = np.zeros(len(points))
        run_all(pool, values, [
            (self.state, points[i:i + _CHUNK], out[i:i + _CHUNK])
            for i in range(0, len(points), _CHUNK)])
        return out / max(self._views.size, 1)

    def expected_total(self, points: Doubles) -> Doubles:
        """
        Return C times the likelihood of a plane that faces the views which see a point.

        :param points: (n, 3) float64, world, metres
        :return: (n,) float64, 1 / (px^2 m); 0 where no view sees the point
        """
        out = np.zeros(len(points))
        sum_expected(self.state, self.bandwidth, points, out)
        return out

    def along(
        self, origins: Doubles, directions: Doubles, distances: Doubles
    ) -> tuple[Doubles, Doubles, Doubles]:
        """
        Evaluate the likelihood and its derivatives along lines.

        :param origins: (n, 3) float64, world, metres; directions likewise
        :param distances: (n,) float64, in units of the directions' lengths
        :return: f, f', f'', each (n,) float64; f in 1 / (px^2 m)
        """
        found = jets(
            self.state, np.ascontiguousarray(origins, np.float64),
            np.ascontiguousarray(directions, np.float64),
            np.ascontiguousarray(distances, np.float64)) / max(self._views.size, 1)
        return found[:, 0], found[:, 1], found[:, 2]


def _appended(array: NDArray[Any], used: int, more: NDArray[Any]) -> NDArray[Any]:
    """Return the array with more behind its used part, grown by doubling."""
    if used + len(more) > len(array):
        grown = np.zeros((max(2 * len(array), used + len(more)), *array.shape[1:]), array.dtype)
        grown[:used] = array[:used]
        array = grown
    array[used:used + len(more)] = more
    return array


@njit(cache=True, nogil=True)
def _depth_ranges(
    depth: Floats, precision: Floats, before: int, reach: int, width: float,
    cells_high: int, cells_wide: int,
) -> tuple[Doubles, Doubles]:
    """
    Return, for each cell, the depths between which its points' windows have support.

    Cell (j, i) holds the points whose U is in [8 i, 8 i + 8) - reach, and V likewise.
    """
    near = np.full((cells_high, cells_wide), np.inf)
    far = np.full((cells_high, cells_wide), -np.inf)
    for j in range(cells_high):
        for i in range(cells_wide):
            top = j * CELL - 2 * reach + before
            left = i * CELL - 2 * reach + before
            for row in range(max(top, 0), min(top + CELL + 2 * reach + 1, depth.shape[0])):
                for column in range(
                        max(left, 0), min(left + CELL + 2 * reach + 1, depth.shape[1])):
                    z = depth[row, column]
                    if z < INVALID_DEPTH:
                        half = 1.00001 * width / precision[row, column] + 1e-6
                        near[j, i] = min(near[j, i], z - half)
                        far[j, i] = max(far[j, i], z + half)
    return near, far
