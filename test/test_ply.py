# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A snapshot is read whole by this package and by other programs, or is not there at all."""
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement
import pytest

from gr2t_ros.core.colour import Colouring, colours
from gr2t_ros.core.fused_mesh import SurfaceMesh
from gr2t_ros.core.view_mesh import ViewMesh
from gr2t_ros.errors import Gr2tError
from gr2t_ros.io import formats, ply

COLOURING = Colouring('likelihood', 2.0, 'turbo')
COLOUR = ('red', 'green', 'blue')


def grid(size: int = 9) -> ViewMesh:
    """Return a plane of size x size vertices whose likelihoods differ everywhere."""
    v, u = np.mgrid[0:size, 0:size]
    vertices = np.stack([0.1 * u, 0.1 * v, np.ones(u.shape)], axis=-1).reshape(-1, 3)
    i = np.arange(u.size).reshape(u.shape)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[:-1, 1:], i[1:, :-1], i[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, d], axis=-1), np.stack([a, d, b], axis=-1)])
    edges = np.concatenate([
        np.stack([i[:, :-1].ravel(), i[:, 1:].ravel()], axis=-1),
        np.stack([i[:-1].ravel(), i[1:].ravel()], axis=-1),
        np.stack([a, d], axis=-1)])
    return ViewMesh(
        vertices=vertices,
        vertex_likelihood=np.linspace(1, 2, len(vertices), dtype=np.float32),
        vertex_sigma=np.linspace(3e-4, 4e-4, len(vertices), dtype=np.float32),
        vertex_confidence=np.linspace(0.3, 0.9, len(vertices), dtype=np.float32),
        faces=faces.astype(np.int32),
        edges=edges.astype(np.int32),
        edge_likelihood=np.linspace(3, 4, len(edges), dtype=np.float32))


def fused() -> SurfaceMesh:
    """Return the same plane as if several views had seen it."""
    mesh = grid()
    return SurfaceMesh(
        mesh.vertices, mesh.vertex_likelihood, mesh.vertex_sigma, mesh.vertex_confidence,
        np.arange(len(mesh.vertices), dtype=np.int32), mesh.faces)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return the file of a keyframe's mesh, in a folder that had to be made."""
    return ply.write_view(tmp_path / 'new' / 'mesh.ply', 7, grid(), COLOURING).path


def columns(element: PlyElement, *names: str) -> NDArray[Any]:
    """Return an element's properties side by side."""
    return np.stack([element[name] for name in names], axis=-1)


