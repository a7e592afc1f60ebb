# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A scene made of formulas, so that a demonstration needs no file from elsewhere."""
from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import PchipInterpolator
import trimesh
from trimesh.creation import icosphere, revolve
from trimesh.transformations import rotation_matrix

from .orbit import orbit

Points = NDArray[np.float64]

_SECTIONS = 160


class Scene(NamedTuple):
    """
    A scene that gr2t simulate knows by name.

    :param mesh: makes it
    :param poses: from a number of views and a distance (metres) to T_world_camera each
    :param distance: that shows it well, metres
    """

    mesh: Callable[[], trimesh.Trimesh]
    poses: Callable[[int, float], list[Points]]
    distance: float


def tabletop() -> trimesh.Trimesh:
    """Return a round table, 0.64 m wide, its top at z = 0 (up), with eight things on it."""
    things = [
        _table(),
        _placed(_bowl(), (-0.15, 0.07)),
        _placed(icosphere(subdivisions=5, radius=0.022), (-0.136, 0.065, 0.029)),
        _placed(icosphere(subdivisions=5, radius=0.016), (-0.168, 0.084, 0.026)),
        _placed(_mug(), (0.13, -0.12), turn=-1.9),
        _placed(_vase(), (0.07, 0.17)),
        _placed(_knot(), (0.0, 0.005), turn=0.4),
        _placed(_gear(), (-0.115, -0.14), turn=0.2),
        _placed(_bracket(), (0.19, 0.05), turn=0.9),
    ]
    return _joined(things)


def tabletop_poses(views: int, distance: float = 0.65) -> list[Points]:
    """
    Return cameras that move round the tabletop, above it.

    :param distance: of the cameras from the middle of the things, metres
    :return: (4, 4) float64 T_world_camera each
    """
    return orbit((0.0, 0.0, 0.03), distance, views, lowest=0.35, highest=0.9)


def _table() -> trimesh.Trimesh:
    return revolve(
        [(0, -0.03), (0.29, -0.03), (0.318, -0.012), (0.32, -0.004), (0.317, -0.001),
         (0.31, 0), (0, 0)], sections=_SECTIONS)


def _bowl() -> trimesh.Trimesh:
    return _vessel([(0, 0.032), (0.006, 0.038), (0.02, 0.059), (0.05, 0.078)], wall=0.005)


def _mug() -> trimesh.Trimesh:
    wall = 0.004
    body = _vessel([(0, 0.036), (0.004, 0.039), (0.05, 0.04), (0.096, 0.04)], wall)
    # half a ring; its open ends lie within the wall
    t = np.linspace(-np.pi / 2, np.pi / 2, 49)
    ring = np.column_stack([
        0.04 - wall / 2 + 0.03 * np.cos(t), np.zeros(len(t)), 0.05 + 0.028 * np.sin(t)])
    handle = _tube(ring, 0.0055, side=(0, 1, 0), closed=False)
    return _joined([body, handle])


def _vase() -> trimesh.Trimesh:
    return _vessel(
        [(0, 0.026), (0.01, 0.033), (0.05, 0.047), (0.09, 0.036), (0.12, 0.019), (0.14, 0.019),
         (0.16, 0.03)], wall=0.004)


def _knot() -> trimesh.Trimesh:
    """Return a trefoil knot."""
    t = np.linspace(0, 2 * np.pi, 480, endpoint=False)
    path = np.column_stack([
        np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -1.1 * np.sin(3 * t)])
    radius = 0.011
    knot = _tube(0.022 * path, radius, side=(0, 0, 1), closed=True)
    knot.apply_translation((0, 0, -knot.bounds[0, 2]))
    return knot


def _gear() -> trimesh.Trimesh:
    """Return a spur gear with a bore."""
    t = np.linspace(0, 2 * np.pi, 480, endpoint=False)
    rim = 0.05 + 0.006 * np.tanh(4 * np.cos(12 * t))
    circle = np.column_stack([np.cos(t), np.sin(t)])
    return _ring_prism(rim[:, None] * circle, 0.018 * circle, height=0.026)


