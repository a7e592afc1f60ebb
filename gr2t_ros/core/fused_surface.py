# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
The surface where the fused map's distance is zero, as triangles.

A vertex lies on an edge of the grid, and belongs to the block of the edge's first voxel; so blocks
share the vertices at their borders. Edges are numbered 512 axis + voxel within a block.
"""
from __future__ import annotations

from concurrent.futures import Executor
from typing import NamedTuple

from numba import int64, njit, uint64
import numpy as np
from numpy.typing import NDArray

from .blocks import place_of, SIDE, VOXELS
from .compiled import run_all, uncounted
from .fused_grid import find_corners, Grid, moved, projected, said, sees, Views, WEIGHT
from .fused_view import Bandwidth
from .marching_cubes import EDGE_AXIS, EDGE_CORNER, table
from .seen_through import sees_through

Doubles = NDArray[np.float64]
Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

MIN_WEIGHT = 0.03  # of a vertex; 1 is one view that faces the surface and agrees with the others
_PER_WEIGHT = np.float32(1 / WEIGHT)
_WIDE = SIDE + 1
_END = 0.001  # of an edge
_WORDS = 3 * VOXELS // 64
_BLOCKS = 64  # a task
_EDGE_CORNER, _EDGE_AXIS = EDGE_CORNER.astype(np.int64), EDGE_AXIS.astype(np.int64)


class Surface(NamedTuple):
    """
    Triangles, and what the views say of their vertices.

    :param vertices: (n, 3) float64, world, metres
    :param sigma: (n,) float32, metres across the surface; confidence: (n,) float32, 0 to 1
    :param views: (n,) int32, how many views see the vertex
    :param outside: (n,) bool: whether triangles of other blocks may use the vertex
    :param faces: (m, 3) int32, anticlockwise seen from outside
    """

    vertices: Doubles
    sigma: Floats
    confidence: Floats
    views: Ints
    outside: NDArray[np.bool_]
    faces: Ints


class _Edges(NamedTuple):
    """
    Which edges of some blocks hold a vertex.

    :param block: (n,) int32
    :param number: (size of the grid,) int32, where a block is in block, -1 for the others
    :param words: (n, 24) uint64, a bit for each edge
    :param first: (n + 1,) int64, the number of the block's first vertex
    :param before: (n, 24) int64, the number of each word's first vertex
    """

    block: Ints
    number: Ints
    words: NDArray[np.uint64]
    first: NDArray[np.int64]
    before: NDArray[np.int64]


def surface(
    grid: Grid, blocks: Ints, views: Views, bandwidth: Bandwidth, sigma: Bandwidth, voxel: float,
    pool: Executor | None,
) -> Surface:
    """
    Return the surface in the cells of some blocks, less what more views see through than see.

    :param blocks: (n,) int32
    :param sigma: see fused_view.spread
    :param voxel: metres
    """
    edges = _edges(grid, blocks, pool)
    count = int(edges.first[-1])
    vertices = np.zeros((count, 3))
    sums = np.zeros((count, 3))
    support, through = np.zeros(count, np.int32), np.zeros(count, np.int32)
    owners = range(0, len(edges.block), _BLOCKS)
    run_all(pool, _place, [
        (grid, edges, i, min(i + _BLOCKS, len(edges.block)), voxel, vertices) for i in owners])
    run_all(pool, _judge, [
        (grid, edges, i, min(i + _BLOCKS, len(edges.block)), views, bandwidth, sigma, voxel,
         vertices, sums, support, through, np.zeros((27, 4))) for i in owners])
    parts = [blocks[i:i + _BLOCKS] for i in range(0, len(blocks), _BLOCKS)]
    faces = run_all(pool, _triangles, [(grid, edges, part, table()) for part in parts])
    joined = np.concatenate([np.zeros((0, 3), np.int32), *faces])
    joined = joined[(through <= support)[joined].all(axis=1)]
    outside, within = np.zeros(count, np.bool_), np.zeros(len(edges.block), np.bool_)
    within[edges.number[blocks]] = True
    _mark_outside(grid, edges, within, outside)
    means = (sums[:, 1:] / np.maximum(sums[:, :1], 1e-12)).astype(np.float32)
    return used(Surface(vertices, means[:, 0], means[:, 1], support, outside, joined))


def used(whole: Surface) -> Surface:
    """Return a surface without the vertices that no triangle has."""
    kept = np.zeros(len(whole.vertices), np.bool_)
    kept[whole.faces] = True
    number = np.cumsum(kept, dtype=np.int32) - np.int32(1)
    return Surface(
        whole.vertices[kept], whole.sigma[kept], whole.confidence[kept], whole.views[kept],
        whole.outside[kept], number[whole.faces])


def _edges(grid: Grid, blocks: Ints, pool: Executor | None) -> _Edges:
    """Return the edges with a vertex, of the blocks and those that their cells reach into."""
    number = np.full(grid.size, -1, np.int32)
    owners = _with_next(grid, blocks, number)
    words = np.zeros((len(owners), _WORDS), np.uint64)
    first = np.zeros(len(owners) + 1, np.int64)
    run_all(pool, _crossings, [
        (grid, owners[i:i + _BLOCKS], words[i:i + _BLOCKS], first[i + 1:i + 1 + _BLOCKS],
         np.zeros(_WIDE ** 3, np.float32), np.zeros(_WIDE ** 3, np.float32))
        for i in range(0, len(owners), _BLOCKS)])
    first = np.cumsum(first)
    before = np.zeros(words.shape, np.int64)
    _count(words, first, before)
    return _Edges(owners, number, words, first, before)


@njit(cache=True, nogil=True)
def _count(
    words: NDArray[np.uint64], first: NDArray[np.int64], before: NDArray[np.int64]
) -> None:
    """Write the number of each word's first vertex."""
    for owner in range(len(words)):
        number = first[owner]
        for n in range(_WORDS):
            before[owner, n] = number
            number += _ones(words[owner, n])


