# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What a depth sensor does to true depths; the formulas and their sources: docs/simulation.md."""
from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError

KINDS = ('none', 'gaussian', 'kinect')
_OUTLIER_REACH = 0.05  # m
_FLYING_SHARE = 0.3
_FLYING_REACH = 0.15  # m
_JUMP = 0.03  # of the depth: a larger step to a neighbour is a silhouette
_STEEPEST = np.deg2rad(85.0)  # the Kinect's formulas grow without bound at 90 degrees

Depth = NDArray[np.float64]


@dataclass(frozen=True)
class Noise:
    """
    A sensor's noise.

    :param kind: one of KINDS
    :param sigma: standard deviation for gaussian, metres
    :param outliers: share of the valid pixels that are moved uniformly within 5 cm
    :param disparity_step: depths lie on whole multiples of this disparity, pixels; 0: they do not
    :param baseline: of the disparity, metres; the default is the Kinect's
    :raises InputError: for an unknown kind or a value out of range
    """

    kind: str = 'none'
    sigma: float = 0.001
    outliers: float = 0.0
    disparity_step: float = 0.0
    baseline: float = 0.075

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f'noise must be one of {", ".join(KINDS)}, not {self.kind!r}')
        if not 0.0 <= self.sigma < np.inf:
            raise InputError(f'the sigma of the noise must be 0 m or more, not {self.sigma:g}')
        if not 0.0 <= self.outliers <= 1.0:
            raise InputError(f'outliers must be a fraction in [0, 1], not {self.outliers:g}')
        if not 0.0 <= self.disparity_step < np.inf or not 0.0 < self.baseline < np.inf:
            raise InputError('the disparity step must be 0 px or more, its baseline above 0 m')

    def offsets(self, angle: Depth, rng: np.random.Generator) -> Depth | None:
        """
        Draw by how much each pixel's ray is displaced in the image.

        :param angle: (h, w) float64, radians between ray and normal, NaN where nothing is hit
        :return: (h, w, 2) float64, pixels; None where the rays are not displaced
        """
        if self.kind != 'kinect':
            return None
        sigma = lateral_sigma(np.nan_to_num(angle))
        return rng.standard_normal((*angle.shape, 2)) * sigma[..., None]

    def apply(self, depth: Depth, angle: Depth, focal: float, rng: np.random.Generator) -> Depth:
        """
        Turn true depths into measured ones.

        :param depth: (h, w) float64, metres, NaN where nothing is hit
        :param angle: (h, w) float64, radians between ray and normal, NaN where nothing is hit
        :param focal: pixels
        :return: (h, w) float64, metres, NaN where invalid
        """
        measured = depth
        if self.kind == 'gaussian':
            measured = depth + self.sigma * rng.standard_normal(depth.shape)
        elif self.kind == 'kinect':
            measured = depth + axial_sigma(depth, angle) * rng.standard_normal(depth.shape)
            flies = rng.random(depth.shape) < _FLYING_SHARE
            reach = np.minimum(gap_behind(depth), _FLYING_REACH)
            measured = measured + np.where(flies, reach * rng.random(depth.shape), 0.0)
        if self.outliers > 0.0:
            moved = rng.random(depth.shape) < self.outliers
            moves = rng.uniform(-_OUTLIER_REACH, _OUTLIER_REACH, depth.shape)
            measured = measured + np.where(moved, moves, 0.0)
        if self.disparity_step > 0.0:
            measured = quantised(measured, focal * self.baseline, self.disparity_step)
        return np.where(measured > 0.0, measured, np.nan)


def axial_sigma(depth: Depth, angle: Depth) -> Depth:
    """
    Return the Kinect's standard deviation along the depth (Nguyen, Izadi, Lovell 2012).

    :param depth: metres
    :param angle: radians between ray and normal
    :return: metres
    """
    steep = np.minimum(angle, _STEEPEST)
    return (
        0.0012 + 0.0019 * (depth - 0.4) ** 2
        + 0.0001 / np.sqrt(depth) * (steep / (pi / 2 - steep)) ** 2)


def lateral_sigma(angle: Depth) -> Depth:
    """
    Return the Kinect's standard deviation across the image (Nguyen, Izadi, Lovell 2012).

    :param angle: radians between ray and normal
    :return: pixels
    """
    steep = np.minimum(angle, _STEEPEST)
    return 0.8 + 0.035 * steep / (pi / 2 - steep)


def gap_behind(depth: Depth) -> Depth:
    """
    Return how far behind each silhouette pixel its farthest neighbour lies.

    :param depth: (h, w) float64, metres, NaN where nothing is hit
    :return: (h, w) float64, metres: 0 off the silhouettes, infinite beside empty pixels
    """
    far = np.where(np.isnan(depth), np.inf, depth)
    padded = np.pad(far, 1, mode='edge')
    neighbours = [padded[:-2, 1:-1], padded[2:, 1:-1], padded[1:-1, :-2], padded[1:-1, 2:]]
    gap = np.max(neighbours, axis=0) - np.where(np.isnan(depth), 0.0, depth)
    return np.where(gap > _JUMP * depth, gap, 0.0)


def quantised(depth: Depth, focal_baseline: float, step: float) -> Depth:
    """
    Round depths to whole multiples of a disparity step.

    :param depth: metres
    :param focal_baseline: focal length times baseline, pixels metres
    :param step: pixels
    :return: metres; NaN where the disparity rounds to 0
    """
    steps = np.round(focal_baseline / depth / step)
    with np.errstate(divide='ignore'):
        rounded = focal_baseline / (steps * step)
    return np.where(steps > 0, rounded, np.nan)
