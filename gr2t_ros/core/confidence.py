# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
How far to trust a maximum: its standard deviation along the ray, and a confidence from 0 to 1.

A Gaussian sum's maximum is as sharp as its width sqrt(-f / f'') says, and the surer the more views
have a part in it. How these go together was fitted to simulated scans; docs/method.md says how.
"""
from __future__ import annotations

from math import exp, log, pi, sqrt

from numba import njit
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
        density.expected_total(rays.points(which)), _SCALE * _FITTED_AT / density.pixel_bandwidth,
        sigma, agreement)
    return sigma, agreement


@njit(cache=True, nogil=True, error_model='numpy')
def _deviations(
    totals: Floats, curvatures: Floats, h3s: Doubles, shares: Doubles, expected: Doubles,
    factor: float, sigma: Floats, agreement: Floats,
) -> None:
    """Write sigma and agreement; a share is what a view gives where it sees a plane facing it."""
    for n in range(len(totals)):
        views = np.float32(max(expected[n] / shares[n], 1.0))
        agreement[n] = totals[n] / (shares[n] * views)
        sigma[n] = np.inf
        if curvatures[n] < 0 and agreement[n] > 0:
            square = np.float32(-totals[n] / (curvatures[n] * h3s[n] * h3s[n]))  # of the width
            sigma[n] = h3s[n] * factor * exp(
                np.float32(0.5 * _WIDTH) * log(square)
                + np.float32(_AGREEMENT) * log(agreement[n]) + np.float32(_VIEWS) * log(views))


def confidences(sigma: Floats, h3: Doubles) -> Floats:
    """
    Return standard deviations as confidences: 1 is certain, 1/2 a deviation of h3.

    :param sigma: (n,) metres
    :param h3: (n,) bandwidths along the depth there, metres
    """
    return (1.0 / (1.0 + sigma / h3)).astype(np.float32)
