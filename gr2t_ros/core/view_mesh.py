# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The mesh of one view: its pixel grid as vertices, edges and faces with likelihoods."""
from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .confidence import confidences, deviations
from .ray_march import Density, Floats, Rays

ROBUST_MAXIMUM = 98.0  # percentile of the likelihoods that colours refer to
_BEND = 4.0  # h3 by which an edge may be steeper than those before and after it


@dataclass(frozen=True, eq=False)
class ViewMesh:
    """
    A triangle mesh whose vertices and edges carry likelihoods (1 / (px^2 m)).

    :param vertices: (n, 3) float64, world, metres
    :param vertex_likelihood: (n,) float32
    :param vertex_sigma: (n,) float32, standard deviation along the ray of its pixel, metres
    :param vertex_confidence: (n,) float32, 0 to 1
    :param faces: (m, 3) int32, indices of vertices, anticlockwise as the camera sees them
    :param edges: (k, 2) int32, indices of vertices; each edge once
    :param edge_likelihood: (k,) float32, at the edges' barycentres
    """

    vertices: NDArray[np.float64]
    vertex_likelihood: NDArray[np.float32]
    vertex_sigma: NDArray[np.float32]
    vertex_confidence: NDArray[np.float32]
    faces: NDArray[np.int32]
    edges: NDArray[np.int32]
    edge_likelihood: NDArray[np.float32]


def view_mesh(
    density: Density,
    rays: Rays,
    width: int,
    stride: int,
    min_confidence: float,
    min_edge_likelihood: float,
    pool: Executor | None = None,
) -> ViewMesh:
    """
    Join the maxima of a view's rays to a mesh and cut it where it is doubtful.

    Neighbours i, i+1 over j, j+1 give the edges (i, i+1), (j, j+1), (i, j), (i+1, j+1), (i, j+1)
    and two triangles (Grogan & Dahyot 2014). A removed vertex or edge takes its faces with it.
    Across a depth discontinuity an edge's middle lies in empty space, and so is unlikely, or on a
    surface that other views saw; then the edge is far steeper than those before and after it.

    :param width: of the view's image, pixels
    :param stride: use every stride-th pixel of every stride-th row
    :param min_confidence: of vertices, 0 to 1
    :param min_edge_likelihood: least edge, as a fraction of the larger of its two vertices;
        0 keeps all edges
    """
    likelihood = rays.total / np.float32(max(density.size, 1))
    v, u = np.divmod(rays.pixels, width)
    found = np.flatnonzero(rays.converged & (v % stride == 0) & (u % stride == 0))
    sigma = deviations(density, rays, found)
    confidence = confidences(sigma, density.h3(rays.depth[found]))
    sure = confidence >= min_confidence
    kept, sigma, confidence = found[sure], sigma[sure], confidence[sure]
    likelihood = likelihood[kept]
    vertices = rays.points(kept)

    v, u = v[kept] // stride, u[kept] // stride
    rows, columns = v.max(initial=0) + 1, u.max(initial=0) + 1
    grid = np.full((rows + 3, columns + 3), -1, np.int32)
    grid[v + 1, u + 1] = np.arange(len(vertices), dtype=np.int32)

    def moved(down: int, across: int) -> NDArray[np.int32]:
        """Return the vertices so many rows and columns from each place of the grid, or -1."""
        return grid[1 + down:1 + down + rows, 1 + across:1 + across + columns]

    corner, right, below, opposite = moved(0, 0), moved(0, 1), moved(1, 0), moved(1, 1)
    depth = np.append(rays.depth[kept], np.float32(np.nan))  # of -1 too
    slopes = rays.table.reshape(-1, 2)[rays.pixels[kept]]  # of the rays, x / z and y / z

    def edges_to(down: int, across: int) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        other = moved(down, across)
        exists = (corner >= 0) & (other >= 0)
        first, second = corner[exists], other[exists]
        middle = density.likelihood(
            0.5 * (vertices.take(first, 0) + vertices.take(second, 0)), pool).astype(np.float32)
        stays = middle >= min_edge_likelihood * np.maximum(likelihood[first], likelihood[second])
        if min_edge_likelihood > 0:
            stays[bent(first, second, down, across)] = False
        return np.column_stack([first[stays], second[stays]]), middle[stays]

    def bent(
        first: NDArray[np.int32], second: NDArray[np.int32], down: int, across: int
    ) -> NDArray[np.int64]:
        """Return which edges are too much steeper than those before and after them."""
        one, other = depth[first], depth[second]
        most = _BEND * density.h3(np.minimum(one, other))
        steep = np.flatnonzero(np.abs(other - one) > most)  # few; the rest cannot be
        a, b = first[steep], second[steep]
        before = grid[v[a] + 1 - down, u[a] + 1 - across]
        after = grid[v[b] + 1 + down, u[b] + 1 + across]
        wide = np.linalg.norm(slopes[b] - slopes[a], axis=1) * np.minimum(depth[a], depth[b])
        bend = _bends(depth[before], depth[a], depth[b], depth[after])
        too_much: NDArray[np.int64] = steep[bend > most[steep] + wide]
        return too_much

    (across, across_likelihood), (down, down_likelihood), (diagonal, diagonal_likelihood) = (
        edges_to(0, 1), edges_to(1, 0), edges_to(1, 1))

    def present(pairs: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Mark the grid places at which an edge of one of the three kinds begins."""
        marks = np.zeros((rows + 1, columns + 1), np.bool_)
        marks[v[pairs[:, 0]], u[pairs[:, 0]]] = True
        return marks

    has_across, has_down, has_diagonal = present(across), present(down), present(diagonal)
    lower = has_diagonal[:-1, :-1] & has_down[:-1, :-1] & has_across[1:, :-1]
    upper = has_diagonal[:-1, :-1] & has_across[:-1, :-1] & has_down[:-1, 1:]
    faces = np.concatenate([
        np.column_stack([corner[lower], below[lower], opposite[lower]]),
        np.column_stack([corner[upper], opposite[upper], right[upper]])])
    return ViewMesh(
        vertices, likelihood, sigma, confidence, faces,
        np.concatenate([across, down, diagonal]),
        np.concatenate([across_likelihood, down_likelihood, diagonal_likelihood]))


def _bends(before: Floats, first: Floats, second: Floats, after: Floats) -> Floats:
    """
    Return how much steeper edges are than the steeper of the two that go on from them.

    :param before: (n,) depths of four vertices in a row each, metres; NaN where there is none
    :return: (n,) metres; a neighbour that is missing or goes the other way counts as level
    """
    step = second - first
    way = np.sign(step)
    beside = np.fmax(way * (first - before), way * (after - second))
    bend: Floats = np.abs(step) - np.fmax(beside, np.float32(0.0))
    return bend
