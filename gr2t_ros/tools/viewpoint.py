# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""From where a mesh is best looked at."""
from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

Pose = NDArray[np.float64]
Points = NDArray[np.float64]

_SAMPLE = 30_000
_GRID = 64  # cells across the trial pictures
_MARGIN = 1.1
_KNOWN_UP = 0.3  # cameras whose upward directions have a longer mean agree on what is up
_UPRIGHT = 0.94  # cosine of 20 degrees
_CAMERAS = 16


def good_view(
    vertices: Points,
    faces: NDArray[np.integer],
    poses: Sequence[Pose],
    focal: float,
    aspect: float,
) -> Pose:
    """
    Return a place from which much of a mesh is seen, from the side that it was scanned from.

    Tried are places all round it and in the cameras' directions that show all of it and, for what
    was scanned from inside, places close behind the cameras. The winner shows the largest share
    of the surface from outside and the smallest from inside: a room is not looked at through the
    back of its walls.

    :param vertices: (n, 3) world, metres
    :param faces: (m, 3) indices of vertices, counter-clockwise seen from outside
    :param poses: (4, 4) T_world_camera of the cameras that scanned it; may be empty
    :param focal: of the picture, in units of its width
    :param aspect: height / width of the picture
    :return: (4, 4) T_world_camera
    """
    best, T_best = -np.inf, np.eye(4)
    points, normals = _samples(vertices, faces)
    if len(points) == 0:
        return T_best
    # a few flying points must not make the rest small
    low, high = np.percentile(points, (0.2, 99.8), axis=0)
    inside = np.all((points >= low) & (points <= high), axis=1)
    points, normals = points[inside], normals[inside]
    for T_world_camera, bonus in _candidates(points, poses, focal, aspect):
        score = bonus + _score(points, normals, T_world_camera, focal, aspect)
        if score > best:
            best, T_best = score, T_world_camera
    return T_best


def upward(poses: Sequence[Pose]) -> Points:
    """
    Return what is up in a world: z, unless the cameras that scanned it agree on another direction.

    :param poses: (4, 4) T_world_camera; may be empty
    :return: (3,) unit vector
    """
    mean_up = np.mean([-pose[:3, 1] for pose in poses], axis=0) if len(poses) else np.zeros(3)
    length = np.linalg.norm(mean_up)
    # REP 103 has z up, and a few cameras tell it only roughly
    if length > _KNOWN_UP and mean_up[2] <= _UPRIGHT * length:
        return mean_up / length
    return np.array([0.0, 0.0, 1.0])


