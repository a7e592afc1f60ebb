# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How far to trust a maximum: its standard deviation along the ray, and a confidence from 0 to 1.

A Gaussian sum's maximum is as sharp as its width sqrt(-f / f'') says, and the surer the more views
have a part in it. How these go together was fitted to simulated scans; docs/method.md says how.
"""
from __future__ import annotations

from math import pi, sqrt

from numba import njit
import numpy as np
from numpy.typing import NDArray

from .camera import project_jet
from .climb import h3_at
from .exact_density import ViewSum
from .ray_march import Density, Rays
from .voxel_density import VoxelDensity

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

_SEEN = 4.0  # bandwidths between a point and its pixel's depth at which it counts as seen
# sigma / h3 = _SCALE (width / h3)^_WIDTH agreement^_AGREEMENT views^_VIEWS, at h1 = _FITTED_AT
_SCALE, _WIDTH, _AGREEMENT, _VIEWS = 0.18, 1.45, -1.32, -0.7
_FITTED_AT = 1.5  # px


def deviations(density: Density, rays: Rays, which: NDArray[np.int64]) -> Floats:
    """
    Return the standard deviations of maxima along their rays.

    :param which: (n,) int64, indices of rays that have found their maximum
    :return: float32, metres of depth; infinite where the density is not curved downwards
    """
    f = rays.total[which] / max(density.size, 1)
    f2 = rays.curvature[which] / max(density.size, 1)
    h3 = density.h3(rays.depth[which]).astype(np.float32)
    width = np.sqrt(np.divide(-f, f2, out=np.full_like(f, np.inf), where=f2 < 0)) / h3
    pixels = rays.table.shape[0] * rays.table.shape[1]
    # a view's share where it sees a plane that faces it
    share = 1.0 / (sqrt(2 * pi) * max(density.size, 1) * pixels * h3)
    peak = _expected_peak(density, rays.points(which)).astype(np.float32)
    views = np.maximum(peak / share, 1.0)
    agreement = f / (share * views)
    with np.errstate(divide='ignore', invalid='ignore'):
        sigma = h3 * _SCALE * _FITTED_AT / density.pixel_bandwidth * (
            width ** _WIDTH * agreement ** _AGREEMENT * views ** _VIEWS)
    return np.where(sigma >= 0, sigma, np.inf).astype(np.float32)


def confidences(sigma: Floats, h3: Doubles) -> Floats:
    """
    Return standard deviations as confidences: 1 is certain, 1/2 a deviation of h3.

    :param sigma: (n,) metres
    :param h3: (n,) bandwidths along the depth there, metres
    """
    return (1.0 / (1.0 + sigma / h3)).astype(np.float32)


def _expected_peak(density: Density, points: Doubles) -> Doubles:
    """Return the likelihood of planes that face the views which see the points, (n,)."""
    if isinstance(density, VoxelDensity):
        return density.expected_peak(points)
    out = np.zeros(len(points))
    _sum_expected(density.state, density.bandwidth, points, out)
    return out / max(density.size, 1)


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
            if abs(depth - z) <= _SEEN * h3:
                out[i] += 1.0 / (sqrt(2 * pi) * h3 * width * height)
