# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""
Meshes with likelihoods as PLY files.

The header comes from, and files are read by, the library plyfile. The rows are written from
structured arrays: plyfile writes lists row by row, which takes a minute for a million faces.
"""
from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from math import ceil, sqrt
from pathlib import Path
import shutil
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement, PlyParseError

from ..core.colour import Colouring
from ..core.view_mesh import ViewMesh
from ..errors import InputError
from .files import whole_file

MAX_FACES = 5_000_000
_FACES_PER_VERTEX = 1.5  # at least, of a surface without many holes

_COLOUR = [('red', 'u1'), ('green', 'u1'), ('blue', 'u1')]
_VERTEX = np.dtype([
    ('x', '<f4'), ('y', '<f4'), ('z', '<f4'), *_COLOUR, ('likelihood', '<f4'),
    ('sigma', '<f4'), ('confidence', '<f4'), ('view', '<i4')])
_FACE = np.dtype([('vertex_indices', '<i4', (3,))])
# not 'edge': trimesh refuses a file whose edges carry more than two vertices, and builds curves
# out of those that do not
_EDGE_ELEMENT = 'gr2t_edge'
_EDGE = np.dtype([('vertex1', '<i4'), ('vertex2', '<i4'), *_COLOUR, ('likelihood', '<f4')])
_FACE_ROW = np.dtype([('length', 'u1'), ('vertex_indices', '<i4', (3,))])


@dataclass(frozen=True)
class Written:
    """
    What a file holds.

    :param stride: every n-th ray of every n-th row was written, so that the file stays readable
    """

    path: Path
    vertices: int
    edges: int
    faces: int
    stride: int


@dataclass(frozen=True, eq=False)
class PlyMesh:
    """
    A mesh read from a file of write_views.

    :param mesh: its geometry, likelihoods (1 / (px^2 m)), deviations (metres) and confidences
    :param vertex_colours: (n, 3) uint8, red green blue
    :param vertex_view: (n,) int32, the number of the keyframe that a vertex belongs to
    """

    mesh: ViewMesh
    vertex_colours: NDArray[np.uint8]
    vertex_view: NDArray[np.int32]


def write_views(
    path: Path,
    meshes: Callable[[int], Iterable[tuple[int, ViewMesh]]],
    colouring: Colouring,
    max_faces: int = MAX_FACES,
    expected_vertices: int = 0,
) -> Written:
    """
    Write the meshes of several views into one file, as a stream: one mesh in memory at a time.

    :param path: the file; written beside this name and renamed when complete
    :param meshes: from a ray stride to (number of the view, its mesh), as Reconstruction.meshes
    :param colouring: of vertices and edges
    :param max_faces: the ray stride grows until no more faces than this are written
    :param expected_vertices: about how many there are at stride 1, so that strides which give far
        too many faces are not tried
    :raises Gr2tError: if the file cannot be written; an older one is left as it was
    """
    stride = max(1, ceil(sqrt(_FACES_PER_VERTEX * expected_vertices / max_faces)))
    with whole_file(path) as out:
        while True:
            with (TemporaryFile(dir=path.parent) as vertices,
                  TemporaryFile(dir=path.parent) as faces,
                  TemporaryFile(dir=path.parent) as edges):
                counts = _spool(
                    meshes(stride), colouring, max_faces, vertices, faces, edges)
                if counts is not None:
                    out.write(_header(
                        ('vertex', _VERTEX, counts[0]), ('face', _FACE, counts[1]),
                        (_EDGE_ELEMENT, _EDGE, counts[2])))
                    for spool in (vertices, faces, edges):
                        spool.seek(0)
                        shutil.copyfileobj(spool, out, 1 << 20)
                    return Written(path, counts[0], counts[2], counts[1], stride)
            stride += 1


def _spool(
    meshes: Iterable[tuple[int, ViewMesh]], colouring: Colouring, max_faces: int,
    vertices: BinaryIO, faces: BinaryIO, edges: BinaryIO,
) -> tuple[int, int, int] | None:
    """Write the rows, return the numbers of vertices, faces, edges; None if they are too many."""
    vertex_count = face_count = edge_count = 0
    for view, mesh in meshes:
        vertex_rows = np.empty(len(mesh.vertices), _VERTEX)
        for axis, name in enumerate('xyz'):
            vertex_rows[name] = mesh.vertices[:, axis]
        _colour(vertex_rows, colouring.colours(mesh.vertex_likelihood, mesh.vertex_sigma))
        vertex_rows['likelihood'] = mesh.vertex_likelihood
        vertex_rows['sigma'] = mesh.vertex_sigma
        vertex_rows['confidence'] = mesh.vertex_confidence
        vertex_rows['view'] = view
        face_rows = _face_rows(mesh.faces + vertex_count)
        edge_rows = np.empty(len(mesh.edges), _EDGE)
        edge_rows['vertex1'] = mesh.edges[:, 0] + vertex_count
        edge_rows['vertex2'] = mesh.edges[:, 1] + vertex_count
        _colour(edge_rows, colouring.edge_colours(
            mesh.edge_likelihood, mesh.vertex_sigma, mesh.edges))
        edge_rows['likelihood'] = mesh.edge_likelihood
        vertex_count += len(vertex_rows)
        face_count += len(face_rows)
        edge_count += len(edge_rows)
        if max(face_count, vertex_count) > max_faces:
            return None
        vertices.write(vertex_rows.data)
        faces.write(face_rows.data)
        edges.write(edge_rows.data)
    return vertex_count, face_count, edge_count


def _colour(rows: NDArray[Any], colour: NDArray[np.uint8]) -> None:
    for channel, (name, _) in enumerate(_COLOUR):
        rows[name] = colour[:, channel]


def write_surface(
    path: Path,
    vertices: NDArray[np.float64],
    faces: NDArray[np.integer[Any]],
    colours: NDArray[np.uint8] | None,
    attributes: Mapping[str, NDArray[Any]],
) -> None:
    """
    Write one mesh without edges.

    :param vertices: (n, 3) world, metres
    :param faces: (m, 3) indices of vertices
    :param colours: (n, 3) red green blue
    :param attributes: name -> (n,), float32 or int32 in the file
    :raises Gr2tError: if the file cannot be written; an older one is left as it was
    """
    dtype = np.dtype([
        *_VERTEX.descr[:3], *(() if colours is None else _COLOUR),
        *((name, '<f4' if values.dtype.kind == 'f' else '<i4')
          for name, values in attributes.items())])
    rows = np.empty(len(vertices), dtype)
    for axis, name in enumerate('xyz'):
        rows[name] = vertices[:, axis]
    if colours is not None:
        for channel, (name, _) in enumerate(_COLOUR):
            rows[name] = colours[:, channel]
    for name, values in attributes.items():
        rows[name] = values
    with whole_file(path) as out:
        out.write(_header(('vertex', dtype, len(rows)), ('face', _FACE, len(faces))))
        out.write(rows.data)
        out.write(_face_rows(faces).data)


def _face_rows(faces: NDArray[np.integer[Any]]) -> NDArray[Any]:
    rows = np.empty(len(faces), _FACE_ROW)
    rows['length'] = 3
    rows['vertex_indices'] = faces
    return rows


def _header(*elements: tuple[str, np.dtype[Any], int]) -> bytes:
    """Return the header for elements: name, type of a row, number of rows."""
    described = [
        # a row that stands for all of them: a header needs their number only
        PlyElement.describe(np.broadcast_to(np.zeros((), dtype), count), name)
        for name, dtype, count in elements]
    text: str = PlyData(described, byte_order='<', comments=[
        'gr2t_ros; metres; likelihood in 1 / (px^2 m); confidence 0 to 1']).header
    return f'{text}\n'.encode('ascii')


def read(path: Path) -> PlyMesh:
    """
    Read a file that write_views wrote.

    :raises InputError: if there is no such file, or it is another kind of file
    """
    try:
        # without the length of its lists plyfile reads a file row by row
        data = PlyData.read(str(path), known_list_len={'face': {'vertex_indices': 3}})
        vertex, face, edge = data['vertex'], data['face'], data[_EDGE_ELEMENT]
        mesh = ViewMesh(
            vertices=np.stack([vertex[name] for name in 'xyz'], axis=-1).astype(np.float64),
            vertex_likelihood=np.array(vertex['likelihood'], np.float32),
            vertex_sigma=np.array(vertex['sigma'], np.float32),
            vertex_confidence=np.array(vertex['confidence'], np.float32),
            faces=np.array(face['vertex_indices'], np.int32).reshape(-1, 3),
            edges=np.stack([edge['vertex1'], edge['vertex2']], axis=-1).astype(np.int32),
            edge_likelihood=np.array(edge['likelihood'], np.float32))
        return PlyMesh(
            mesh=mesh,
            vertex_colours=np.stack([vertex[name] for name, _ in _COLOUR], axis=-1),
            vertex_view=np.array(vertex['view'], np.int32))
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error
    except (PlyParseError, KeyError, ValueError) as error:
        raise InputError(
            f'{path} is not a PLY file with likelihoods as gr2t writes it ({error})') from error
