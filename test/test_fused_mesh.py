# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""One mesh of many views: where the surface is, closed, and incremental is batch."""
from contextlib import closing
from dataclasses import replace

import cv2
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


def wall(camera, T_world_camera, boxes):
    """Return a view of boxes (low, high), metres, world."""
    rays = np.concatenate([camera.rays, np.ones_like(camera.rays[..., :1])], axis=-1)
    directions, origin = rays @ T_world_camera[:3, :3].T, T_world_camera[:3, 3]
    depth = np.full(directions.shape[:2], np.inf)
    with np.errstate(divide='ignore', invalid='ignore'):
        for low, high in boxes:
            slabs = np.stack([(np.array(end) - origin) / directions for end in (low, high)])
            enter, leave = slabs.min(axis=0).max(axis=-1), slabs.max(axis=0).min(axis=-1)
            depth = np.where((enter <= leave) & (enter > 0), np.minimum(depth, enter), depth)
    depth[~np.isfinite(depth)] = np.nan
    return View(depth.astype(np.float32), camera, T_world_camera, 0)


def noisy(views, sigma):
    rng = np.random.default_rng(1)
    return [View((view.depth + rng.normal(0, sigma, view.depth.shape)).astype(np.float32),
                 view.camera, view.T_world_camera, n) for n, view in enumerate(views)]


def test_planes_of_many_noisy_views_are_one_layer():
    views = noisy([
        plane_view(CAMERA, pose([0.05 * n, 0.03 * n, 0], [0, 0, 0]), [0, 0, 1], 0.5)
        for n in range(-3, 4)], 0.003)
    mesh = fused(views)
    assert abs(mesh.vertices[:, 2] - 0.5).mean() < 0.001
    facing = -normals(mesh)[:, 2]  # the camera is at smaller z
    assert (facing > 0).all() and edge_counts(mesh).max() == 2
    # one layer has the area of what it covers
    covered = np.unique(np.floor(mesh.vertices[mesh.faces].mean(axis=1)[:, :2] / VOXEL), axis=0)
    assert 0.5 * facing.sum() < 1.02 * len(covered) * VOXEL ** 2


def test_a_corner_stays_a_corner():
    box = ([-0.1, -0.1, -0.1], [0.1, 0.1, 0.1])
    views = [wall(CAMERA, looking_at_origin([x, y, z], 0.6), [box])
             for x in (-1, 1) for y in (-1, 1) for z in (-0.8, 0.8)]
    mesh = fused(views)
    outside = np.maximum(np.abs(mesh.vertices) - 0.1, 0)
    inside = np.abs(np.abs(mesh.vertices).max(axis=1) - 0.1)
    off = np.where(outside.any(axis=1), np.linalg.norm(outside, axis=1), inside)
    assert np.mean(off) < 0.001 and off.max() < 1.5 * VOXEL
    assert (edge_counts(mesh) <= 2).all()


def test_a_thin_wall_seen_from_both_sides_keeps_them():
    box = ([-0.15, -0.15, -0.02], [0.15, 0.15, 0.02])  # 8 voxels, 10 h3
    views = [wall(CAMERA, looking_at_origin([x, 0.1, z], 0.6), [box])
             for x in (-0.3, 0.3) for z in (-1, 1)]
    mesh = fused(views)
    flat = (np.abs(mesh.vertices[:, :2]) < 0.12).all(axis=1)
    assert np.mean(mesh.vertices[flat, 2] > 0) == pytest.approx(0.5, abs=0.05)
    assert abs(np.abs(mesh.vertices[flat, 2]) - 0.02).max() < 0.4 * VOXEL
    sides = normals(mesh)[flat[mesh.faces].all(axis=1), 2]
    centres = mesh.vertices[mesh.faces][flat[mesh.faces].all(axis=1)].mean(axis=1)[:, 2]
    assert (sides * centres > 0).all()


