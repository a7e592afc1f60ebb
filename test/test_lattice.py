# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The density on the lattice is the exact one, within what its spacing can hold."""
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scenes_for_tests import bumpy_views, looking_at_origin, plane_view, pose, sphere_view

from gr2t_ros.core import blocks as lattice
from gr2t_ros.core.camera import Camera
from gr2t_ros.core.exact_density import ExactDensity
from gr2t_ros.core.ray_march import march, rays_of
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.core.voxel_density import VoxelDensity
from gr2t_ros.errors import FrameError
from gr2t_ros.settings import Settings

CAMERA = Camera(121, 90, 200.0, 200.0, 60.0, 44.5)  # a width that is no multiple of a cell's


def sphere_views(count=5):
    angles = np.linspace(0, 1.5, count)
    return [
        sphere_view(CAMERA, looking_at_origin([np.cos(a), np.sin(a), 0.3], 0.5), 0.12)
        for a in angles]


def both(views, h1=1.5, h3=0.004, quadratic=0.0, voxel=0.004, pool=None):
    exact = ExactDensity(h1, h3, quadratic)
    voxels = VoxelDensity(h1, h3, quadratic, voxel, 5.0)
    for view in views:
        exact.add(view)
        voxels.add(view, pool)
    voxels.refresh(pool)
    return exact, voxels


def marched(density, view):
    rays = rays_of(density, view, 1, 'observed')
    march(density, rays, np.arange(len(rays.pixels)))
    return rays


@pytest.mark.parametrize('h1', [1.0, 1.5, 2.5])
@pytest.mark.parametrize('quadratic', [0.0, 0.008], ids=['constant', 'quadratic'])
@pytest.mark.parametrize('views', [sphere_views(), bumpy_views()], ids=['sphere', 'cameras'])
def test_rays_end_where_the_exact_ones_do(views, quadratic, h1):
    # voxels that follow the lateral kernel, as the engine would advise
    exact, voxels = both(views, h1, quadratic=quadratic, voxel=min(0.004, 0.003 * h1))
    a, b = marched(exact, views[0]), marched(voxels, views[0])
    h3 = exact.h3(a.start)
    ok = a.converged & b.converged
    assert ok.mean() > 0.9
    difference = np.abs(a.depth - b.depth)[ok] / h3[ok]
    assert np.median(difference) < 0.05
    assert np.quantile(difference, 0.95) < 0.3
    share = b.total[ok] / a.total[ok]
    assert abs(np.median(share) - 1) < 0.01
    assert np.median(np.abs(share - 1)) < 0.015


def test_derivatives_are_those_of_the_likelihood():
    views = sphere_views()
    _, voxels = both(views)
    rays = rays_of(voxels, views[1], 7, 'observed')
    directions = rays.directions(slice(None))
    origins = np.repeat(rays.origin[None], len(directions), axis=0)
    at = rays.start + 0.0013

    def likelihood(shift):
        return voxels.likelihood(origins + (at + shift)[:, None] * directions)
    f, f1, f2 = voxels.along(origins, directions, at)
    step = 2e-5
    scale = f.max()
    np.testing.assert_allclose(f, likelihood(0.0), atol=1e-5 * scale)
    slope = (likelihood(step) - likelihood(-step)) / (2 * step)
    # the spline's slope has small steps at the voxels: nearly everywhere
    error = np.abs(f1 - slope) * 0.004 / scale
    assert np.quantile(error, 0.9) < 0.005
    _, above, _ = voxels.along(origins, directions, at + step)
    _, below, _ = voxels.along(origins, directions, at - step)
    error = np.abs(f2 - (above - below) / (2 * step)) * 0.004 ** 2 / scale
    assert np.quantile(error, 0.9) < 0.02


def test_adding_and_removing_leaves_the_map_as_it_was():
    views = sphere_views()
    _, voxels = both(views[:3])
    before = voxels.blocks.value.copy()
    expected = voxels.blocks.expected.copy()
    voxels.add(views[4])
    assert np.abs(voxels.blocks.value[:len(before)] - before).max() > 0.1 * before.max()
    voxels.remove(views[4])
    assert voxels.size == 3
    after = voxels.blocks.value
    np.testing.assert_allclose(after[:len(before)], before, atol=1e-6 * before.max())
    assert np.abs(after[len(before):]).max(initial=0) < 1e-6 * before.max()
    np.testing.assert_allclose(
        voxels.blocks.expected[:len(before)], expected, atol=1e-6 * expected.max())


def test_threads_do_not_change_a_bit():
    with ThreadPoolExecutor(4) as four:
        _, a = both(sphere_views())
        _, b = both(sphere_views(), pool=four)
    np.testing.assert_array_equal(a.blocks.key, b.blocks.key)
    np.testing.assert_array_equal(a.blocks.value, b.blocks.value)
    np.testing.assert_array_equal(a.blocks.coefficient, b.blocks.coefficient)


