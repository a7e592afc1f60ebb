# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What the keyframes' depth images say of a place: empty, surface, hidden, or nothing at all."""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from numba import njit
import numpy as np
from numpy.typing import NDArray

from .camera import project_jet
from .confidence import confidences, deviations
from .ray_march import Density
from .reconstruction import Keyframe, Reconstruction

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]

_COLUMNS = 160  # of a coarse image, at most
_IMAGES = 64  # looked at; of more keyframes every n-th


class Space(IntEnum):
    """
    What is known of a place.

    FREE: a camera looked through it, or saw nothing within its range there. SURFACE: a depth is
    there. HIDDEN: it is behind what the cameras saw. OUTSIDE: in no camera's image.
    """

    OUTSIDE = 0
    HIDDEN = 1
    SURFACE = 2
    FREE = 3


@dataclass(frozen=True, eq=False)
class SeenImage:
    """
    A keyframe's depths, every stride-th pixel of every stride-th row.

    :param depth: (h, w) float32, metres; infinite where nothing is within range, NaN where the
        depth is doubtful
    :param parameters: of the full image's camera, as Camera.parameters
    :param slopes: (2,) half the width and height of the image at a depth of 1
    :param T_world_camera: (4, 4) float64
    :param depth_max: up to which the camera sees, metres
    """

    depth: Floats
    stride: int
    parameters: Doubles
    slopes: Doubles
    T_world_camera: Doubles
    depth_max: float


def seen_images(reconstruction: Reconstruction) -> list[SeenImage]:
    """Return what the keyframes saw, as they are known now."""
    keyframes = [keyframe for keyframe in reconstruction.keyframes if not keyframe.released]
    return [
        _seen(reconstruction, keyframe)
        for keyframe in keyframes[::-(-len(keyframes) // _IMAGES) or 1]]


def _seen(reconstruction: Reconstruction, keyframe: Keyframe) -> SeenImage:
    settings, rays, view = reconstruction.settings, keyframe.rays, keyframe.view
    camera = view.camera
    stride = settings.ray_stride * max(-(-camera.width // (_COLUMNS * settings.ray_stride)), 1)
    whole = view.depth[::stride, ::stride]
    depth = np.where(np.isfinite(whole), np.float32(np.nan), np.float32(np.inf))
    v, u = np.divmod(rays.pixels, camera.width)
    found = np.flatnonzero(rays.converged & (v % stride == 0) & (u % stride == 0))
    found = found[_confident(reconstruction.density, keyframe, found, settings.min_confidence)]
    depth[v[found] // stride, u[found] // stride] = rays.depth[found]
    return SeenImage(
        depth, stride, camera.parameters,
        np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2,
        view.T_world_camera, settings.depth_max)


def _confident(
    density: Density, keyframe: Keyframe, which: NDArray[np.int64], least: float
) -> NDArray[np.bool_]:
    rays = keyframe.rays
    sigma = deviations(density, rays, which)
    return confidences(sigma, density.h3(rays.depth[which])) >= least


def spaces(
    points: Doubles, images: Sequence[SeenImage], tolerance: float, silence: float
) -> NDArray[np.uint8]:
    """
    Return what is known of some places.

    One camera that looked through a place is believed, and so is one that has a depth there.
    Missing depths are less to go by: they come from empty space, and from what a sensor cannot
    measure. A place is free by them unless it is hidden from so and so many times as many.

    :param points: (n, 3) float64, world, metres
    :param tolerance: a depth as near as this is a surface, metres
    :param silence: of how many cameras that have a place hidden one without a depth is the equal
    :return: (n,) uint8, Space
    """
    votes = np.zeros((len(points), 4), np.int32)
    for image in images:
        T = image.T_world_camera
        _vote(
            points, np.ascontiguousarray(T[:3, :3].T), T[:3, 3].copy(), image.parameters,
            image.depth, image.stride, tolerance, image.depth_max, votes)
    through, surface, hidden, nothing = votes.T
    found = np.full(len(points), Space.OUTSIDE, np.uint8)
    found[hidden > 0] = Space.HIDDEN
    found[(silence * nothing > hidden) | (through > 0)] = Space.FREE
    found[surface > 0] = Space.SURFACE
    return found


@njit(cache=True, nogil=True)
def _vote(
    points: Doubles, R_camera_world: Doubles, eye: Doubles, parameters: Doubles, depth: Floats,
    stride: int, tolerance: float, depth_max: float, votes: NDArray[np.int32],
) -> None:
    """Count what an image says of each place: through, surface, hidden, nothing."""
    height, width = depth.shape
    for n in range(len(points)):
        x, y, z = points[n, 0] - eye[0], points[n, 1] - eye[1], points[n, 2] - eye[2]
        z_camera = R_camera_world[2, 0] * x + R_camera_world[2, 1] * y + R_camera_world[2, 2] * z
        if z_camera <= 0.0 or z_camera > depth_max:
            continue
        seen, u, _, _, v, _, _ = project_jet(
            parameters,
            R_camera_world[0, 0] * x + R_camera_world[0, 1] * y + R_camera_world[0, 2] * z, 0.0,
            R_camera_world[1, 0] * x + R_camera_world[1, 1] * y + R_camera_world[1, 2] * z, 0.0,
            z_camera, 0.0)
        if not seen or not (-0.5 <= u / stride < width - 0.5 and
                            -0.5 <= v / stride < height - 0.5):
            continue
        d = depth[int(v / stride + 0.5), int(u / stride + 0.5)]
        if np.isinf(d):
            votes[n, 3] += 1
        elif z_camera < d - tolerance:
            votes[n, 0] += 1
        elif z_camera <= d + tolerance:
            votes[n, 1] += 1
        elif z_camera > d:
            votes[n, 2] += 1