@njit(cache=True, nogil=True)
def _with_next(grid: Grid, blocks: Ints, number: Ints) -> Ints:
    """Return the blocks and their neighbours towards larger coordinates; number them."""
    out = np.zeros(8 * len(blocks), np.int32)
    count = 0
    for block in blocks:
        for n in range(8):
            other = grid.neighbour[block, _to_next(n)] if n else block
            if other != 0 and number[other] < 0:
                number[other] = count
                out[count] = other
                count += 1
    return out[:count].copy()


@njit(cache=True, nogil=True)
def _to_next(n: int) -> int:
    """Return which of the 27 neighbours is one farther on the axes that are bits of n."""
    return 13 + (n & 1) + 3 * (n >> 1 & 1) + 9 * (n >> 2)


@uncounted(error_model='numpy')
def _gather(grid: Grid, block: int, value: Floats, weight: Floats) -> bool:
    """
    Write a block's samples and those next to it, 9 x 9 x 9; the weight is 0 where there is none.

    :return: whether there are samples on both sides of the surface
    """
    below, above = 0, 0
    for n in range(8):
        other = int64(grid.neighbour[block, _to_next(n)]) if n else int64(block)
        x0, y0, z0 = n & 1, n >> 1 & 1, n >> 2
        for k in range(1 if z0 else SIDE):
            for j in range(1 if y0 else SIDE):
                to = (((k + SIDE * z0) * _WIDE) + j + SIDE * y0) * _WIDE + SIDE * x0
                source = other * VOXELS + (k * SIDE + j) * SIDE
                for i in range(1 if x0 else SIDE):
                    total = grid.weight[source + i]
                    weight[to + i] = total * _PER_WEIGHT
                    if total == 0:
                        value[to + i] = 0
                        continue
                    value[to + i] = np.float32(grid.distance[source + i]) / np.float32(total)
                    if value[to + i] < 0:
                        below += 1
                    else:
                        above += 1
    return below > 0 and above > 0


