# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What is asked of the sum over views: values, derivatives along rays, maxima; without the 1/C."""
from __future__ import annotations

from math import pi, sqrt
from typing import NamedTuple

from numba import njit
import numpy as np
from numpy.typing import NDArray

from .camera import project_jet
from .climb import aim, climb, CLIMBER, h3_at, INTERVAL, SEEN, set_out
from .kernel import axis_weights, Floats, Window, window_jet, window_value

Doubles = NDArray[np.float64]

CELL = 8  # px; side of the squares whose depth range culls


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
        views.layout[c, 2] + (int(v + whole) // CELL) * views.layout[c, 3]
        + int(u + whole) // CELL)
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
    row0 = int(max(top, -reach) + whole) // CELL
    row1 = int(min(bottom, height - 1 + reach) + whole) // CELL
    column0 = int(max(left, -reach) + whole) // CELL
    column1 = int(min(right, width - 1 + reach) + whole) // CELL
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
def values(state: ViewSum, points: Doubles, out: Doubles) -> None:
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
def sum_expected(
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
def jets(
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
