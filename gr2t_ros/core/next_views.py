# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Where to scan next: what is missing of the surface, and from where it would be seen.

Space is cut into cells. Where the scan's surface ends there are cells that are unknown beside
cells that are free, and between the two a boundary that stands for the surface that is missing
(frontiers; Yamauchi 1997); its projection along a view is how much of it that view would see.
Surface of little confidence counts likewise. The next views are those that see most of both, each
of what those before it leave.
"""
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .fused_mesh import SurfaceMesh
from .reconstruction import Reconstruction
from .seen_space import seen_images, SeenImage, Space, spaces
from .sight import look, nearest

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Pose = NDArray[np.float64]

_CELLS = 96  # along the longest side of the surface
_REACH = 2  # cells from the surface within which something is missing
_TOLERANCE = 1.0  # cells between a depth and a place that is a surface
_SILENCE = 8  # cameras that have a place hidden, for one that has no depth there
_DOUBTFUL = 0.5  # confidence: sigma is h3, one pixel alone is as good
_BEYOND = 0.25  # what counts that no camera had in its image: each scan has to end somewhere
_MARGIN = 0.1  # of the distance, beyond the heights that cameras were at
_UNUSUAL = 0.25  # what a view counts from lower or higher than the cameras ever were
_LEAST = 0.05  # of the first view's gain, for another view
_TILTS = 6  # views about the one that looks straight at it
_TILT = 0.7  # rad
_CLUSTERS = 40
_WIDTH, _HEIGHT = 64, 48  # pixels of the trial pictures


@dataclass(frozen=True, eq=False)
class NextView:
    """
    A view that would show surface that is missing or doubtful.

    :param position: (3,) in the midst of that, world, metres
    :param area: about how much of it is seen that no view before it in the list sees, m^2
    :param T_world_camera: (4, 4) float64, where to look from; optical frame
    """

    position: Doubles
    area: float
    T_world_camera: Pose


@dataclass(frozen=True, eq=False)
class Attention:
    """
    What is missing or doubtful of a surface, and the views that show it.

    :param points: (n, 3) float64, world, metres
    :param confidence: (n,) float32, of the surface there; 0 where it ends
    :param views: the best first
    """

    points: Doubles
    confidence: Floats
    views: tuple[NextView, ...]


@dataclass(frozen=True, eq=False)
class _Targets:
    """
    Pieces of surface that should be seen.

    :param points: (n, 3) float64
    :param normals: (n, 3) float64, unit, towards where they can be seen from
    :param areas: (n,) float64, m^2
    :param weights: (n,) float64, what a square metre counts
    :param confidence: (n,) float32
    """

    points: Doubles
    normals: Doubles
    areas: Doubles
    weights: Doubles
    confidence: Floats

    def only(self, kept: NDArray[np.bool_]) -> _Targets:
        """Return some of them."""
        return _Targets(*(getattr(self, name)[kept] for name in _Targets.__dataclass_fields__))


def where_next(
    reconstruction: Reconstruction, mesh: SurfaceMesh, count: int = 5
) -> Attention:
    """
    Return what is missing of a map, and from where to look at it.

    :param mesh: its fused mesh
    :param count: of views, at most
    """
    return attention(
        mesh.vertices, mesh.faces, mesh.vertex_confidence, seen_images(reconstruction),
        reconstruction.settings.depth_min, count)


def attention(
    vertices: Doubles, faces: NDArray[np.int32], confidence: Floats,
    images: Sequence[SeenImage], depth_min: float, count: int = 5,
) -> Attention:
    """
    Return what is missing of a surface, and from where to look at it.

    :param vertices: (n, 3) float64, world, metres
    :param faces: (m, 3) int32, counter-clockwise seen from the cameras' side
    :param confidence: (n,) float32 of the vertices, 0 to 1
    :param images: of the cameras that saw it
    :param depth_min: nothing nearer than this is seen, metres
    :param count: of views, at most
    """
    nothing = Attention(np.zeros((0, 3)), np.zeros(0, np.float32), ())
    if len(faces) == 0 or len(images) == 0:
        return nothing
    used = np.zeros(len(vertices), np.bool_)
    used[faces] = True
    points = vertices[used]
    grid = _Grid(points)
    occupied = np.zeros(grid.shape, np.bool_)
    for places in (points, _middles(vertices, faces)):
        occupied.reshape(-1)[grid.indices(places)] = True
    targets = _joined(
        _missing(grid, occupied, images),
        _doubtful(grid, vertices, faces, confidence))
    if len(targets.areas) == 0:
        return nothing
    surface = grid.centres(np.argwhere(occupied))

    def cosines(poses: Doubles, of: _Targets) -> Floats:
        seen = np.zeros((len(poses), len(of.areas)), np.float32)
        for T, row in zip(poses, seen):
            look(T, images[-1].slopes, surface, grid.side, of.points, of.normals, depth_min,
                  images[-1].depth_max, np.full((_HEIGHT, _WIDTH), np.inf), row)
        return seen

    # what a camera had before it is not missing: cells are coarse, as about an edge
    scanned = cosines(np.stack([image.T_world_camera for image in images]), targets).any(axis=0)
    targets = targets.only(~scanned | (targets.confidence > 0))
    if len(targets.areas) == 0:
        return nothing
    candidates, worth = _candidates(grid.side, surface, targets, images, depth_min)
    gains = cosines(candidates, targets)
    gains *= worth[:, None] * (targets.areas * targets.weights)
    return Attention(
        targets.points, targets.confidence, _best(candidates, gains, targets, count))


class _Grid:
    """
    Cells about a surface.

    :param points: (n, 3) float64, of the surface
    """

    def __init__(self, points: Doubles) -> None:
        low, high = points.min(axis=0), points.max(axis=0)
        self.side = max(float((high - low).max()) / _CELLS, 1e-9)
        self.low = low - (_REACH + 1.5) * self.side
        self.shape = tuple(
            int(n) for n in np.ceil((high - low) / self.side) + 2 * _REACH + 3)

    def indices(self, points: Doubles) -> NDArray[np.int64]:
        """Return the flat indices (n,) of the cells in which points lie."""
        cells = ((points - self.low) / self.side).astype(np.int64)
        found: NDArray[np.int64] = np.ravel_multi_index(tuple(cells.T), self.shape)
        return found

    def centres(self, cells: NDArray[np.int64]) -> Doubles:
        """Return (n, 3) float64, world, metres."""
        centres: Doubles = self.low + (cells + 0.5) * self.side
        return centres


def _missing(
    grid: _Grid, occupied: NDArray[np.bool_], images: Sequence[SeenImage]
) -> _Targets:
    """Return the boundary between unknown and free cells near the surface."""
    near = occupied
    for axis in range(3):
        near = np.logical_or.reduce([
            np.roll(near, step, axis) for step in range(-_REACH, _REACH + 1)])
    cells = np.argwhere(near)
    space = np.full(grid.shape, Space.SURFACE, np.uint8)  # far from it nothing is missing
    space[tuple(cells.T)] = spaces(
        grid.centres(cells), images, _TOLERANCE * grid.side, _SILENCE)
    space[occupied] = Space.SURFACE
    unknown = space <= Space.HIDDEN
    normal = np.zeros((*grid.shape, 3), np.int8)
    for axis in range(3):
        for step in (-1, 1):
            # near's margin is never free, so that what np.roll brings round does not count
            free = np.roll(space, -step, axis) == Space.FREE
            normal[..., axis] += np.where(unknown & free, np.int8(step), np.int8(0))
    found = normal.any(axis=3)
    company = found.astype(np.int8)
    for axis in range(3):
        company = np.roll(company, -1, axis) + company + np.roll(company, 1, axis)
    cells = np.argwhere(found & (company > 3))  # three of a wall at least, no single ones
    vectors = normal[tuple(cells.T)].astype(np.float64)
    lengths = np.linalg.norm(vectors, axis=1)
    normals = vectors / lengths[:, None]
    beyond = space[tuple(cells.T)] == Space.OUTSIDE
    return _Targets(
        grid.centres(cells) + 0.5 * grid.side * normals, normals, lengths * grid.side ** 2,
        np.where(beyond, _BEYOND, 1.0), np.zeros(len(cells), np.float32))


def _middles(values: NDArray[Any], faces: NDArray[np.int32]) -> NDArray[Any]:
    """Return the means of the faces' three corners."""
    middles: NDArray[Any] = (
        values[faces[:, 0]] + values[faces[:, 1]] + values[faces[:, 2]]) / values.dtype.type(3)
    return middles