@pytest.mark.parametrize('gap', [0.03, 0.06, 0.3])
def test_no_face_bridges_free_space(gap):
    """A board before a wall: between them is nothing, although cameras see both side by side."""
    boxes = [([-0.1, -0.1, 0.0], [0.1, 0.1, 0.02]), ([-1, -1, 0.02 + gap], [1, 1, 0.1 + gap])]
    views = noisy([
        wall(CAMERA, looking_at_origin([x, 0.1 + 0.2 * x, -1], 0.6), boxes)
        for x in (-0.4, -0.2, 0.0, 0.2, 0.4)], 0.001)
    mesh = fused(views)
    corners = mesh.vertices[mesh.faces][..., 2]
    assert np.mean(corners < 0.01) > 0.03 and np.mean(corners > 0.01 + gap) > 0.5
    assert np.ptp(corners, axis=1).max() < 0.5 * gap + VOXEL
    # the board's rim may bend back by no more than the band in which depths count
    between = (corners > 0.02 + 0.012) & (corners < 0.02 + gap - 0.012)
    assert not between.any()


BACK = ([-1, -1, 0.5], [1, 1, 0.6])


def seen_from(xs, *boxes):
    return [wall(CAMERA, pose([0, 0, 0], [x, 0, 0]), [BACK, *boxes]) for x in xs]


def test_what_more_views_see_through_than_see_is_no_surface():
    phantom_view = plane_view(CAMERA, np.eye(4), [0, 0, 1], 0.3)  # 0.2 m before the wall
    others = [wall(CAMERA, pose([0, 0, 0], [x, 0, -0.1]), [BACK]) for x in (-0.01, 0.01)]
    with closing(built([phantom_view, others[0]])) as reconstruction:
        tied = reconstruction.fused_mesh()
        before = {key: reconstruction.fused_region(key) for key in reconstruction.fused_regions}
        reconstruction.add(others[1])
        changed = reconstruction.fuse()
        regions = {key: reconstruction.fused_region(key) for key in reconstruction.fused_regions}
        mesh = reconstruction.fused_mesh()
        del reconstruction.keyframes[2]
        changed_back = reconstruction.fuse()
        back = reconstruction.fused_mesh()
    assert (abs(tied.vertices[:, 2] - 0.3) < VOXEL).sum() > 500
    assert (mesh.vertices[:, 2] > 0.48).all()
    phantom = {
        key for key, region in before.items()
        if len(region.faces) and region.vertices[:, 2].min() < 0.32}
    assert phantom and phantom <= set(changed)
    for key in set(regions) - set(changed):
        assert_same(regions[key], before[key])
    # the wall behind it, which one view does not see, stays
    assert len(mesh.faces) > 0.9 * len(fused(others).faces)
    batch = fused([phantom_view, *others], SETTINGS.updated({'threads': 4}))
    assert_same(in_order(mesh), in_order(batch))
    assert (abs(back.vertices[:, 2] - 0.3) < VOXEL).sum() > 500 and phantom <= set(changed_back)


def test_a_patch_that_many_see_and_some_see_through_stays_until_its_keyframes_leave():
    patch = ([-0.05, -0.05, 0.3], [0.05, 0.05, 0.31])
    views = [*seen_from([-0.02, 0.0, 0.02], patch), *seen_from([-0.03, 0.03])]
    with closing(built(views)) as reconstruction:
        mesh = reconstruction.fused_mesh()
        assert (abs(mesh.vertices[:, 2] - 0.3) < VOXEL).sum() > 50
        del reconstruction.keyframes[:2]
        changed = reconstruction.fuse()
        left = reconstruction.fused_mesh()
        here = {tuple(np.floor(point / (64 * VOXEL)).astype(int)) for point in mesh.vertices[
            abs(mesh.vertices[:, 2] - 0.3) < VOXEL]}
    assert (left.vertices[:, 2] > 0.48).all() and here <= set(changed)