def test_a_map_far_from_the_origin_is_as_exact():
    views = sphere_views(2)
    shift = np.array([4096.0, -2048.0, 512.0])  # whole blocks, so that the lattices coincide
    moved = [
        View(v.depth, v.camera, pose([0, 0, 0], shift) @ v.T_world_camera, 0) for v in views]
    _, near = both(views, voxel=1 / 256)
    _, far = both(moved, voxel=1 / 256)
    a, b = marched(near, views[0]), marched(far, moved[0])
    assert np.quantile(np.abs(a.depth - b.depth), 0.999) < 0.001 * 0.004
    assert near.blocks.size == far.blocks.size


def test_no_support_is_missed():
    """Wherever a plain sum finds density, border and holes included, the lattice has it."""
    rng = np.random.default_rng(0)
    for view in [*bumpy_views(), sphere_views(1)[0]]:
        depth = view.depth.copy()
        depth[10:20, 5:15] = np.nan
        depth[25:, 30:] += np.float32(0.2)
        view = View(depth, view.camera, view.T_world_camera, 0)
        exact, voxels = both([view])
        v, u = np.nonzero(np.isfinite(depth))
        chosen = rng.choice(len(v), 800, replace=False)
        ab1 = np.column_stack([view.camera.rays[v, u], np.ones(len(v))])[chosen]
        T = view.T_world_camera
        found = depth[v, u][chosen] + rng.normal(0, 0.004, 800)
        points = T[:3, 3] + (found[:, None] * ab1) @ T[:3, :3].T + rng.normal(0, 0.006, (800, 3))
        nearest = np.round(points / 0.004) * 0.004
        plain = exact.likelihood(nearest)
        held = lattice.values_at(
            voxels.blocks, voxels.blocks.value, np.round(points / 0.004).astype(np.int64))
        scale = plain.max()
        assert np.abs(held - plain).max() < 0.06 * scale
        assert np.quantile(np.abs(held - plain), 0.99) < 0.02 * scale


def test_blocks_are_found_again_after_growing():
    rng = np.random.default_rng(1)
    places = rng.integers(-30, 30, (6000, 3)) + np.array([5, -100_000, 900_000])
    keys = np.array([lattice.key_of(*place) for place in places])
    blocks = lattice.new_blocks(16)
    for change, part in enumerate(np.array_split(keys, 7)):
        blocks, found = lattice.with_keys(blocks, part, change + 1)
        assert sorted(blocks.key[found]) == sorted(set(part.tolist()))
    assert blocks.size == 1 + len(set(keys.tolist()))
    for place, key in zip(places[:300], keys[:300]):
        block = lattice.find(blocks.table_key, blocks.table_block, key)
        assert lattice.place_of(blocks.key[block]) == tuple(place)
        for n in range(27):
            beside = place + np.array([n % 3 - 1, n // 3 % 3 - 1, n // 9 - 1])
            other = lattice.find(
                blocks.table_key, blocks.table_block, lattice.key_of(*beside))
            assert blocks.neighbour[block, n] == other


def test_likelihood_over_the_expected_peak_is_one_on_a_wall():
    """Whatever the number of views, and however many see a place."""
    views = [
        plane_view(CAMERA, pose([0, 0, 0], [x, 0, 0]), [0, 0, 1], 0.8) for x in (0, 0.01, 0.3)]
    voxels = both(views, voxel=0.004)[1]
    # not where the border of an image cuts a window
    x = np.array([-0.1, -0.05, 0.0, 0.1, 0.15, 0.2, 0.3])
    points = np.column_stack([x, np.zeros(7), np.full(7, 0.8)])
    np.testing.assert_allclose(
        voxels.likelihood(points) / voxels.expected_peak(points), 1, rtol=0.02)
    assert voxels.expected_peak(np.array([[0, 0, 2.0]])) == 0


def test_what_a_user_should_know_is_said_once():
    settings = Settings(depth_bandwidth=0.006, depth_bandwidth_quadratic=0.0)
    reconstruction = Reconstruction(settings)
    first, second = (reconstruction.add(view) for view in sphere_views(2))
    assert 'voxel_size is 6 mm' in first.notices[0]
    assert 'voxel_size:=0.0042 would keep it' in first.notices[1]
    assert not second.notices
    fine = Reconstruction(settings.updated({'voxel_size': 0.0042}))
    assert fine.add(sphere_views(1)[0]).notices == ()


def test_views_that_cannot_be_added_say_why():
    empty = View(np.full((90, 121), np.nan, np.float32), CAMERA, np.eye(4), 0)
    with pytest.raises(FrameError, match='no valid depth to choose a voxel size from'):
        Reconstruction(Settings()).add(empty)
    voxels = VoxelDensity(1.5, 0.004, 0.0, 0.001, 5.0)
    voxels.add(empty)
    assert voxels.blocks.size == 1
    away = plane_view(CAMERA, pose([0, 0, 0], [9e3, 0, 0]), [0, 0, 1], 0.8)
    with pytest.raises(FrameError, match=r'9000 m from the origin.*a map reaches 8389 m'):
        voxels.add(away)


def test_a_view_costs_the_same_however_many_came_before():
    voxels = VoxelDensity(1.5, 0.004, 0.0, 0.004, 5.0)
    view = sphere_views(1)[0]
    voxels.add(view)
    blocks = voxels.blocks.size
    for _ in range(10):
        voxels.add(view)
    assert voxels.blocks.size == blocks