def test_a_keyframe_s_mesh_is_read_back(file: Path) -> None:
    mesh, found = grid(), formats.read(file)
    np.testing.assert_allclose(found.vertices, mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    for name in ('likelihood', 'sigma', 'confidence'):
        np.testing.assert_array_equal(found.attributes[name], getattr(mesh, f'vertex_{name}'))
    assert set(found.attributes['view']) == {7}
    np.testing.assert_array_equal(
        found.colours, colours(mesh.vertex_likelihood, 2.0, 'turbo'))
    edges = PlyData.read(str(file))['gr2t_edge']
    np.testing.assert_array_equal(columns(edges, 'vertex1', 'vertex2'), mesh.edges)
    np.testing.assert_array_equal(edges['likelihood'], mesh.edge_likelihood)
    np.testing.assert_array_equal(
        columns(edges, *COLOUR), colours(mesh.edge_likelihood, 2.0, 'turbo'))


def test_a_fused_mesh_is_read_back(tmp_path: Path) -> None:
    mesh = fused()
    written = ply.write_fused(tmp_path / 'mesh.ply', mesh, COLOURING)
    assert (written.vertices, written.faces, written.edges) == (81, 128, 0)
    found = formats.read(written.path)
    np.testing.assert_allclose(found.vertices, mesh.vertices, rtol=1e-6)
    np.testing.assert_array_equal(found.faces, mesh.faces)
    assert set(found.attributes) == {'likelihood', 'sigma', 'confidence', 'views'}
    for name, values in found.attributes.items():
        np.testing.assert_array_equal(values, getattr(mesh, f'vertex_{name}'))
    np.testing.assert_array_equal(
        found.colours, colours(mesh.vertex_likelihood, 2.0, 'turbo'))


def test_colours_may_show_the_deviation(tmp_path: Path) -> None:
    """An edge has the colour of its vertices' mean; likelihoods stay what they are."""
    mesh = grid()
    path = ply.write_view(tmp_path / 'mesh.ply', 0, mesh, Colouring('sigma', 4e-4, 'jet')).path
    sigma = mesh.vertex_sigma
    np.testing.assert_array_equal(
        formats.read(path).colours, colours(4e-4 - sigma, 4e-4, 'jet'))
    edges = PlyData.read(str(path))['gr2t_edge']
    np.testing.assert_array_equal(edges['likelihood'], mesh.edge_likelihood)
    np.testing.assert_array_equal(
        columns(edges, *COLOUR), colours(4e-4 - sigma[mesh.edges].mean(axis=1), 4e-4, 'jet'))


def header(file: Path) -> list[str]:
    """Return the lines of a header, without comments."""
    lines = file.read_bytes().split(b'end_header')[0].decode().splitlines()
    assert lines[:2] == ['ply', 'format binary_little_endian 1.0']
    return [line for line in lines[2:] if not line.startswith('comment')]


def test_the_headers_are_those_of_the_design(file: Path, tmp_path: Path) -> None:
    colour = ['property uchar red', 'property uchar green', 'property uchar blue']
    vertex = [
        'element vertex 81', 'property float x', 'property float y', 'property float z',
        *colour, 'property float likelihood', 'property float sigma', 'property float confidence']
    face = ['element face 128', 'property list uchar int vertex_indices']
    assert header(file) == [
        *vertex, 'property int view', *face,
        'element gr2t_edge 208', 'property int vertex1', 'property int vertex2',
        *colour, 'property float likelihood']
    path = ply.write_fused(tmp_path / 'mesh.ply', fused(), COLOURING).path
    assert header(path) == [*vertex, 'property int views', *face]


def test_open3d_reads_it(file: Path) -> None:
    open3d = pytest.importorskip('open3d', exc_type=ImportError)
    mesh = open3d.io.read_triangle_mesh(str(file))
    assert len(mesh.triangles) == 128
    np.testing.assert_allclose(np.asarray(mesh.vertices), grid().vertices, rtol=1e-6)
    np.testing.assert_allclose(
        255 * np.asarray(mesh.vertex_colors), formats.read(file).colours, atol=0.51)


def test_meshlab_reads_it(file: Path) -> None:
    pymeshlab = pytest.importorskip('pymeshlab', exc_type=ImportError)
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(file))
    mesh = meshes.current_mesh()
    assert mesh.face_number() == 128
    assert mesh.vertex_number() == 81
    np.testing.assert_allclose(
        255 * mesh.vertex_color_matrix()[:, :3], formats.read(file).colours, atol=0.51)


def test_a_mesh_without_anything_is_a_file_too(tmp_path: Path) -> None:
    none = ViewMesh(
        np.zeros((0, 3)), *np.zeros((3, 0), np.float32), np.zeros((0, 3), np.int32),
        np.zeros((0, 2), np.int32), np.zeros(0, np.float32))
    written = ply.write_view(tmp_path / 'mesh.ply', 0, none, COLOURING)
    assert (written.vertices, written.faces, written.edges) == (0, 0, 0)
    assert [element.count for element in PlyData.read(str(written.path))] == [0, 0, 0]


def test_a_full_disk_is_said_and_nothing_is_left(tmp_path: Path) -> None:
    resource = pytest.importorskip('resource')
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, limits[1]))  # no file may be larger
    try:
        with pytest.raises(Gr2tError, match=r'cannot write .*mesh\.ply: File too large'):
            ply.write_fused(tmp_path / 'mesh.ply', fused(), COLOURING)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_a_failure_leaves_the_older_file_whole(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = file.read_bytes()

    def breaks(_: int) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr(os, 'fsync', breaks)
    with pytest.raises(Gr2tError, match=r'mesh\.ply: No space left on device'):
        ply.write_fused(file, fused(), COLOURING)
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize('name', ['mesh.ply', 'inside/mesh.ply'])
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / 'mesh.ply').mkdir()
    (tmp_path / 'inside').write_text('a file where a folder is needed')
    with pytest.raises(Gr2tError, match=f'cannot write .*{name}'):
        ply.write_fused(tmp_path / name, fused(), COLOURING)
    assert sorted(item.name for item in tmp_path.iterdir()) == ['inside', 'mesh.ply']