def test_a_thin_rod_that_all_see_stays():
    rod = ([-0.008, -0.15, 0.29], [0.008, 0.15, 0.306])  # six pixels wide
    mesh = fused(noisy(seen_from([-0.1, -0.05, 0.0, 0.05, 0.1], rod), 0.001))
    front = mesh.vertices[abs(mesh.vertices[:, 2] - 0.29) < VOXEL]
    assert np.ptp(front[:, 1]) > 0.12 and abs(front[:, 0]).max() < 0.008 + 2 * VOXEL


def test_edges_have_two_faces_at_most_however_wild_the_surface():
    rng = np.random.default_rng(3)
    views = []
    for n in range(6):
        view = sphere_views(6)[n]
        rough = cv2.GaussianBlur(rng.normal(0, 1, view.depth.shape), (0, 0), 1.5)
        views.append(View((view.depth + 0.03 * rough).astype(np.float32), CAMERA,
                          view.T_world_camera, n))
    mesh = fused(views)
    assert len(mesh.faces) > 1000 and edge_counts(mesh).max() == 2


def test_far_from_the_origin_nothing_is_rounded():
    here = sphere_views(6)
    away = np.array([2.0 ** 13, -2.0 ** 12, 2.0 ** 10]) * 8 * VOXEL
    there = []
    for view in here:
        T = view.T_world_camera.copy()
        T[:3, 3] += away
        there.append(View(view.depth, view.camera, T, 0))
    near, far = in_order(fused(here)), fused(there)
    moved = in_order(replace(far, vertices=far.vertices - away))
    assert len(near.vertices) == len(moved.vertices)
    assert abs(near.vertices - moved.vertices).max() < 1e-6 * VOXEL


def test_another_threshold_makes_the_map_anew():
    with closing(built(sphere_views(6))) as reconstruction:
        before = reconstruction.fused_mesh()
        reconstruction.settings = SETTINGS.updated({'min_confidence': 0.7})
        assert reconstruction.fuse()
        fewer = in_order(reconstruction.fused_mesh(1))
        assert 0 < len(fewer.faces) < len(before.faces)
    with closing(built(sphere_views(6), reconstruction.settings)) as again:
        assert_same(fewer, in_order(again.fused_mesh(1)))


def test_what_leaves_memory_leaves_the_fused_map():
    near, far = (plane_view(CAMERA, pose([0, 0, 0], [x, 0, 0]), [0, 0, 1], 0.5) for x in (0, 2))
    with closing(built([near, far])) as reconstruction:
        both = reconstruction.fused_mesh()
        size = reconstruction.fused.nbytes
        left = reconstruction.keyframes.pop(0)
        changed = reconstruction.fuse()
        mesh = reconstruction.fused_mesh()
        assert 0 < len(mesh.faces) < len(both.faces) and mesh.vertices[:, 0].min() > 1.5
        assert changed and all(
            len(reconstruction.fused_region(key).faces) == 0 for key in changed)
        assert reconstruction.fused.nbytes < 0.7 * size
        reconstruction.keyframes.insert(0, left)
        reconstruction.fuse()
        assert_same(in_order(reconstruction.fused_mesh()), in_order(both))


def test_small_islands_are_left_out():
    box = ([-0.1, -0.1, 0.4], [0.05, 0.1, 0.5])
    speck = ([0.08, 0.0, 0.4], [0.1, 0.02, 0.5])
    views = [wall(CAMERA, pose([0, 0, 0], [x, 0, 0]), [box, speck]) for x in (-0.02, 0, 0.02)]
    with closing(built(views)) as reconstruction:
        all_of_it, large = reconstruction.fused_mesh(1), reconstruction.fused_mesh(200)
    assert all_of_it.vertices[:, 0].max() > 0.08 > 0.06 > large.vertices[:, 0].max()
    assert len(large.faces) > 0.8 * len(all_of_it.faces)
