# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One mesh of many views: where the surface is, closed, and incremental is batch."""
from contextlib import closing

import numpy as np
import pytest
from scenes_for_tests import bumpy_views, looking_at_origin, plane_view, pose, sphere_view

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.fused_mesh import SurfaceMesh
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.settings import Settings

VOXEL = 0.005
SETTINGS = Settings(
    depth_bandwidth=0.004, depth_bandwidth_quadratic=0.0, keyframe_translation=0.0, threads=2,
    voxel_size=VOXEL, depth_max=3.0)
EXACT = SETTINGS.updated({'density': 'exact'})
CAMERA = Camera(80, 60, 120.0, 120.0, 39.5, 29.5)
RADIUS = 0.12


def sphere_views(count=14):
    """Return views of a sphere from all about."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    turn = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    return [
        sphere_view(CAMERA, looking_at_origin(
            [np.cos(t) * np.sqrt(1 - z * z), np.sin(t) * np.sqrt(1 - z * z), z], 0.5), RADIUS)
        for z, t in zip(height, turn)]


def built(views, settings=SETTINGS):
    reconstruction = Reconstruction(settings)
    for view in views:
        reconstruction.add(view)
    reconstruction.finish()
    return reconstruction


def fused(views, settings=SETTINGS):
    with closing(built(views, settings)) as reconstruction:
        return reconstruction.fused_mesh()


def edge_counts(mesh):
    """Return how many faces each edge has."""
    edges = np.concatenate([mesh.faces[:, [i, (i + 1) % 3]] for i in range(3)])
    return np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)[1]


def normals(mesh):
    """Return the faces' normals, of the length of twice their areas."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


@pytest.mark.parametrize('settings', [SETTINGS, EXACT], ids=['voxel', 'exact'])
def test_a_sphere_seen_from_all_sides_is_closed_and_faces_outwards(settings):
    mesh = fused(sphere_views(), settings)
    assert (edge_counts(mesh) == 2).all()
    assert len(mesh.vertices) - len(edge_counts(mesh)) + len(mesh.faces) == 2  # Euler: no handles
    radii = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(radii - RADIUS).max() < 0.3 * VOXEL and abs(radii.mean() - RADIUS) < 0.001
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    outwards = np.einsum('ij,ij->i', normals(mesh), centres)
    assert (outwards > -1e-12).all()
    assert mesh.vertex_views.min() >= 1 and mesh.vertex_views.max() <= 14
    assert (mesh.vertex_confidence > 0.3).all() and (mesh.vertex_sigma < 0.004).all()
    assert (mesh.vertex_likelihood > 0).all()


def assert_same(one, other):
    for name in vars(one):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)


def in_order(mesh):
    """Return all that a mesh says, its vertices and faces in an order of their own."""
    order = np.lexsort(mesh.vertices.T)
    assert (np.diff(mesh.vertices[order], axis=0) != 0).any(axis=1).all()
    number = np.empty(len(order), int)
    number[order] = np.arange(len(order))
    faces = number[mesh.faces]
    faces = np.stack([np.roll(face, -face.argmin()) for face in faces])
    return SurfaceMesh(
        *(getattr(mesh, name)[order] for name in list(vars(mesh))[:-1]),
        faces[np.lexsort(faces.T)])


@pytest.mark.parametrize('settings', [SETTINGS, EXACT], ids=['voxel', 'exact'])
@pytest.mark.parametrize('stride', [1, 2])
@pytest.mark.parametrize('views', [bumpy_views(), sphere_views(6)], ids=['distorted', 'sphere'])
def test_incremental_equals_a_rebuild(views, settings, stride):
    settings = settings.updated({'ray_stride': stride})
    with closing(Reconstruction(settings)) as reconstruction:
        for view in views:
            reconstruction.add(view)
            reconstruction.fuse()
        reconstruction.finish()
        steps = in_order(reconstruction.fused_mesh(1))
    with closing(built(views, settings)) as reconstruction:
        batch = in_order(reconstruction.fused_mesh(1))
    assert len(batch.faces) > 100
    assert_same(steps, batch)


def test_one_thread_equals_four():
    one, four = (fused(sphere_views(5), SETTINGS.updated({'threads': n})) for n in (1, 4))
    assert_same(one, four)


def test_a_frozen_map_has_the_same_mesh():
    with closing(built(sphere_views(5))) as reconstruction:
        frozen = reconstruction.frozen({})
        mesh = reconstruction.fused_mesh()
        reconstruction.add(sphere_views(6)[5])
        reconstruction.fuse()
        assert_same(frozen.fused_mesh(), mesh)


def test_regions_are_the_whole_cut_up():
    with closing(built(sphere_views(), SETTINGS.updated({'voxel_size': 0.003}))) as reconstruction:
        whole = reconstruction.fused_mesh()
        regions = [reconstruction.fused_region(key) for key in reconstruction.fused_regions]
    assert sum(len(mesh.faces) > 0 for mesh in regions) >= 8
    corners = np.concatenate([mesh.vertices[mesh.faces].reshape(-1, 9) for mesh in regions])
    expected = whole.vertices[whole.faces].reshape(-1, 9)
    np.testing.assert_array_equal(
        corners[np.lexsort(corners.T)], expected[np.lexsort(expected.T)])


def test_only_regions_that_change_are_said_to():
    near = plane_view(CAMERA, np.eye(4), [0, 0, 1], 0.5)
    far = plane_view(CAMERA, pose([0, np.pi, 0], [0, 0, 0]), [0, 0, 1], -0.5)
    with closing(built([near])) as reconstruction:
        first = reconstruction.fuse()
        assert set(first) >= set(reconstruction.fused_regions) and not reconstruction.fuse()
        before = {key: reconstruction.fused_region(key) for key in first}
        reconstruction.add(far)
        second = reconstruction.fuse()
        assert second and not set(first) & set(second)
        for key, mesh in before.items():
            now = reconstruction.fused_region(key)
            np.testing.assert_array_equal(mesh.vertices, now.vertices)
            np.testing.assert_array_equal(mesh.faces, now.faces)


def test_an_empty_map_has_an_empty_mesh():
    with closing(Reconstruction(SETTINGS)) as reconstruction:
        assert reconstruction.fuse() == [] and reconstruction.fused_regions == []
        assert len(reconstruction.fused_mesh().faces) == 0
        view = sphere_views(1)[0]
        reconstruction.add(View(
            np.full_like(view.depth, np.nan), view.camera, view.T_world_camera, 0))
        assert len(reconstruction.fused_mesh().vertices) == 0
