# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How far to trust a maximum: its standard deviation along the ray, and a confidence from 0 to 1.

A Gaussian sum's maximum is as sharp as its width sqrt(-f / f'') says, and the surer the more views
have a part in it; where these agree less, the shape is finer or steeper than the kernels, and its
maximum is off. How these go together was fitted to simulated scans; docs/method.md says how.
"""
from __future__ import annotations

from math import exp, log, pi, sqrt

from numba import njit
import numpy as np
from numpy.typing import NDArray

from .ray_march import Density, Rays

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

# sigma^2 = noise^2 + shape^2, each as a power law: in units of h3, with the width and the lateral
# bandwidth in h3, but h3 itself in _MILLIMETRE. docs/method.md says how they were fitted.
_NOISE, _WIDTH, _AGREEMENT, _VIEWS = 0.20, 1.8, -0.60, -0.9
_SHAPE, _SHAPE_WIDTH, _SHAPE_AGREEMENT, _LATERAL, _H3 = 0.010, 1.6, -2.35, -1.5, 0.55
_FITTED_AT = 1.5  # px, of h1
_MILLIMETRE = 0.001


def deviations(density: Density, rays: Rays, which: NDArray[np.int64]) -> Floats:
    """
    Return the standard deviations of maxima along their rays.

    :param which: (n,) int64, indices of rays that have found their maximum
    :return: float32, metres of depth; infinite where the density is not curved downwards, and
        where nothing but the ray's own pixel supports the maximum
    """
    return deviations_and_agreements(density, rays, which)[0]


def deviations_and_agreements(
    density: Density, rays: Rays, which: NDArray[np.int64]
) -> tuple[Floats, Floats]:
    """
    Return also which share of what the views that see a maximum can give it has.

    :return: (n,) float32 as deviations, (n,) float32, about 1 on a plane that faces the views
    """
    h3 = density.h3(rays.depth[which])
    pixels = rays.table.shape[0] * rays.table.shape[1]
    sigma, agreement = np.zeros((2, len(which)), np.float32)
    # the factor 1/C is left out: what other views add elsewhere changes no digit
    _deviations(
        rays.total[which], rays.curvature[which], h3, 1.0 / (sqrt(2 * pi) * pixels * h3),
        density.expected_total(rays.points(which)), rays.depth[which], rays.pixels[which],
        rays.table, density.pixel_bandwidth, sigma, agreement)
    return sigma, agreement


@njit(cache=True, nogil=True, error_model='numpy')
def _deviations(
    totals: Floats, curvatures: Floats, h3s: Doubles, shares: Doubles, expected: Doubles,
    depths: Floats, pixels: NDArray[np.int32], table: Doubles, h1: float,
    sigma: Floats, agreement: Floats,
) -> None:
    """Write sigma and agreement; a share is what a view gives where it sees a plane facing it."""
    own = 1.0 / (2.0 * pi * h1 * h1)  # the ray's own pixel's part of a share
    for n in range(len(totals)):
        h3 = h3s[n]
        views = max(expected[n] / shares[n], 1.0)
        agreement[n] = totals[n] / (shares[n] * views)
        sigma[n] = np.inf
        others = agreement[n] - own / views
        lateral = h1 * depths[n] * _pitch(table, pixels[n])
        if curvatures[n] < 0 and others > 0 and lateral > 0:
            width = 0.5 * log(-totals[n] / (curvatures[n] * h3 * h3))
            others = log(others)
            noise = _NOISE * _FITTED_AT / h1 * exp(
                _WIDTH * width + _AGREEMENT * others + _VIEWS * log(views))
            shape = _SHAPE * exp(
                _SHAPE_WIDTH * width + _SHAPE_AGREEMENT * others + _LATERAL * log(lateral / h3)
                + _H3 * log(h3 / _MILLIMETRE))
            sigma[n] = h3 * sqrt(noise * noise + shape * shape)


@njit(cache=True, nogil=True)
def _pitch(table: Doubles, pixel: int) -> float:
    """Return how far apart the rays of neighbouring pixels are at depth 1; NaN where unknown."""
    v, u = divmod(pixel, table.shape[1])
    right = u + 1 if u + 1 < table.shape[1] else u - 1
    below = v + 1 if v + 1 < table.shape[0] else v - 1
    across = np.abs(table[v, right, 0] - table[v, u, 0])
    down = np.abs(table[below, u, 1] - table[v, u, 1])
    return float(across if np.isfinite(across) else down)


def confidences(sigma: Floats, h3: Doubles) -> Floats:
    """
    Return standard deviations as confidences: 1 is certain, 1/2 a deviation of h3.

    :param sigma: (n,) metres
    :param h3: (n,) bandwidths along the depth there, metres
    """
    return (1.0 / (1.0 + sigma / h3)).astype(np.float32)
