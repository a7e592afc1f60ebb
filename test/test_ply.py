# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A snapshot is read whole by this package and by other programs, or is not there at all."""
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
from plyfile import PlyData
import pytest

from gr2t_ros.core.colour import Colouring, colours
from gr2t_ros.core.view_mesh import ViewMesh
from gr2t_ros.errors import Gr2tError, InputError
from gr2t_ros.io import ply

COLOURING = Colouring('likelihood', 2.0, 'turbo')


def grid(size: int = 9, stride: int = 1, z: float = 1.0) -> ViewMesh:
    """Return a plane of size x size vertices whose likelihoods differ everywhere."""
    v, u = np.mgrid[0:size:stride, 0:size:stride]
    vertices = np.stack([0.1 * u, 0.1 * v, np.full(u.shape, z)], axis=-1).reshape(-1, 3)
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


def two_views(stride: int) -> Iterable[tuple[int, ViewMesh]]:
    """Return two views' meshes, numbered 4 and 7."""
    return [(4, grid(stride=stride, z=1.0)), (7, grid(stride=stride, z=2.0))]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """Return a file with two_views, in a folder that had to be made."""
    return ply.write_views(tmp_path / 'new' / 'mesh.ply', two_views, COLOURING).path


def test_what_is_written_is_read_back(file: Path) -> None:
    found = ply.read(file)
    one, two = grid(z=1.0), grid(z=2.0)
    mesh = found.mesh
    np.testing.assert_allclose(
        mesh.vertices, np.concatenate([one.vertices, two.vertices]), rtol=1e-6)
    np.testing.assert_array_equal(mesh.faces[:len(one.faces)], one.faces)
    np.testing.assert_array_equal(mesh.faces[len(one.faces):], two.faces + len(one.vertices))
    np.testing.assert_array_equal(mesh.edges[len(one.edges):], two.edges + len(one.vertices))
    np.testing.assert_array_equal(mesh.edge_likelihood, np.tile(one.edge_likelihood, 2))
    for name in ('vertex_likelihood', 'vertex_sigma', 'vertex_confidence'):
        np.testing.assert_array_equal(getattr(mesh, name), np.tile(getattr(one, name), 2))
    np.testing.assert_array_equal(np.unique(found.vertex_view), [4, 7])
    np.testing.assert_array_equal(
        found.vertex_colours, colours(mesh.vertex_likelihood, 2.0, 'turbo'))


def test_colours_may_show_the_deviation(tmp_path: Path) -> None:
    """An edge has the colour of its vertices' mean; likelihoods stay what they are."""
    colouring = Colouring('sigma', 4e-4, 'jet')
    path = ply.write_views(tmp_path / 'mesh.ply', two_views, colouring).path
    found = ply.read(path)
    sigma = found.mesh.vertex_sigma
    np.testing.assert_array_equal(found.vertex_colours, colours(4e-4 - sigma, 4e-4, 'jet'))
    np.testing.assert_array_equal(found.mesh.edge_likelihood, ply.read(
        ply.write_views(tmp_path / 'other.ply', two_views, COLOURING).path).mesh.edge_likelihood)
    edges = PlyData.read(str(path))['gr2t_edge']
    np.testing.assert_array_equal(
        np.stack([edges[name] for name in ('red', 'green', 'blue')], axis=-1),
        colours(4e-4 - sigma[found.mesh.edges].mean(axis=1), 4e-4, 'jet'))


def test_the_header_is_that_of_the_design(file: Path) -> None:
    header = file.read_bytes().split(b'end_header')[0].decode().splitlines()
    assert header[1] == 'format binary_little_endian 1.0'
    colour = ['property uchar red', 'property uchar green', 'property uchar blue']
    assert [line for line in header if not line.startswith('comment')][2:] == [
        'element vertex 162', 'property float x', 'property float y', 'property float z',
        *colour, 'property float likelihood', 'property float sigma', 'property float confidence',
        'property int view',
        'element face 256', 'property list uchar int vertex_indices',
        'element gr2t_edge 416', 'property int vertex1', 'property int vertex2',
        *colour, 'property float likelihood']


def test_trimesh_reads_it_and_keeps_the_likelihood(file: Path) -> None:
    trimesh = pytest.importorskip('trimesh')
    mesh = trimesh.load(file, process=False)
    assert mesh.faces.shape == (256, 3)
    assert mesh.area == pytest.approx(2 * 0.8 ** 2, rel=1e-5)
    likelihood = mesh.metadata['_ply_raw']['vertex']['data']['likelihood']
    np.testing.assert_array_equal(
        np.ravel(likelihood), np.tile(grid().vertex_likelihood, 2))
    np.testing.assert_array_equal(
        mesh.visual.vertex_colors[:, :3], ply.read(file).vertex_colours)


