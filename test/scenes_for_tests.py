# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Small views of a plane and a sphere, and the density written out plainly."""
from __future__ import annotations

from collections.abc import Sequence
from math import pi

import numpy as np
from scipy.spatial.transform import Rotation

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.view import View

CAMERAS = (
    Camera(64, 48, 60.0, 61.0, 31.2, 23.7),
    Camera(64, 48, 60.0, 61.0, 31.2, 23.7, 'plumb_bob', (0.1, -0.1, 0.001, 0.002, 0.01)),
    Camera(60, 50, 58.0, 58.0, 30.1, 24.2, 'rational_polynomial',
           (0.5, 0.1, 0.001, -0.0005, 0.01, 0.8, 0.2, 0.02)),
    Camera(64, 48, 60.0, 61.0, 31.2, 23.7, 'equidistant', (0.02, -0.01, 0.003, -0.001)),
)


def pose(rotation_vector: Sequence[float], translation: Sequence[float]) -> np.ndarray:
    """Return a (4, 4) transform from a rotation vector (rad) and a translation (m)."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    T[:3, 3] = translation
    return T


def bumpy_views(seed: int = 0) -> list[View]:
    """Return one view for each of CAMERAS of a wavy noisy surface, with holes."""
    rng = np.random.default_rng(seed)
    views = []
    for stamp, camera in enumerate(CAMERAS):
        a, b = camera.rays[..., 0], camera.rays[..., 1]
        depth = 0.5 + 0.1 * a + 0.05 * np.sin(9 * b) + rng.normal(0, 0.001, a.shape)
        depth[rng.random(depth.shape) < 0.05] = np.nan
        T = pose(rng.normal(0, 0.1, 3), rng.normal(0, 0.03, 3))
        views.append(View(depth.astype(np.float32), camera, T, stamp))
    return views


def plane_view(
    camera: Camera, T_world_camera: np.ndarray, normal: Sequence[float], offset: float
) -> View:
    """Return a view of the world plane normal . x = offset (m)."""
    rays = np.concatenate([camera.rays, np.ones_like(camera.rays[..., :1])], axis=-1)
    directions = rays @ T_world_camera[:3, :3].T
    depth = (offset - T_world_camera[:3, 3] @ normal) / (directions @ normal)
    return View(depth.astype(np.float32), camera, T_world_camera, 0)


def sphere_view(camera: Camera, T_world_camera: np.ndarray, radius: float) -> View:
    """Return a view of the sphere of a radius (m) about the world's origin."""
    rays = np.concatenate([camera.rays, np.ones_like(camera.rays[..., :1])], axis=-1)
    directions = rays @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    a = np.sum(directions ** 2, axis=-1)
    b = directions @ origin
    with np.errstate(invalid='ignore'):
        depth = (-b - np.sqrt(b * b - a * (origin @ origin - radius ** 2))) / a
    return View(depth.astype(np.float32), camera, T_world_camera, 0)


def looking_at_origin(direction: Sequence[float], distance: float) -> np.ndarray:
    """Return T_world_camera of a camera in that direction from the origin, facing it."""
    back = np.asarray(direction, float) / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], -back)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(-back, right), -back])
    T[:3, 3] = distance * back
    return T


def plain_jet(
    views: Sequence[View], h1: float, h3_constant: float, h3_quadratic: float,
    origin: np.ndarray, direction: np.ndarray, distance: float, truncation: float = np.inf,
) -> tuple[float, float, float]:
    """
    Return f, f', f'' at a point of a line, summed over every pixel of every view.

    Projections are differentiated by central differences of fourth order, so that nothing is
    shared with the code under test but Camera.project.
    """
    def projected(view: View, t: float) -> np.ndarray:
        T = view.T_world_camera
        p = T[:3, :3].T @ (origin + t * direction - T[:3, 3])
        return np.append(view.camera.project(p[None])[0], p[2])

    total = np.zeros(3)
    step = 1e-3
    for view in views:
        s = [projected(view, distance + k * step) for k in (-2, -1, 0, 1, 2)]
        if not np.isfinite(s[2]).all():
            continue
        first = (s[0] - 8 * s[1] + 8 * s[3] - s[4]) / (12 * step)
        second = (-s[0] + 16 * s[1] - 30 * s[2] + 16 * s[3] - s[4]) / (12 * step ** 2)
        v, u = np.mgrid[0:view.camera.height, 0:view.camera.width]
        z = view.depth.astype(np.float64)
        h3 = h3_constant + h3_quadratic * z * z
        width = np.stack([np.full(z.shape, h1), np.full(z.shape, h1), h3])
        r = np.stack([u - s[2][0], v - s[2][1], z - s[2][2]]) / width
        kernel = np.exp(-0.5 * np.sum(r * r, axis=0)) / ((2 * pi) ** 1.5 * h1 * h1 * h3)
        kernel[~(np.abs(r) <= truncation).all(axis=0)] = 0
        d = first[:, None, None] / width
        m = np.sum(r * d, axis=0)
        m1 = np.sum(r * second[:, None, None] / width - d * d, axis=0)
        terms = np.stack([kernel, kernel * m, kernel * (m * m + m1)])
        total += np.nansum(terms, axis=(1, 2)) / z.size
    return tuple(total / len(views))