@uncounted(error_model='numpy')
def _crossings(
    grid: Grid, owners: Ints, words: NDArray[np.uint64], counts: NDArray[np.int64],
    value: Floats, weight: Floats,
) -> None:
    """Mark the edges on which the distance goes through zero and the weight suffices."""
    for owner in range(len(owners)):
        if not _gather(grid, owners[owner], value, weight):
            continue
        for axis in range(3):
            step = _WIDE ** axis
            for n in range(VOXELS):
                at = ((n >> 6) * _WIDE + (n >> 3 & 7)) * _WIDE + (n & 7)
                a, b = value[at], value[at + step]
                if (a < 0) == (b < 0) or weight[at] == 0 or weight[at + step] == 0:
                    continue
                part = a / (a - b)
                if weight[at] + part * (weight[at + step] - weight[at]) < MIN_WEIGHT:
                    continue
                edge = VOXELS * axis + n
                words[owner, edge >> 6] |= uint64(1) << uint64(edge & 63)
                counts[owner] += 1


@uncounted()
def _ones(word: np.uint64) -> np.int64:
    """Return how many bits are 1."""
    word = word - (word >> uint64(1) & uint64(0x5555555555555555))
    word = (word & uint64(0x3333333333333333)) + (word >> uint64(2) & uint64(0x3333333333333333))
    word = (word + (word >> uint64(4))) & uint64(0x0F0F0F0F0F0F0F0F)
    return int64(word * uint64(0x0101010101010101) >> uint64(56))


@uncounted()
def _vertex_of(edges: _Edges, owner: int, edge: int) -> np.int64:
    """Return the number of an edge's vertex, -1 where there is none."""
    word, bit = edge >> 6, uint64(edge & 63)
    bits = edges.words[owner, word]
    if bits >> bit & uint64(1) == 0:
        return int64(-1)
    number: np.int64 = edges.before[owner, word] + _ones(
        bits & ((uint64(1) << bit) - uint64(1)))
    return number


@njit(cache=True, nogil=True)
def _triangles(grid: Grid, edges: _Edges, blocks: Ints, cases: NDArray[np.int8]) -> Ints:
    """Return the triangles in the cells of some blocks, (m, 3)."""
    value, weight = np.zeros(_WIDE ** 3, np.float32), np.zeros(_WIDE ** 3, np.float32)
    out = np.zeros((1024, 3), np.int32)
    count = 0
    for block in blocks:
        # a block has 512 cells of at most 5 triangles
        if count + 5 * VOXELS > len(out):
            longer = np.zeros((2 * len(out) + 5 * VOXELS, 3), np.int32)
            longer[:count] = out[:count]
            out = longer
        count = _cells(grid, edges, block, cases, value, weight, out, count)
    return out[:count].copy()


@uncounted()
def _cells(
    grid: Grid, edges: _Edges, block: int, cases: NDArray[np.int8], value: Floats,
    weight: Floats, out: Ints, count: int,
) -> int:
    """Append the triangles of a block, and return how many there are then."""
    if not _gather(grid, block, value, weight):
        return count
    for n in range(VOXELS):
        x, y, z = n & 7, n >> 3 & 7, n >> 6
        case = 0
        for corner in range(8):
            at = ((z + (corner >> 2)) * _WIDE + y + (corner >> 1 & 1)) * _WIDE + x + (corner & 1)
            if weight[at] == 0:
                case = 0
                break
            if value[at] < 0:
                case |= 1 << corner
        for triangle in range(cases[case, 0]):
            missing = 0
            for side in range(3):
                edge = int64(cases[case, 1 + 3 * triangle + side])
                corner = _EDGE_CORNER[edge]
                i, j, k = x + (corner & 1), y + (corner >> 1 & 1), z + (corner >> 2)
                beyond = (i >> 3) + 2 * (j >> 3) + 4 * (k >> 3)
                other = grid.neighbour[block, _to_next(beyond)] if beyond else block
                vertex = _vertex_of(
                    edges, edges.number[other],
                    VOXELS * _EDGE_AXIS[edge] + ((k & 7) * SIDE + (j & 7)) * SIDE + (i & 7))
                out[count, side] = vertex
                missing += int(vertex < 0)
            count += missing == 0
    return count


