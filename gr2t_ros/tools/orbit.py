# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Where simulated cameras stand."""
from __future__ import annotations

from math import pi, sqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError

Pose = NDArray[np.float64]


def orbit(
    centre: ArrayLike, distance: float, views: int, lowest: float = -0.9, highest: float = 0.9,
) -> list[Pose]:
    """
    Return cameras that look at a point from a spiral about the world's z axis.

    The spiral of Rakhmanov, Saff and Zhou (1994): neighbours on one turn and on successive turns
    are equally far apart, so that few cameras see all sides and many move smoothly.

    :param centre: (3,) world, metres
    :param distance: of the cameras from the centre, metres
    :param lowest: of the spiral, sine of the elevation; likewise highest
    :return: (4, 4) float64 T_world_camera each
    :raises InputError: if there is no view or the distance is not positive
    """
    if views < 1:
        raise InputError(f'the number of views must be at least 1, not {views}')
    if not 0.0 < distance < np.inf:
        raise InputError(f'the distance must be above 0 m, not {distance:g}')
    sines = np.linspace(highest, lowest, views) if views > 1 else np.zeros(1)
    cosines = np.sqrt(1.0 - sines ** 2)
    spacing = sqrt(4 * pi * (highest - lowest) / 2 / views)
    azimuths = np.cumsum(spacing / cosines)
    directions = np.column_stack(
        [cosines * np.cos(azimuths), cosines * np.sin(azimuths), sines])
    target = np.asarray(centre, np.float64)
    return [looking_at(target + distance * direction, target) for direction in directions]


def looking_at(eye: ArrayLike, target: ArrayLike) -> Pose:
    """
    Return the pose of a camera that is level and looks at a point.

    :param eye: (3,) world, metres
    :param target: (3,) world, metres
    :return: (4, 4) float64, T_world_camera
    """
    eye = np.asarray(eye, np.float64)
    forward = np.asarray(target, np.float64) - eye
    forward /= np.linalg.norm(forward)
    upwards = (0.0, 0.0, 1.0) if abs(forward[2]) < 0.999 else (0.0, 1.0, 0.0)
    right = np.cross(forward, upwards)
    right /= np.linalg.norm(right)
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T_world_camera[:3, 3] = eye
    return T_world_camera