def _doubtful(
    grid: _Grid, vertices: Doubles, faces: NDArray[np.int32], confidence: Floats
) -> _Targets:
    """Return the surface of little confidence, put together cell by cell."""
    confidence = _middles(confidence, faces)
    doubtful = confidence < _DOUBTFUL
    corners, confidence = vertices[faces[doubtful]], confidence[doubtful]
    normals = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    centres = corners.mean(axis=1)
    _, cell = np.unique(grid.indices(centres), return_inverse=True)
    count = int(cell.max(initial=-1)) + 1

    def total(values: Doubles) -> Doubles:
        return np.bincount(cell, values, count).astype(np.float64)

    area = np.maximum(total(areas), 1e-12)
    vectors = np.column_stack([total(column) for column in normals.T])
    lengths = np.linalg.norm(vectors, axis=1)
    return _Targets(
        np.column_stack([total(areas * column) for column in centres.T]) / area[:, None],
        vectors / np.maximum(lengths, 1e-12)[:, None], lengths, np.ones(count),
        (total(areas * confidence) / area).astype(np.float32))


def _joined(one: _Targets, other: _Targets) -> _Targets:
    return _Targets(*(
        np.concatenate([getattr(one, name), getattr(other, name)])
        for name in _Targets.__dataclass_fields__))