def _bracket() -> trimesh.Trimesh:
    """Return an angle that stands on one of its legs."""
    leg, thick, width = 0.075, 0.012, 0.06
    outline = np.array([
        (0, 0), (leg, 0), (leg, thick), (thick, thick), (thick, leg), (0, leg)], float)
    # a ring whose hole has shrunk to a point from which all of the outline is seen
    bracket = _ring_prism(outline, np.full_like(outline, thick / 2), height=width)
    bracket.apply_transform(rotation_matrix(np.pi / 2, (1, 0, 0)))
    bracket.apply_translation((-leg / 3, width / 2, 0))
    return bracket


def _vessel(outside: list[tuple[float, float]], wall: float) -> trimesh.Trimesh:
    """
    Return a vessel that stands at z = 0.

    :param outside: (height, radius) along its outside, metres
    :param wall: its thickness, metres
    """
    heights, radii = np.array(outside).T
    radius = PchipInterpolator(heights, radii)
    z = np.linspace(0, heights[-1], 60)
    inner = np.linspace(heights[-1], wall, 60)
    profile = np.vstack([
        (0, 0), np.column_stack([radius(z), z]),
        (radius(heights[-1]) - wall / 2, heights[-1] + wall / 3),
        np.column_stack([radius(inner) - wall, inner]), (0, wall)])
    return revolve(profile, sections=_SECTIONS)


def _tube(path: Points, radius: float, side: ArrayLike, *, closed: bool) -> trimesh.Trimesh:
    """
    Return a round tube along a path.

    :param path: (n, 3) metres
    :param side: (3,) a direction that the path never takes
    """
    if closed:
        tangents = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    else:
        tangents = np.gradient(path, axis=0)
    first = _unit(np.cross(tangents, np.asarray(side, float)))
    second = _unit(np.cross(tangents, first))
    t = np.linspace(0, 2 * np.pi, 40, endpoint=False)[:, None]
    rings = path[:, None] + radius * (
        np.cos(t) * first[:, None] + np.sin(t) * second[:, None])
    return trimesh.Trimesh(
        rings.reshape(-1, 3), _grid_faces(len(path), len(t), closed=closed), process=False)


def _ring_prism(outer: Points, inner: Points, height: float) -> trimesh.Trimesh:
    """
    Return an upright prism with a hole, from z = 0.

    :param outer: (n, 2) counter-clockwise outline, metres
    :param inner: (n, 2) likewise of the hole; each point sees the same point of the outline
    """
    rings = np.stack([
        np.insert(ring, 2, z, axis=1) for ring, z in (
            (inner, 0.0), (outer, 0.0), (outer, height), (inner, height))])
    prism = trimesh.Trimesh(rings.reshape(-1, 3), _grid_faces(4, len(outer), closed=True))
    prism.update_faces(prism.nondegenerate_faces())
    return prism


def _grid_faces(rows: int, columns: int, *, closed: bool) -> NDArray[np.int64]:
    """Return the triangles of a grid whose columns close, and whose rows may."""
    i, j = np.mgrid[0:rows if closed else rows - 1, 0:columns]
    here, right = i * columns + j, i * columns + (j + 1) % columns
    i = (i + 1) % rows
    up, both = i * columns + j, i * columns + (j + 1) % columns
    return np.concatenate([
        np.stack([here, right, both], axis=-1).reshape(-1, 3),
        np.stack([here, both, up], axis=-1).reshape(-1, 3)])


def _placed(
    mesh: trimesh.Trimesh, place: tuple[float, ...], turn: float = 0.0
) -> trimesh.Trimesh:
    """Turn a thing about z (radians) and move it (metres)."""
    mesh.apply_transform(rotation_matrix(turn, (0, 0, 1)))
    mesh.apply_translation((*place, 0.0)[:3])
    return mesh


def _joined(things: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    joined = trimesh.util.concatenate(things)
    assert isinstance(joined, trimesh.Trimesh)
    return joined


def _unit(vectors: Points) -> Points:
    lengths: Points = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / lengths


SCENES = {'tabletop': Scene(tabletop, tabletop_poses, 0.65)}
