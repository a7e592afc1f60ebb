# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Meshes with likelihoods as PLY files.

The header comes from the library plyfile. The rows are written from structured arrays: plyfile
writes lists row by row, which takes a minute for a million faces. formats.py reads these files.
"""
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from ..core.colour import Colouring
from ..core.fused_mesh import SurfaceMesh
from ..core.view_mesh import ViewMesh
from .files import whole_file

_COLOUR = [('red', 'u1'), ('green', 'u1'), ('blue', 'u1')]
_FACE = np.dtype([('vertex_indices', '<i4', (3,))])
# not 'edge': trimesh refuses a file whose edges carry more than two vertices, and builds curves
# out of those that do not
_EDGE_ELEMENT = 'gr2t_edge'
_EDGE = np.dtype([('vertex1', '<i4'), ('vertex2', '<i4'), *_COLOUR, ('likelihood', '<f4')])
_FACE_ROW = np.dtype([('length', 'u1'), ('vertex_indices', '<i4', (3,))])


@dataclass(frozen=True)
class Written:
    """What a file holds."""

    path: Path
    vertices: int
    faces: int
    edges: int = 0


def write_view(path: Path, number: int, mesh: ViewMesh, colouring: Colouring) -> Written:
    """
    Write a keyframe's mesh, with its edges.

    :param number: of the keyframe
    :raises Gr2tError: if the file cannot be written; an older one is left as it was
    """
    edges = np.empty(len(mesh.edges), _EDGE)
    edges['vertex1'], edges['vertex2'] = mesh.edges.T
    _colour(edges, colouring.edge_colours(mesh.edge_likelihood, mesh.vertex_sigma, mesh.edges))
    edges['likelihood'] = mesh.edge_likelihood
    write_mesh(
        path, mesh.vertices, mesh.faces,
        colouring.colours(mesh.vertex_likelihood, mesh.vertex_sigma),
        {'likelihood': mesh.vertex_likelihood, 'sigma': mesh.vertex_sigma,
         'confidence': mesh.vertex_confidence,
         'view': np.full(len(mesh.vertices), number, np.int32)}, edges)
    return Written(path, len(mesh.vertices), len(mesh.faces), len(mesh.edges))


def write_fused(path: Path, mesh: SurfaceMesh, colouring: Colouring) -> Written:
    """
    Write the fused mesh of a map.

    :raises Gr2tError: if the file cannot be written; an older one is left as it was
    """
    write_mesh(
        path, mesh.vertices, mesh.faces,
        colouring.colours(mesh.vertex_likelihood, mesh.vertex_sigma),
        {'likelihood': mesh.vertex_likelihood, 'sigma': mesh.vertex_sigma,
         'confidence': mesh.vertex_confidence, 'views': mesh.vertex_views})
    return Written(path, len(mesh.vertices), len(mesh.faces))


def write_mesh(
    path: Path,
    vertices: NDArray[np.float64],
    faces: NDArray[np.integer[Any]],
    colours: NDArray[np.uint8] | None,
    attributes: Mapping[str, NDArray[Any]],
    edges: NDArray[Any] | None = None,
) -> None:
    """
    Write any mesh.

    :param vertices: (n, 3) world, metres
    :param faces: (m, 3) indices of vertices
    :param colours: (n, 3) uint8, red green blue
    :param attributes: name -> (n,), float32 or int32 in the file
    :param edges: (k,) rows of the element gr2t_edge
    :raises Gr2tError: if the file cannot be written; an older one is left as it was
    """
    dtype = np.dtype([
        *((name, '<f4') for name in 'xyz'), *(() if colours is None else _COLOUR),
        *((name, '<f4' if values.dtype.kind == 'f' else '<i4')
          for name, values in attributes.items())])
    rows = np.empty(len(vertices), dtype)
    for axis, name in enumerate('xyz'):
        rows[name] = vertices[:, axis]
    if colours is not None:
        _colour(rows, colours)
    for name, values in attributes.items():
        rows[name] = values
    face_rows = np.empty(len(faces), _FACE_ROW)
    face_rows['length'] = 3
    face_rows['vertex_indices'] = faces
    elements = [('vertex', dtype, len(rows)), ('face', _FACE, len(faces))]
    if edges is not None:
        elements += [(_EDGE_ELEMENT, _EDGE, len(edges))]
    with whole_file(path) as out:
        out.write(_header(elements))
        for part in (rows, face_rows, edges):
            if part is not None:
                out.write(part.data)


def _colour(rows: NDArray[Any], colours: NDArray[np.uint8]) -> None:
    for channel, (name, _) in enumerate(_COLOUR):
        rows[name] = colours[:, channel]


def _header(elements: Sequence[tuple[str, np.dtype[Any], int]]) -> bytes:
    """Return the header for elements: name, type of a row, number of rows."""
    described = [
        # a row that stands for all of them: a header needs their number only
        PlyElement.describe(np.broadcast_to(np.zeros((), dtype), count), name)
        for name, dtype, count in elements]
    text: str = PlyData(described, byte_order='<', comments=[
        'gr2t_ros; metres; likelihood in 1 / (px^2 m); confidence 0 to 1']).header
    return f'{text}\n'.encode('ascii')

