# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How far to trust a maximum: its standard deviation along the ray, and a confidence from 0 to 1.

A Gaussian sum's maximum is as sharp as its width sqrt(-f / f'') says, and the surer the more views
have a part in it. How these go together was fitted to simulated scans; docs/method.md says how.
"""
from __future__ import annotations

from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

from .ray_march import Density, Rays

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

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
    peak = density.expected_peak(rays.points(which)).astype(np.float32)
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