@njit(cache=True, nogil=True)
def _place(
    grid: Grid, edges: _Edges, first: int, end: int, voxel: float, vertices: Doubles
) -> None:
    """Write the vertices of some blocks."""
    value, weight = np.zeros(_WIDE ** 3, np.float32), np.zeros(_WIDE ** 3, np.float32)
    for owner in range(first, end):
        if edges.first[owner] == edges.first[owner + 1]:
            continue
        block = edges.block[owner]
        _gather(grid, block, value, weight)
        x, y, z = place_of(grid.key[block])
        vertex = edges.first[owner]
        for edge in range(3 * VOXELS):
            if edges.words[owner, edge >> 6] >> uint64(edge & 63) & uint64(1) == 0:
                continue
            axis, n = edge // VOXELS, edge % VOXELS
            i, j, k = n & 7, n >> 3 & 7, n >> 6
            at = (k * _WIDE + j) * _WIDE + i
            a, b = value[at], value[at + _WIDE ** axis]
            vertices[vertex, 0] = (SIDE * x + i) * voxel
            vertices[vertex, 1] = (SIDE * y + j) * voxel
            vertices[vertex, 2] = (SIDE * z + k) * voxel
            # never at its end, where other edges have a vertex too
            vertices[vertex, axis] += voxel * min(max(a / (a - b), _END), 1 - _END)
            vertex += 1


@uncounted(error_model='numpy')
def _judge(
    grid: Grid, edges: _Edges, first: int, end: int, views: Views, bandwidth: Bandwidth,
    sigma: Bandwidth, voxel: float, vertices: Doubles, sums: Doubles, support: Ints,
    through: Ints, corners: Doubles,
) -> None:
    """
    Add up what the views say of the vertices of some blocks: weights, sigmas, confidences.

    :param support: how many say something; through: how many see through the vertex
    """
    side = SIDE * voxel
    for owner in range(first, end):
        begin, stop = edges.first[owner], edges.first[owner + 1]
        if begin == stop:
            continue
        x, y, z = place_of(grid.key[edges.block[owner]])
        for view in range(len(views.stride)):
            find_corners(views, view, x * side, y * side, z * side, side, corners)
            if not sees(views, view, sigma, corners, 0, 2, True):
                continue
            T = views.T_camera_world[view]
            for vertex in range(begin, stop):
                at = moved(T, vertices[vertex, 0], vertices[vertex, 1], vertices[vertex, 2])
                before, u, v = projected(views, view, at[0], at[1], at[2])
                if not before:
                    continue
                weight, _, h3, cosine, confidence = said(
                    views.address[view, 0], views.size[view, 0], views.size[view, 1], bandwidth,
                    sigma, u, v, at[0], at[1], at[2])
                if weight > 0:
                    along = h3 * (1.0 / max(confidence, 0.002) - 1.0)
                    support[vertex] += 1
                    sums[vertex, 0] += weight
                    sums[vertex, 1] += weight * along * cosine
                    sums[vertex, 2] += weight * confidence
                elif sees_through(views, view, bandwidth, sigma, u, v, at[2]):
                    through[vertex] += 1


@njit(cache=True, nogil=True)
def _mark_outside(
    grid: Grid, edges: _Edges, within: NDArray[np.bool_], outside: NDArray[np.bool_]
) -> None:
    """
    Mark the vertices that cells of other blocks share.

    :param within: (n,) of the blocks in edges, whether their cells are asked for
    """
    for owner in range(len(edges.block)):
        vertex = edges.first[owner]
        for edge in range(3 * VOXELS):
            if edges.words[owner, edge >> 6] >> uint64(edge & 63) & uint64(1) == 0:
                continue
            axis, n = edge // VOXELS, edge % VOXELS
            place = (n & 7, n >> 3 & 7, n >> 6)
            for cell in range(8):  # the edge's first voxel, or one less on some of the other axes
                if cell >> axis & 1:
                    continue
                to = 13
                for other in range(3):
                    if cell >> other & 1 and place[other] == 0:
                        to -= 3 ** other
                block = grid.neighbour[edges.block[owner], to] if to != 13 else edges.block[owner]
                if block != 0:
                    number = edges.number[block]
                    outside[vertex] |= number < 0 or not within[number]
            vertex += 1
