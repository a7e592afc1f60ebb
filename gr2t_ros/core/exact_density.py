# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The density as the sum over its views, evaluated when asked: the reference of all other ways.

    lik(Theta) = 1/C sum_c 1/N_c sum_i p(u_i - U, v_i - V, z_i - Z)        (Grogan & Dahyot 2014)

Kernels end at 4 bandwidths. The kernels below leave out the 1/C, so that what does not see a new
view does not change; ExactDensity puts it in.
"""
from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Executor
from math import ceil, pi, sqrt
from typing import Any, NamedTuple

from numba import njit
import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .camera import project_jet
from .climb import aim, climb, CLIMBER, h3_at, INTERVAL, SEEN, set_out
from .compiled import run_all
from .kernel import (
    axis_weights,
    Floats,
    INVALID_DEPTH,
    RESIDUAL_SCALE,
    Window,
    window_jet,
    window_value,
)
from .view import View

Doubles = NDArray[np.float64]

TRUNCATION = 4.0  # bandwidths
_CELL = 8  # px; side of the squares whose depth range culls
_CHUNK = 4096  # points a task


class Views(NamedTuple):
    """
    The views as the kernels read them.

    :param size: number of views; the arrays may be longer
    :param T_camera_world: (c, 3, 4)
    :param camera: (c, 14) Camera.parameters
    :param layout: (c, 7): first pixel of the padded image, its row stride, first cell, cells in a
        row, padding, width, height
    :param factor: (c,) what turns a window sum into the view's share of C lik
    :param depth: flat padded images, metres; precision: RESIDUAL_SCALE / h3, 1/m
    :param near: flat cells: least depth at which one of the window's kernels counts; far: largest
    """

    size: int
    T_camera_world: Doubles
    camera: Doubles
    layout: NDArray[np.int64]
    factor: Doubles
    depth: Floats
    precision: Floats
    near: Doubles
    far: Doubles


class ViewSum(NamedTuple):
    """The density as the kernels evaluate it."""

    views: Views
    window: Window


class Scratch(NamedTuple):
    """
    What one thread writes while it sums; made by new_scratch.

    :param nearby: how many views count on the line at hand, then which
    """

    columns: Floats
    rows: Floats
    sums: Floats
    nearby: NDArray[np.int64]


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
            width + before + self.window.lanes, before, (width + 2 * reach) // _CELL + 1,
            height + before + self.window.lanes, (height + 2 * reach) // _CELL + 1)

    def likelihood(self, points: Doubles, pool: Executor | None = None) -> Doubles:
        """
        Evaluate the likelihood at points.

        :param points: (n, 3) float64, world, metres
        :param pool: where to do it; None: in this thread
        :return: (n,) float64, 1 / (px^2 m)
        """
        points = np.ascontiguousarray(points, np.float64)
        out = np.zeros(len(points))
        run_all(pool, _values, [
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
        _sum_expected(self.state, self.bandwidth, points, out)
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
        jets = _jets(
            self.state, np.ascontiguousarray(origins, np.float64),
            np.ascontiguousarray(directions, np.float64),
            np.ascontiguousarray(distances, np.float64)) / max(self._views.size, 1)
        return jets[:, 0], jets[:, 1], jets[:, 2]


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
            top = j * _CELL - 2 * reach + before
            left = i * _CELL - 2 * reach + before
            for row in range(max(top, 0), min(top + _CELL + 2 * reach + 1, depth.shape[0])):
                for column in range(
                        max(left, 0), min(left + _CELL + 2 * reach + 1, depth.shape[1])):
                    z = depth[row, column]
                    if z < INVALID_DEPTH:
                        half = 1.00001 * width / precision[row, column] + 1e-6
                        near[j, i] = min(near[j, i], z - half)
                        far[j, i] = max(far[j, i], z + half)
    return near, far


@njit(cache=True, nogil=True)
def new_scratch(state: ViewSum) -> Scratch:
    """Make one thread's scratch arrays."""
    lanes = state.window.lanes
    return Scratch(
        np.zeros((3, lanes), np.float32), np.zeros((3, lanes), np.float32),
        np.zeros(3 * lanes, np.float32), np.zeros(1 + state.views.size, np.int64))


