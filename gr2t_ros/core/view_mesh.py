# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The mesh of one view: its pixel grid as vertices, edges and faces with likelihoods."""
from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .confidence import confidences, deviations
from .ray_march import Density, Rays

ROBUST_MAXIMUM = 98.0  # percentile of the likelihoods that colours refer to


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
    and two triangles (Grogan & Dahyot 2014). A removed vertex or edge takes its faces with it: the
    middle of an edge across a depth discontinuity lies in empty space, and so is unlikely.

    :param width: of the view's image, pixels
    :param stride: use every stride-th pixel of every stride-th row
    :param min_confidence: of vertices, 0 to 1
    :param min_edge_likelihood: least edge, as a fraction of the larger of its two vertices
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
    grid = np.full((v.max(initial=0) + 2, u.max(initial=0) + 2), -1, np.int32)
    grid[v, u] = np.arange(len(vertices), dtype=np.int32)
    corner, right = grid[:-1, :-1], grid[:-1, 1:]
    below, opposite = grid[1:, :-1], grid[1:, 1:]

    def edges_to(other: NDArray[np.int32]) -> tuple[NDArray[np.int32], NDArray[np.float32]]:
        exists = (corner >= 0) & (other >= 0)
        first, second = corner[exists], other[exists]
        middle = density.likelihood(
            0.5 * (vertices.take(first, 0) + vertices.take(second, 0)), pool).astype(np.float32)
        likely = middle >= min_edge_likelihood * np.maximum(likelihood[first], likelihood[second])
        return np.column_stack([first[likely], second[likely]]), middle[likely]

    (across, across_likelihood), (down, down_likelihood), (diagonal, diagonal_likelihood) = (
        edges_to(right), edges_to(below), edges_to(opposite))

    def present(pairs: NDArray[np.int32]) -> NDArray[np.bool_]:
        """Mark the grid places at which an edge of one of the three kinds begins."""
        marks = np.zeros(grid.shape, np.bool_)
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
