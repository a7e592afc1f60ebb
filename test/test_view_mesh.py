# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""A view's mesh: the grid's edges and faces, and what the thresholds cut."""
import numpy as np
import pytest
from scenes_for_tests import looking_at_origin, plane_view, pose
import trimesh

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.exact_density import ExactDensity
from gr2t_ros.core.ray_march import march, rays_of
from gr2t_ros.core.view import View
from gr2t_ros.core.view_mesh import view_mesh

WIDTH, HEIGHT = 40, 30
CAMERA = Camera(WIDTH, HEIGHT, 80.0, 80.0, 19.5, 14.5)


def mesh_of(depth, stride=1, T=None, others=(), **thresholds):
    T = np.eye(4) if T is None else T
    view = View(depth.astype(np.float32), CAMERA, T, 0)
    density = ExactDensity(1.5, 0.003)
    density.add(view)
    for other in others:
        density.add(other)
    rays = rays_of(density, view, 1, 'robust')
    march(density, rays, np.arange(len(rays.pixels)))
    return density, view_mesh(
        density, rays, WIDTH, stride, thresholds.get('vertex', 0.08), thresholds.get('edge', 0.5))


def test_a_whole_grid_has_all_its_edges_once_and_two_faces_a_square():
    _, mesh = mesh_of(np.full((HEIGHT, WIDTH), 0.5))
    assert len(mesh.vertices) == WIDTH * HEIGHT
    assert len(mesh.faces) == 2 * (WIDTH - 1) * (HEIGHT - 1)
    assert len(mesh.edges) == (
        (WIDTH - 1) * HEIGHT + WIDTH * (HEIGHT - 1) + (WIDTH - 1) * (HEIGHT - 1))
    assert len(np.unique(np.sort(mesh.edges, axis=1), axis=0)) == len(mesh.edges)
    # each face is bounded by edges of the list
    known = {tuple(edge) for edge in np.sort(mesh.edges, axis=1).tolist()}
    sides = np.sort(np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]],
                                    mesh.faces[:, [2, 0]]]), axis=1)
    assert {tuple(side) for side in sides.tolist()} == known


def test_faces_look_at_the_camera():
    T = pose([0.3, -0.8, 0.2], [1, 2, 3])
    _, mesh = mesh_of(np.full((HEIGHT, WIDTH), 0.5), T=T)
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    to_camera = T[:3, 3] - surface.triangles_center
    assert (np.sum(surface.face_normals * to_camera, axis=1) > 0).all()


def test_likelihoods_are_the_density_s_at_vertices_and_edge_middles():
    rng = np.random.default_rng(0)
    density, mesh = mesh_of(0.5 + rng.normal(0, 0.001, (HEIGHT, WIDTH)))
    np.testing.assert_allclose(
        mesh.vertex_likelihood, density.likelihood(mesh.vertices), rtol=1e-3)
    np.testing.assert_allclose(
        mesh.edge_likelihood, density.likelihood(mesh.vertices[mesh.edges].mean(axis=1)),
        rtol=1e-5)


def test_edges_over_a_depth_jump_are_cut_and_with_them_their_faces():
    depth = np.full((HEIGHT, WIDTH), 0.5)
    depth[:, 20:] = 0.6
    _, mesh = mesh_of(depth)
    assert len(mesh.vertices) == WIDTH * HEIGHT
    z = mesh.vertices[:, 2]
    assert np.ptp(z[mesh.edges], axis=1).max() < 0.01
    assert np.ptp(z[mesh.faces], axis=1).max() < 0.01
    assert len(mesh.faces) == 2 * (WIDTH - 2) * (HEIGHT - 1)
    _, uncut = mesh_of(depth, edge=0.0)
    assert len(uncut.faces) == 2 * (WIDTH - 1) * (HEIGHT - 1)


def test_a_step_is_cut_although_another_view_saw_a_surface_across_it():
    depth = np.full((HEIGHT, WIDTH), 0.5)
    depth[:, 20:] = 0.53
    # from the left: a wall at x = 0, between columns 19 and 20, closes the gap
    T = np.array([[0.0, 0, 1, -0.5], [0, 1, 0, 0], [-1, 0, 0, 0.515], [0, 0, 0, 1]])
    wall = plane_view(CAMERA, T, [1, 0, 0], 0.0)
    density, mesh = mesh_of(depth, others=[wall])
    edge = mesh.vertices[WIDTH * 15 + np.array([19, 20])]
    assert np.ptp(edge[:, 2]) == pytest.approx(0.03, abs=0.002)
    at_ends, middle = density.likelihood(edge), density.likelihood(edge.mean(axis=0)[None])
    assert middle > 0.5 * at_ends.max()  # what likelihood alone would keep
    assert np.ptp(mesh.vertices[mesh.edges][:, :, 2], axis=1).max() < 0.01
    assert len(mesh.faces) == 2 * (WIDTH - 2) * (HEIGHT - 1)


def test_a_steep_surface_stays_whole():
    normal = np.array([4.0, 0.0, -1.0]) / np.sqrt(17)
    offset = -0.5 / np.sqrt(17)
    depth = plane_view(CAMERA, np.eye(4), normal, offset).depth
    depth = np.where((depth > 0.35) & (depth < 0.8), depth, np.nan)
    columns = int(np.isfinite(depth[0]).sum())
    T = looking_at_origin(normal, 1.5)
    T[:3, 3] += [0.0, 0.0, 0.5]
    _, mesh = mesh_of(depth, others=[plane_view(CAMERA, T, normal, offset)])
    assert np.ptp(mesh.vertices[mesh.edges][:, :, 2], axis=1).max() > 0.04  # 13 h3
    # two of the grid's corners have a diagonal that nothing goes on from
    assert len(mesh.faces) >= 2 * (columns - 1) * (HEIGHT - 1) - 4


def test_a_lonely_pixel_is_removed_with_its_edges_and_faces():
    depth = np.full((HEIGHT, WIDTH), 0.5)
    depth[10:17, 10:17] = np.nan
    depth[13, 13] = 0.53
    _, whole = mesh_of(depth, vertex=0.0)
    _, mesh = mesh_of(depth)
    assert len(whole.vertices) == len(mesh.vertices) + 1
    assert mesh.vertices[:, 2].max() < 0.51
    assert mesh.faces.max() < len(mesh.vertices) and mesh.edges.max() < len(mesh.vertices)


def test_stride_and_empty_views():
    _, mesh = mesh_of(np.full((HEIGHT, WIDTH), 0.5), stride=4)
    assert len(mesh.vertices) == 10 * 8 and len(mesh.faces) == 2 * 9 * 7
    _, mesh = mesh_of(np.full((HEIGHT, WIDTH), np.nan))
    assert mesh.vertices.shape == (0, 3) and mesh.faces.shape == (0, 3)
    assert mesh.edges.shape == (0, 2) and mesh.edge_likelihood.shape == (0,)