def test_open3d_reads_it(file: Path) -> None:
    open3d = pytest.importorskip('open3d', exc_type=ImportError)
    mesh = open3d.io.read_triangle_mesh(str(file))
    assert len(mesh.triangles) == 256
    np.testing.assert_allclose(
        np.asarray(mesh.vertices), ply.read(file).mesh.vertices, rtol=1e-6)
    np.testing.assert_allclose(
        255 * np.asarray(mesh.vertex_colors), ply.read(file).vertex_colours, atol=0.51)


def test_meshlab_reads_it(file: Path) -> None:
    pymeshlab = pytest.importorskip('pymeshlab', exc_type=ImportError)
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(file))
    mesh = meshes.current_mesh()
    assert mesh.face_number() == 256
    assert mesh.vertex_number() == 162
    np.testing.assert_allclose(
        255 * mesh.vertex_color_matrix()[:, :3], ply.read(file).vertex_colours, atol=0.51)


def test_too_many_faces_are_decimated_and_it_is_said(tmp_path: Path) -> None:
    written = ply.write_views(tmp_path / 'mesh.ply', two_views, COLOURING, max_faces=70)
    assert written.stride == 2
    assert (written.vertices, written.edges, written.faces) == (50, 112, 64)
    assert len(ply.read(written.path).mesh.faces) == 64


def test_hopeless_strides_are_not_tried(tmp_path: Path) -> None:
    tried = []

    def meshes(stride: int) -> Iterable[tuple[int, ViewMesh]]:
        tried.append(stride)
        return two_views(stride)
    ply.write_views(tmp_path / 'mesh.ply', meshes, COLOURING, 20, expected_vertices=162)
    assert tried == [4]


def test_a_mesh_without_anything_is_a_file_too(tmp_path: Path) -> None:
    written = ply.write_views(
        tmp_path / 'mesh.ply', lambda stride: [], replace(COLOURING, scale=0.0))
    assert written.vertices == 0
    assert ply.read(written.path).mesh.faces.shape == (0, 3)


def test_a_view_of_which_nothing_is_left_may_be_among_them(tmp_path: Path) -> None:
    none = ViewMesh(
        np.zeros((0, 3)), *np.zeros((3, 0), np.float32), np.zeros((0, 3), np.int32),
        np.zeros((0, 2), np.int32), np.zeros(0, np.float32))
    written = ply.write_views(
        tmp_path / 'mesh.ply', lambda stride: [(0, none), (1, grid()), (2, none)], COLOURING)
    assert set(ply.read(written.path).vertex_view) == {1}


def test_a_full_disk_is_said_and_nothing_is_left(tmp_path: Path) -> None:
    resource = pytest.importorskip('resource')
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (3000, limits[1]))  # no file may be larger
    try:
        with pytest.raises(Gr2tError, match=r'cannot write .*mesh\.ply: File too large'):
            ply.write_views(tmp_path / 'mesh.ply', two_views, COLOURING)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert not list(tmp_path.iterdir())


def test_a_failure_leaves_the_older_file_whole(file: Path) -> None:
    before = file.read_bytes()

    def breaks(stride: int) -> Iterable[tuple[int, ViewMesh]]:
        yield 0, grid()
        raise OSError(28, 'No space left on device')

    with pytest.raises(Gr2tError, match=r'mesh\.ply: No space left on device'):
        ply.write_views(file, breaks, COLOURING)
    assert file.read_bytes() == before
    assert list(file.parent.iterdir()) == [file]


@pytest.mark.parametrize('name', ['mesh.ply', 'inside/mesh.ply'])
def test_a_place_that_cannot_be_written_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / 'mesh.ply').mkdir()
    (tmp_path / 'inside').write_text('a file where a folder is needed')
    with pytest.raises(Gr2tError, match=f'cannot write .*{name}'):
        ply.write_views(tmp_path / name, two_views, COLOURING)
    assert sorted(item.name for item in tmp_path.iterdir()) == ['inside', 'mesh.ply']


def test_other_files_are_refused_with_a_sentence(tmp_path: Path, file: Path) -> None:
    with pytest.raises(InputError, match=r'cannot read .*none\.ply: No such file'):
        ply.read(tmp_path / 'none.ply')
    other = tmp_path / 'other.ply'
    for content in (b'', b'nothing', b'\xff\xfe\x00', file.read_bytes()[:-100]):
        other.write_bytes(content)
        with pytest.raises(InputError, match=r'other\.ply is not a PLY file with likelihoods'):
            ply.read(other)