def _samples(vertices: Points, faces: NDArray[np.integer]) -> tuple[Points, Points]:
    """Return points spread evenly over a surface, (n, 3), and its normals there, (n, 3)."""
    faces = faces[::max(len(faces) // (10 * _SAMPLE), 1)]
    corner = vertices[faces[:, 0]]
    sides = vertices[faces[:, 1]] - corner, vertices[faces[:, 2]] - corner
    normals = np.cross(*sides)
    doubled = np.linalg.norm(normals, axis=1)
    if not doubled.any():
        return np.zeros((0, 3)), np.zeros((0, 3))
    rng = np.random.default_rng(0)
    area = np.cumsum(doubled)
    chosen = np.searchsorted(area, rng.random(_SAMPLE) * area[-1], side='right')
    chosen = np.minimum(chosen, len(faces) - 1)
    a, b = rng.random((2, _SAMPLE, 1))
    a, b = np.where(a + b > 1, 1 - a, a), np.where(a + b > 1, 1 - b, b)
    points = corner[chosen] + a * sides[0][chosen] + b * sides[1][chosen]
    return points, normals[chosen] / np.maximum(doubled[chosen, None], 1e-300)


def _candidates(
    points: Points, poses: Sequence[Pose], focal: float, aspect: float
) -> Iterator[tuple[Pose, float]]:
    """Yield places and how much nicer each is than others that show as much."""
    up = upward(poses)
    forward = np.mean([pose[:3, 2] for pose in poses], axis=0) if len(poses) else np.zeros(3)
    east = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    directions = []
    for elevation, bonus in ((20, 0.05), (35, 0.15), (50, 0.0)):
        for azimuth in range(0, 360, 30):
            e, a = np.deg2rad((elevation, azimuth))
            directions.append((
                -np.sin(e) * up - np.cos(e) * (np.cos(a) * east + np.sin(a) * north), bonus))
    # (cameras all round a table look, in the mean, straight down on it)
    if np.linalg.norm(forward) > max(_KNOWN_UP, 1.3 * abs(forward @ up)):
        directions.append((forward / np.linalg.norm(forward), 0.15))
    for direction, bonus in directions:
        yield _fitted(points, _level(direction, up), focal, aspect), bonus
    size = np.linalg.norm(np.ptp(points, axis=0))
    for pose in poses[::max(len(poses) // _CAMERAS, 1)]:
        R = _level(pose[:3, 2], up)
        yield _fitted(points, R, focal, aspect), 0.0
        for back in (0.05, 0.2):
            T_world_camera = np.eye(4)
            T_world_camera[:3, :3] = R
            T_world_camera[:3, 3] = pose[:3, 3] - back * size * pose[:3, 2]
            yield T_world_camera, 0.0


def _level(forward: Points, up: Points) -> Points:
    """Return (3, 3) R_world_camera that looks along forward with a level horizon."""
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 1e-3:
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    return np.column_stack([right, np.cross(forward, right), forward])


def _fitted(points: Points, R: Points, focal: float, aspect: float) -> Pose:
    """Return the pose of rotation R whose picture all points just fill."""
    local = points @ R
    x, y, z = local.T
    # With the camera at (cx, cy, cz) a point is in the picture where |x - cx| <= t (z - cz):
    # each border is a bound on cx +- t cz, and likewise for y.
    tx, ty = 0.5 / focal / _MARGIN, 0.5 * aspect / focal / _MARGIN
    # (a few stray points may lie outside)
    right, left = np.quantile(x - tx * z, 0.9995), np.quantile(x + tx * z, 0.0005)
    below, above = np.quantile(y - ty * z, 0.9995), np.quantile(y + ty * z, 0.0005)
    cz = min((left - right) / (2 * tx), (above - below) / (2 * ty))
    T_world_camera = np.eye(4)
    T_world_camera[:3, :3] = R
    T_world_camera[:3, 3] = R @ np.array([(left + right) / 2, (above + below) / 2, cz])
    return T_world_camera


def _score(
    points: Points, normals: Points, T_world_camera: Pose, focal: float, aspect: float
) -> float:
    """Return the share of points seen from outside less those from inside, likewise of cells."""
    R, eye = T_world_camera[:3, :3], T_world_camera[:3, 3]
    local = (points - eye) @ R
    z = local[:, 2]
    rows = round(_GRID * aspect)
    with np.errstate(divide='ignore', invalid='ignore'):
        u = (local[:, 0] / z * focal + 0.5) * _GRID
        v = (local[:, 1] / z * focal + 0.5 * aspect) * _GRID
        within = (z > 0) & (u >= 0) & (u < _GRID) & (v >= 0) & (v < rows)
    cell = v[within].astype(int) * _GRID + u[within].astype(int)
    z = z[within]
    nearest = np.full(_GRID * rows, np.inf)
    np.minimum.at(nearest, cell, z)
    visible = z < nearest[cell] * 1.03
    towards = np.einsum('ij,ij->i', normals[within], points[within] - eye) < 0
    seen, wrong = visible & towards, visible & ~towards
    filled = np.zeros(_GRID * rows)
    filled[cell[seen]] = 1.0
    filled[cell[wrong]] = -1.0
    return float((np.sum(seen) - np.sum(wrong)) / len(points) + 0.2 * filled.mean())