@njit(cache=True, nogil=True)
def _camera_line(
    views: Views, c: int, origin: Doubles, direction: Doubles, distance: float
) -> tuple[float, float, float, float, float, float]:
    """Return x, x', y, y', z, z' of a point on a world line in view c's camera frame."""
    T = views.T_camera_world
    px = origin[0] + distance * direction[0]
    py = origin[1] + distance * direction[1]
    pz = origin[2] + distance * direction[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    return (
        T[c, 0, 0] * px + T[c, 0, 1] * py + T[c, 0, 2] * pz + T[c, 0, 3],
        T[c, 0, 0] * dx + T[c, 0, 1] * dy + T[c, 0, 2] * dz,
        T[c, 1, 0] * px + T[c, 1, 1] * py + T[c, 1, 2] * pz + T[c, 1, 3],
        T[c, 1, 0] * dx + T[c, 1, 1] * dy + T[c, 1, 2] * dz,
        T[c, 2, 0] * px + T[c, 2, 1] * py + T[c, 2, 2] * pz + T[c, 2, 3],
        T[c, 2, 0] * dx + T[c, 2, 1] * dy + T[c, 2, 2] * dz)


@njit(cache=True, nogil=True)
def _supported(
    views: Views, window: Window, c: int, u: float, v: float, z: float
) -> bool:
    """Tell whether view c has pixels whose kernels may reach (u, v, z)."""
    reach = window.reach
    width, height = views.layout[c, 5], views.layout[c, 6]
    if not (-reach <= u <= width - 1 + reach and -reach <= v <= height - 1 + reach):
        return False
    whole = int(np.ceil(reach))
    cell = (
        views.layout[c, 2] + (int(v + whole) // _CELL) * views.layout[c, 3]
        + int(u + whole) // _CELL)
    return bool(views.near[cell] <= z <= views.far[cell])


@njit(cache=True, nogil=True)
def _prepare(
    state: ViewSum, scratch: Scratch, origin: Doubles, direction: Doubles,
    low: float, high: float,
) -> None:
    """Note the views that may have a share of the density on a piece of a line."""
    count = 0
    for c in range(state.views.size):
        if _sees(state.views, state.window, c, origin, direction, low, high):
            count += 1
            scratch.nearby[count] = c
    scratch.nearby[0] = count


@njit(cache=True, nogil=True)
def _changed_since(
    state: ViewSum, origin: Doubles, direction: Doubles, low: float, high: float, change: int
) -> bool:
    """Tell whether a view added after a change may have a share on a piece of a line."""
    for c in range(change, state.views.size):
        if _sees(state.views, state.window, c, origin, direction, low, high):
            return True
    return False


@njit(cache=True, nogil=True)
def _sees(
    views: Views, window: Window, c: int, origin: Doubles, direction: Doubles,
    low: float, high: float,
) -> bool:
    """Tell whether view c may have a share of the density on a piece of a line; never misses."""
    x, x1, y, y1, z, z1 = _camera_line(views, c, origin, direction, low)
    seen_a, u_a, _, _, v_a, _, _ = project_jet(views.camera[c], x, x1, y, y1, z, z1)
    z_a = z
    x, x1, y, y1, z, z1 = _camera_line(views, c, origin, direction, high)
    seen_b, u_b, _, _, v_b, _, _ = project_jet(views.camera[c], x, x1, y, y1, z, z1)
    if not (seen_a and seen_b):
        return seen_a or seen_b
    # half a pixel for the bend of a distorted line, which is far smaller over a few bandwidths
    reach = window.reach
    left, right = min(u_a, u_b) - 0.5, max(u_a, u_b) + 0.5
    top, bottom = min(v_a, v_b) - 0.5, max(v_a, v_b) + 0.5
    width, height = views.layout[c, 5], views.layout[c, 6]
    if (right < -reach or left > width - 1 + reach
            or bottom < -reach or top > height - 1 + reach):
        return False
    whole = int(np.ceil(reach))
    near, far = min(z_a, z), max(z_a, z)
    row0 = int(max(top, -reach) + whole) // _CELL
    row1 = int(min(bottom, height - 1 + reach) + whole) // _CELL
    column0 = int(max(left, -reach) + whole) // _CELL
    column1 = int(min(right, width - 1 + reach) + whole) // _CELL
    for row in range(row0, row1 + 1):
        for column in range(column0, column1 + 1):
            cell = views.layout[c, 2] + row * views.layout[c, 3] + column
            if views.near[cell] <= far and near <= views.far[cell]:
                return True
    return False


@njit(cache=True, nogil=True)
def jet_along(
    state: ViewSum, scratch: Scratch, origin: Doubles, direction: Doubles, distance: float,
    h3: float,
) -> tuple[float, float, float, float]:
    """
    Sum the prepared views' density and its derivatives at a point of a world line.

    :param h3: bandwidth along the depth there, metres
    :return: C f, C f', C f'', and g such that f'/g is the mean-shift step
    """
    f, f1, f2, g = 0.0, 0.0, 0.0, 0.0
    views, window = state.views, state.window
    for n in range(scratch.nearby[0]):
        c = scratch.nearby[n + 1]
        x, x1, y, y1, z, z1 = _camera_line(views, c, origin, direction, distance)
        seen, u, u1, u2, v, v1, v2 = project_jet(views.camera[c], x, x1, y, y1, z, z1)
        if not seen or not _supported(views, window, c, u, v, z):
            continue
        column = axis_weights(window, u, u1, u2, scratch.columns)
        row = axis_weights(window, v, v1, v2, scratch.rows)
        stride, before = views.layout[c, 1], views.layout[c, 4]
        first = views.layout[c, 0] + (row + before) * stride + column + before
        w, w1, w2 = window_jet(
            views.depth, views.precision, first, stride, window, z, z1,
            scratch.columns, scratch.rows, scratch.sums)
        factor = views.factor[c]
        f += factor * w
        f1 += factor * w1
        f2 += factor * w2
        h1 = window.bandwidth
        g += factor * w * ((u1 * u1 + v1 * v1) / (h1 * h1) + z1 * z1 / (h3 * h3))
    return f, f1, f2, g


@njit(cache=True, nogil=True)
def _values(state: ViewSum, points: Doubles, out: Doubles) -> None:
    """Write C f at world points (n, 3) to out (n,)."""
    scratch = new_scratch(state)
    views, window = state.views, state.window
    still = np.zeros(3)
    for i in range(len(points)):
        total = 0.0
        for c in range(views.size):
            x, _, y, _, z, _ = _camera_line(views, c, points[i], still, 0.0)
            seen, u, _, _, v, _, _ = project_jet(views.camera[c], x, 0.0, y, 0.0, z, 0.0)
            if not seen or not _supported(views, window, c, u, v, z):
                continue
            column = axis_weights(window, u, 0.0, 0.0, scratch.columns)
            row = axis_weights(window, v, 0.0, 0.0, scratch.rows)
            stride, before = views.layout[c, 1], views.layout[c, 4]
            first = views.layout[c, 0] + (row + before) * stride + column + before
            total += views.factor[c] * window_value(
                views.depth, views.precision, first, stride, window, z,
                scratch.columns, scratch.rows, scratch.sums)
        out[i] = total


@njit(cache=True, nogil=True)
def _sum_expected(
    state: ViewSum, bandwidth: tuple[float, float, float], points: Doubles, out: Doubles
) -> None:
    """Add up 1 / (N_c sqrt(2 pi) h3) over the views that see each point."""
    views = state.views
    for i in range(len(points)):
        for c in range(views.size):
            T = views.T_camera_world[c]
            x = T[0, 0] * points[i, 0] + T[0, 1] * points[i, 1] + T[0, 2] * points[i, 2] + T[0, 3]
            y = T[1, 0] * points[i, 0] + T[1, 1] * points[i, 1] + T[1, 2] * points[i, 2] + T[1, 3]
            z = T[2, 0] * points[i, 0] + T[2, 1] * points[i, 1] + T[2, 2] * points[i, 2] + T[2, 3]
            seen, u, _, _, v, _, _ = project_jet(views.camera[c], x, 0.0, y, 0.0, z, 0.0)
            width, height = views.layout[c, 5], views.layout[c, 6]
            if not (seen and -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5):
                continue
            row = int(v + 0.5) + views.layout[c, 4]
            column = int(u + 0.5) + views.layout[c, 4]
            h3 = h3_at(bandwidth, z)
            depth = views.depth[views.layout[c, 0] + row * views.layout[c, 1] + column]
            if abs(depth - z) <= SEEN * h3:
                out[i] += 1.0 / (sqrt(2 * pi) * h3 * width * height)


@njit(cache=True, nogil=True)
def _jets(
    state: ViewSum, origins: Doubles, directions: Doubles, distances: Doubles
) -> Doubles:
    scratch = new_scratch(state)
    out = np.zeros((len(origins), 3))
    scratch.nearby[0] = state.views.size
    for c in range(state.views.size):
        scratch.nearby[c + 1] = c
    for i in range(len(origins)):
        f, f1, f2, _ = jet_along(
            state, scratch, origins[i], directions[i], distances[i], 1.0)
        out[i, 0], out[i, 1], out[i, 2] = f, f1, f2
    return out


@njit(cache=True, nogil=True, error_model='numpy')
def march_rays(
    state: ViewSum, bandwidth: tuple[float, float, float], chosen: NDArray[np.int64],
    pixels: NDArray[np.int32], table: Doubles, T_world_camera: Doubles, starts: Floats,
    depths: Floats, totals: Floats, curvatures: Floats, statuses: NDArray[np.uint8],
    counts: NDArray[np.uint8],
) -> None:
    """Climb from the starts of chosen rays; see ray_march.Rays for the arrays."""
    scratch = new_scratch(state)
    origin = T_world_camera[:3, 3].copy()
    direction = np.zeros(3)
    ray = np.zeros(1, CLIMBER)[0]
    for i in chosen:
        aim(table, T_world_camera, pixels[i], direction)
        start = np.float64(starts[i])
        h3 = h3_at(bandwidth, start)
        reach = INTERVAL * h3
        _prepare(state, scratch, origin, direction, start - reach, start + reach)
        set_out(ray, start, h3)
        while ray.status == 0:
            f, f1, f2, g = jet_along(state, scratch, origin, direction, ray.target, h3)
            climb(ray, f, f1, f2, g)
        depths[i] = ray.beta
        totals[i] = ray.value
        curvatures[i] = ray.second
        statuses[i] = ray.status
        counts[i] = ray.evaluations


@njit(cache=True, nogil=True)
def changed_rays(
    state: ViewSum, bandwidth: tuple[float, float, float], pixels: NDArray[np.int32],
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
