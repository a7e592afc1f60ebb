# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the colours of a map refer to."""
from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from .confidence import deviations
from .ray_march import Density, Rays

_PERCENTILE = 98.0
_RAYS = 250_000  # of which the likelihoods are looked at
_DEVIATIONS = 50_000


def robust_maximum(color_by: str, density: Density, rays: Sequence[Rays]) -> float:
    """
    Return the robust maximum of what is shown over all keyframes, in large maps some rays of each.

    :param color_by: of Settings.color_by
    :param rays: each keyframe's
    :return: 1 / (px^2 m) or metres; 0 where there is none
    """
    values = (_deviations if color_by == 'sigma' else _likelihoods)(density, rays)
    return float(np.percentile(values, _PERCENTILE)) if len(values) else 0.0


def _likelihoods(density: Density, rays: Sequence[Rays]) -> NDArray[np.floating]:
    step = sum(len(item.pixels) for item in rays) // _RAYS + 1
    totals = [np.zeros(0, np.float32), *(
        item.total[::step][item.converged[::step]] for item in rays)]
    return np.concatenate(totals) / density.size


def _deviations(density: Density, rays: Sequence[Rays]) -> NDArray[np.float32]:
    """Return sigmas (m): each has to ask the density."""
    samples = [np.zeros(0, np.float32)]
    for item in rays:
        found = np.flatnonzero(item.converged)
        step = len(rays) * len(found) // _DEVIATIONS + 1
        samples.append(deviations(density, item, found[::step]))
    sigma = np.concatenate(samples)
    return sigma[np.isfinite(sigma)]
