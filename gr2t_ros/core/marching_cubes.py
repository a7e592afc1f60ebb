# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Which triangles a cell of eight samples needs.

Marching cubes (Lorensen & Cline 1987) with a table that is made by rule rather than written down:
on each face of the cell the corners below zero are cut off one by one where they do not touch, so
that neighbours agree, and no triangle has an edge that runs across a face, so that no edge of the
surface belongs to more than two triangles.

Corner x + 2 y + 4 z of a cell is the sample (x, y, z), bit n of a case says that corner n is below
zero. Edge 4 axis + k of a cell goes along an axis, from the k-th corner whose bit of that axis is
0, in the corners' order.
"""
from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
from numpy.typing import NDArray

Loop = tuple[int, ...]
_CORNERS = range(8)


def _edge(one: int, other: int) -> int:
    """Return the number of the edge between two corners."""
    axis = (one ^ other).bit_length() - 1
    low = min(one, other)
    return 4 * axis + [corner for corner in _CORNERS if not corner >> axis & 1].index(low)


def _faces() -> Iterator[tuple[int, int, int, int]]:
    """Yield the corners of each face, anticlockwise seen from outside."""
    for axis in range(3):
        u, v = 1 << (axis + 1) % 3, 1 << (axis + 2) % 3
        yield 0, v, u + v, u
        top = 1 << axis
        yield top, top + u, top + u + v, top + v


FACES = tuple(_faces())
# the first corner of each edge, (12,), and its axis
EDGE_CORNER = np.array([
    corner for axis in range(3) for corner in _CORNERS if not corner >> axis & 1])
EDGE_AXIS = np.repeat(np.arange(3), 4)


def loops(case: int) -> list[Loop]:
    """Return the closed lines of edges that the surface crosses, anticlockwise from above zero."""
    follower = {}
    for face in FACES:
        below = [case >> corner & 1 for corner in face]
        for i in range(4):
            if not below[i - 1] and below[i]:
                # from where the face's rim goes below zero to where it comes up next
                j = i
                while below[(j + 1) % 4]:
                    j += 1
                leaves = _edge(face[j % 4], face[(j + 1) % 4])
                follower[_edge(face[i - 1], face[i])] = leaves
    found = []
    while follower:
        start, at = follower.popitem()
        line = [start]
        while at != start:
            line.append(at)
            at = follower.pop(at)
        found.append(tuple(line))
    return found


def _triangulations(polygon: Loop) -> Iterator[list[Loop]]:
    """Yield all ways to cut a polygon into triangles."""
    if len(polygon) < 3:
        yield []
        return
    for k in range(1, len(polygon) - 1):
        for left in _triangulations(polygon[:k + 1]):
            for right in _triangulations(polygon[k:]):
                yield [*left, (polygon[0], polygon[k], polygon[-1]), *right]


def _on_one_face(one: int, other: int) -> bool:
    ends = {
        int(EDGE_CORNER[edge]) | (1 << int(EDGE_AXIS[edge]) if end else 0)
        for edge in (one, other) for end in (0, 1)}
    return any(ends <= set(face) for face in FACES)


def _cut(polygon: Loop) -> list[Loop]:
    """Cut a polygon into triangles without a line across a face of the cell."""
    rim = {frozenset(pair) for pair in zip(polygon, polygon[1:] + polygon[:1])}
    for triangles in _triangulations(polygon):
        if not any(_on_one_face(*pair) for a, b, c in triangles
                   for pair in ((a, b), (b, c), (c, a)) if frozenset(pair) not in rim):
            return triangles
    raise AssertionError(f'no triangles for {polygon}')


@cache
def table() -> NDArray[np.int8]:
    """Return for each case the number of triangles, then three edges for each; (256, 16)."""
    rows = [[triangle for loop in loops(case) for triangle in _cut(loop)] for case in range(256)]
    found = np.zeros((256, 1 + 3 * max(map(len, rows))), np.int8)
    for row, triangles in zip(found, rows):
        row[0] = len(triangles)
        row[1:1 + 3 * len(triangles)] = np.ravel(triangles)
    return found