def _candidates(
    side: float, surface: Doubles, targets: _Targets, images: Sequence[SeenImage],
    depth_min: float,
) -> tuple[Doubles, Doubles]:
    """
    Return views that look at what should be seen, and what a place counts.

    :return: (n, 4, 4) float64 T_world_camera; (n,) float64: 1 where a camera was or looked
        through, less where nobody knows, or no camera ever was so low or high
    """
    depths = np.concatenate([image.depth[np.isfinite(image.depth)] for image in images])
    distance = max(float(np.median(depths)) if len(depths) else 0.0, 2 * depth_min)
    eyes = np.stack([image.T_world_camera[:3, 3] for image in images])
    up = _upwards(np.stack([image.T_world_camera for image in images]))
    places, poses = [], []
    for centre, normal in _clusters(targets, distance / 3):
        for direction in _directions(normal):
            for away in (distance, 0.6 * distance):
                places.append(centre + away * direction)
                poses.append(_looking(centre + away * direction, -direction, up))
    if not places:
        return np.zeros((0, 4, 4)), np.zeros(0)
    # where a camera shall stand, one that had no depth there is not believed against others
    space = spaces(np.array(places), images, 2 * side, 1)
    worth = np.choose(space, [0.5, 0.0, 0.0, 1.0])
    worth[nearest(np.array(places), eyes) < 0.5 * distance] = 1.0
    heights, margin = eyes @ up, _MARGIN * distance
    height = np.array(places) @ up
    worth[(height < heights.min() - margin) | (height > heights.max() + margin)] *= _UNUSUAL
    worth[nearest(np.array(places), surface) < depth_min + side] = 0.0
    return np.array(poses)[worth > 0], worth[worth > 0]


def _upwards(poses: Doubles) -> Doubles:
    """
    Return the direction (3,) that cameras (n, 4, 4) mostly have above them.

    It is at right angles to their x axes, whichever way they look; where these are all alike it is
    the mean of their y axes' opposites.
    """
    above = -poses[:, :3, 1].mean(axis=0)
    rights = poses[:, :3, 0]
    _, axes = np.linalg.eigh(rights.T @ rights / len(poses) - 0.01 * np.outer(above, above))
    up: Doubles = axes[:, 0] if axes[:, 0] @ above > 0 else -axes[:, 0]
    return up


def _clusters(targets: _Targets, size: float) -> list[tuple[Doubles, Doubles]]:
    """Return the middles and mean normals of what lies in boxes of a size, the largest."""
    share = targets.areas * targets.weights
    _, box = np.unique(
        np.floor(targets.points / size).astype(np.int64), axis=0, return_inverse=True)
    box = box.reshape(-1)
    total = np.bincount(box, share)
    middles = np.column_stack([np.bincount(box, share * x) for x in targets.points.T])
    normals = np.column_stack([np.bincount(box, share * x) for x in targets.normals.T])
    lengths = np.linalg.norm(normals, axis=1)
    largest = np.argsort(-lengths, kind='stable')[:_CLUSTERS]
    return [
        (middles[n] / total[n], normals[n] / lengths[n]) for n in largest if lengths[n] > 0]


def _directions(normal: Doubles) -> list[Doubles]:
    """Return a direction and others about it."""
    east = np.cross(normal, np.eye(3)[np.argmin(np.abs(normal))])
    east /= np.linalg.norm(east)
    north = np.cross(normal, east)
    turns = 2 * np.pi * np.arange(_TILTS) / _TILTS
    return [normal, *(
        np.cos(_TILT) * normal + np.sin(_TILT) * (np.cos(a) * east + np.sin(a) * north)
        for a in turns)]


def _looking(eye: Doubles, forward: Doubles, up: Doubles) -> Pose:
    """Return T_world_camera of a camera that is as level as those that scanned."""
    right = np.cross(forward, up)
    if np.linalg.norm(right) < 0.1:
        right = np.cross(forward, np.eye(3)[np.argmin(np.abs(forward))])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    T[:3, 3] = eye
    return T


def _best(
    candidates: Doubles, gains: Floats, targets: _Targets, count: int
) -> tuple[NextView, ...]:
    """Return the view that gains most, the one that gains most of the rest, and so on."""
    views: list[NextView] = []
    first = 0.0
    while len(views) < count and len(candidates):
        total = gains.sum(axis=1)
        best = int(total.argmax())
        first = first or float(total[best])
        if not total[best] > _LEAST * first:
            break
        gain = gains[best].copy()
        seen = gain > 0
        middle = np.average(targets.points[seen], axis=0, weights=gain[seen])
        middlemost = np.linalg.norm(targets.points[seen] - middle, axis=1).argmin()
        views.append(NextView(
            targets.points[seen][middlemost], float(targets.areas[seen].sum()), candidates[best]))
        gains[:, seen] = 0
    return tuple(views)
