# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The lattice holds the same density as the exact sum, at any place, in any order."""
from concurrent.futures import ThreadPoolExecutor
from math import pi, sqrt

import numpy as np
import pytest
from scenes_for_tests import (
    bumpy_views,
    CAMERAS,
    looking_at_origin,
    plain_jet,
    plane_view,
    pose,
    sphere_view,
)

from gr2t_ros.core.blocks import key_of, place_of, values_at
from gr2t_ros.core.camera import Camera
from gr2t_ros.core.exact_density import ExactDensity
from gr2t_ros.core.ray_march import march, rays_of, watched_blocks
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view import View
from gr2t_ros.core.voxel_density import VoxelDensity
from gr2t_ros.errors import FrameError, InputError
from gr2t_ros.settings import Settings

H1, H3, QUADRATIC, VOXEL = 1.5, 0.004, 0.002, 0.004
NORMAL = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
CAMERA = Camera(120, 90, 200.0, 200.0, 59.5, 44.5)


def planes():
    return [
        plane_view(CAMERA, pose(r, t), NORMAL, 0.6) for r, t in (
            ([0, 0, 0], [0, 0, 0]), ([0, 0.1, 0], [-0.05, 0, 0]), ([0.1, 0, 0.2], [0, 0.04, 0]))]


def spheres():
    return [
        sphere_view(CAMERA, looking_at_origin(direction, 0.5), 0.12)
        for direction in ([1, 0, 0], [1, 0.3, 0.2], [0.9, -0.3, 0.4])]


def built(views, voxel=VOXEL, pool=None, h1=H1, h3=H3, quadratic=QUADRATIC):
    density = VoxelDensity(h1, h3, quadratic, voxel, depth_max=2.0)
    for view in views:
        density.add(view, pool)
    density.refresh(pool)
    return density


def exact(views, h1=H1, h3=H3, quadratic=QUADRATIC):
    density = ExactDensity(h1, h3, quadratic)
    for view in views:
        density.add(view)
    return density


def marched(density, view, pool=None):
    rays = rays_of(density, view, 1, 'observed', pool)
    march(density, rays, np.arange(len(rays.pixels)), pool)
    return rays


def moved(view, shift):
    return View(view.depth, view.camera, pose([0, 0, 0], shift) @ view.T_world_camera, 0)


def blank(view):
    return View(np.full_like(view.depth, np.nan), view.camera, view.T_world_camera, 0)


def same_blocks(a, b):
    """Tell each place's samples in one order, (n, 512) of each density."""
    assert a.blocks.size == b.blocks.size
    values = []
    for density in (a, b):
        order = np.argsort(density.blocks.key[1:density.blocks.size]) + 1
        values.append(density.blocks.value.reshape(-1, 512)[order])
        keys = density.blocks.key[order]
    np.testing.assert_array_equal(keys, np.sort(a.blocks.key[1:a.blocks.size]))
    return values


# median and 95th percentile of |depth difference| / h3, then of the likelihood's relative one
@pytest.mark.parametrize(('views', 'voxel', 'bounds'), [
    (planes(), VOXEL, (0.01, 0.02, 0.002, 0.006)),
    (planes(), VOXEL / 2, (0.002, 0.015, 0.003, 0.008)),
    (spheres(), VOXEL, (0.02, 0.1, 0.005, 0.02)),
    (spheres(), VOXEL / 2, (0.005, 0.05, 0.005, 0.01)),
    # noise and a slope of 45 degrees; the window's tails are what is left of the error
    (bumpy_views(), VOXEL, (0.03, 0.22, 0.007, 0.025)),
], ids=['plane', 'plane, fine', 'sphere', 'sphere, fine', 'bumpy, four lenses'])
def test_marching_ends_where_the_exact_density_s_does(views, voxel, bounds):
    density, reference = built(views, voxel), exact(views)
    distance, ratio = [], []
    for view in views:
        rays, true = marched(density, view), marched(reference, view)
        both = rays.converged & true.converged
        assert both.mean() > 0.95 and (rays.converged != true.converged).mean() < 0.015
        distance.append((np.abs(rays.depth - true.depth) / density.h3(true.start))[both])
        points = true.points(both)
        ratio.append(np.abs(density.likelihood(points) / reference.likelihood(points) - 1))
    distance, ratio = np.concatenate(distance), np.concatenate(ratio)
    reached = [np.median(distance), np.quantile(distance, 0.95),
               np.median(ratio), np.quantile(ratio, 0.95)]
    assert np.less(reached, bounds).all(), reached


def plain_values(view, h1, h3, points):
    """Return the sum over all pixels at points, h3 a function of the depth."""
    T = view.T_world_camera
    p = (points - T[:3, 3]) @ T[:3, :3]
    u, v = view.camera.project(p).T
    seen = np.isfinite(view.depth) & np.isfinite(view.camera.rays[..., 0])
    rows, columns = np.nonzero(seen)
    z = view.depth[seen].astype(float)
    width = h3(z)
    total = np.zeros(len(points))
    for part in np.array_split(np.arange(len(points)), max(len(points) // 500, 1)):
        r2 = (((rows - v[part, None]) / h1) ** 2 + ((columns - u[part, None]) / h1) ** 2
              + ((z - p[part, 2, None]) / width) ** 2)
        total[part] = np.sum(np.exp(-0.5 * r2) / width, axis=1)
    return np.nan_to_num(total) / ((2 * pi) ** 1.5 * h1 * h1 * view.depth.size)


def with_jumps_and_holes(camera, T_world_camera):
    rng = np.random.default_rng(0)
    a, b = camera.rays[..., 0], camera.rays[..., 1]
    depth = 0.5 + 0.1 * a + 0.05 * np.sin(9 * b) + rng.normal(0, 0.002, a.shape)
    depth[a > 0.1] += 0.2
    depth[b > 0.15] -= 0.1
    depth[rng.random(a.shape) < 0.1] = np.nan
    depth[10:20, 20:27] = np.nan
    return View(depth.astype(np.float32), camera, T_world_camera, 0)


@pytest.mark.parametrize(('h1', 'voxel'), [
    (1.0, 0.008), (1.5, 0.002), (1.5, 0.008), (1.5, 0.05), (2.0, 0.008), (4.0, 0.008)])
@pytest.mark.parametrize('camera', [
    Camera(61, 47, 60.0, 61.0, 30.2, 23.7), Camera(181, 135, 700.0, 710.0, 90.2, 67.7), CAMERAS[3],
], ids=['pinhole', 'narrow', 'fisheye'])
def test_no_voxel_that_matters_is_missed(camera, h1, voxel):
    """Samples equal the plain sum, at depth edges, holes and beyond the image's border too."""
    view = with_jumps_and_holes(camera, pose([0.2, -0.1, 0.3], [-0.3, 0.2, -0.4]))
    density = built([view], voxel, h1=h1)
    rng = np.random.default_rng(1)
    v, u = rng.integers(0, camera.height, 3000), rng.integers(0, camera.width, 3000)
    z = view.depth[v, u] + rng.normal(0, density.h3(view.depth[v, u]))
    ab = camera.rays[v, u] + rng.normal(0, h1 / camera.fx, (3000, 2))
    p = np.column_stack([ab * z[:, None], z])[np.isfinite(z)]
    T = view.T_world_camera
    voxels = np.unique(np.round((p @ T[:3, :3].T + T[:3, 3]) / voxel).astype(np.int64), axis=0)
    found = values_at(density.blocks, density.blocks.value, voxels)
    plain = plain_values(view, h1, density.h3, voxels * voxel)
    error = np.abs(found - plain) / plain.max()
    assert np.median(error) < 0.004 and np.quantile(error, 0.998) < 0.025
    # what a block holds that no ray meets but with its corner
    assert error.max() < 0.2


def test_pixels_wider_than_a_block_leave_no_holes():
    camera = Camera(32, 24, 24.0, 24.0, 15.5, 11.5)
    view = plane_view(camera, np.eye(4), NORMAL, 0.9)
    density = built([view], 0.004, quadratic=0.0)  # a tenth of a pixel
    uv = np.random.default_rng(0).uniform(4, [27, 19], (3000, 2))
    ab1 = np.column_stack([(uv - [15.5, 11.5]) / 24, np.ones(3000)])
    points = ab1 * (0.9 / (ab1 @ NORMAL))[:, None]
    voxels = np.unique(np.round(points / 0.004).astype(np.int64), axis=0)
    found = values_at(density.blocks, density.blocks.value, voxels)
    assert (found > 0).mean() > 0.998


def test_h3_is_floored_at_the_voxel_size():
    view = bumpy_views()[0]
    density = built([view], voxel=0.01)
    assert density.h3(np.array([0.5, 2.0])).tolist() == pytest.approx([0.01, 0.012])
    rays = marched(density, view)
    points = rays.points(rays.converged)[::20]
    plain = plain_values(view, H1, density.h3, points)
    ratio = density.likelihood(points) / plain
    assert np.median(np.abs(ratio - 1)) < 0.1  # these voxels alias: a pixel is 8 mm wide


def test_derivatives_are_those_of_the_likelihood_and_of_the_plain_sum():
    views = bumpy_views()
    density = built(views)
    rays = marched(density, views[1])
    some = np.flatnonzero(rays.converged)[::37]
    origins = np.repeat(rays.origin[None], len(some), axis=0)
    directions = rays.directions(some)
    distances = rays.depth[some] + np.random.default_rng(0).normal(0, H3, len(some))
    f, f1, f2 = density.along(origins, directions, distances)
    np.testing.assert_array_equal(
        density.likelihood(origins + distances[:, None] * directions), f)
    step = 1e-4 * H3
    below, above = (density.along(origins, directions, distances + k * step) for k in (-1, 1))
    scale = f.max()
    # (the spline's derivative has small steps at the voxels, so nearly all)
    close = np.abs((above[0] - below[0]) / (2 * step) - f1) < 0.01 * scale / H3
    assert close.mean() > 0.98
    close = np.abs((above[1] - below[1]) / (2 * step) - f2) < 0.02 * scale / H3 ** 2
    assert close.mean() > 0.98
    plain = np.array([
        plain_jet(views, H1, H3, QUADRATIC, *line)
        for line in zip(origins, directions, distances)])
    assert np.quantile(np.abs(f - plain[:, 0]), 0.95) < 0.02 * scale
    assert np.quantile(np.abs(f1 - plain[:, 1]), 0.95) < 0.05 * scale / H3
    assert np.quantile(np.abs(f2 - plain[:, 2]), 0.95) < 0.2 * scale / H3 ** 2


def test_adding_and_removing_leaves_the_map_as_it_was():
    views = [*planes(), *bumpy_views()]
    kept, others = views[:4], views[4:]
    density = built(kept)
    before, expected = density.blocks.value.copy(), density.blocks.expected.copy()
    size, pixels, aliased = density.size, density.pixels, density.aliased_pixels
    peak = before.max()
    for view in others:
        density.add(view)
    for view in others:
        density.remove(view)
    density.refresh()
    for name, old in (('value', before), ('expected', expected)):
        new = getattr(density.blocks, name)[:len(old)]
        np.testing.assert_allclose(new, old, atol=1e-6 * old.max())
        assert np.abs(getattr(density.blocks, name)[len(old):]).max(initial=0) < 1e-6 * old.max()
    assert (density.size, density.pixels, density.aliased_pixels) == (size, pixels, aliased)
    for view in kept:
        density.remove(view)
    density.refresh()
    assert density.size == 0 and np.abs(density.blocks.value).max() < 1e-6 * peak
    assert np.abs(density.likelihood(np.array([[0, 0, 0.55], [0, 0, 0.6]]))).max() < 1e-5 * peak


def test_threads_do_not_change_a_bit():
    views = bumpy_views()
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(4) as four:
        a, b = built(views, pool=one), built(views, pool=four)
        for name in ('size', 'key', 'value', 'expected', 'coefficient', 'neighbour', 'filtered'):
            np.testing.assert_array_equal(getattr(a.blocks, name), getattr(b.blocks, name))
        rays, same = marched(a, views[0], one), marched(b, views[0], four)
        np.testing.assert_array_equal(watched_blocks(a, rays, one), watched_blocks(b, same, four))
        points = rays.points(slice(None))
        np.testing.assert_array_equal(a.likelihood(points, one), b.likelihood(points, four))
    for name in ('depth', 'total', 'status', 'iterations'):
        np.testing.assert_array_equal(getattr(rays, name), getattr(same, name))


def test_the_order_of_views_and_blocks_does_not_matter():
    views = bumpy_views()
    a, b = built(views), built(views[::-1])
    values = same_blocks(a, b)
    np.testing.assert_allclose(values[0], values[1], atol=1e-6 * values[0].max())
    # blocks made beforehand, in another order, change nothing either
    c = VoxelDensity(H1, H3, QUADRATIC, VOXEL, depth_max=2.0)
    c.cover(np.sort(a.blocks.key[1:a.blocks.size])[::-1])
    for view in views:
        c.add(view)
    c.refresh()
    values = same_blocks(a, c)
    np.testing.assert_array_equal(values[0], values[1])
    points = marched(a, views[0]).points(slice(None))
    np.testing.assert_array_equal(a.likelihood(points), c.likelihood(points))


def test_a_map_4_km_away_is_the_same():
    views = bumpy_views()
    shift = VOXEL * np.array([2 ** 20, -2 ** 19, 2 ** 17])  # 4.2 km, whole voxels
    near, far = built(views), built([moved(view, shift) for view in views])
    assert near.blocks.size == far.blocks.size
    rays, same = marched(near, views[0]), marched(far, moved(views[0], shift))
    assert (rays.status != same.status).mean() < 0.002
    both = rays.converged & same.converged
    difference = np.abs(rays.depth - same.depth)[both] / near.h3(rays.start[both])
    assert np.quantile(difference, 0.99) < 1e-3
    np.testing.assert_allclose(
        far.likelihood(rays.points(both) + shift), near.likelihood(rays.points(both)), rtol=1e-3)


def test_a_pose_beyond_the_lattice_is_refused_and_the_map_left_alone():
    view = planes()[0]
    density = built([view], voxel=0.01)
    size = density.blocks.size
    with pytest.raises(FrameError, match='500000 m') as error:
        density.add(moved(view, [5e5, 0, 0]))
    assert error.value.reason == 'out_of_range'
    with pytest.raises(FrameError):
        density.add(moved(view, [0, np.nan, 0]))
    assert density.size == 1 and density.blocks.size == size


def test_pixels_without_rays_leave_the_others_alone():
    """A lens whose distortion cannot be inverted in the corners, at the world's origin."""
    lens = Camera(48, 40, 35.0, 35.0, 23.5, 19.5, 'plumb_bob', (-0.45, -0.25, 0.0, 0.0, 0.0))
    T = pose([0, 0, 0], [0.05, 0.07, -0.95])
    views = [plane_view(camera, T, [0, 0, 1], 0.05) for camera in (CAMERAS[0], lens)]
    views = [View(np.ones_like(view.depth), view.camera, T, 0) for view in views]
    density, reference = built(views, 0.01, h3=0.01), exact(views, h3=0.01)
    used = density.blocks.key[1:density.blocks.size]
    places = np.array([place_of(key) for key in used])
    np.testing.assert_array_equal([key_of(*place) for place in places], used)
    seen = np.isfinite(lens.rays[..., 0])
    ab1 = np.concatenate([lens.rays[seen], np.ones((seen.sum(), 1))], axis=1)
    points = ab1 + T[:3, 3]
    ratio = density.likelihood(points) / reference.likelihood(points)
    assert np.quantile(np.abs(ratio - 1), 0.99) < 0.02 and ratio.min() > 0.7


def test_views_that_see_nothing_add_nothing():
    view = planes()[0]
    density = built([view, blank(view)])
    alone = built([view])
    assert density.size == 2 and density.pixels == alone.pixels
    np.testing.assert_array_equal(density.blocks.value, alone.blocks.value)
    deep = View(np.full_like(view.depth, 2.1), view.camera, view.T_world_camera, 0)
    assert built([deep]).blocks.size == 1  # beyond depth_max
    empty = built([blank(view)])
    assert empty.blocks.size == 1
    assert empty.likelihood(np.array([[0, 0, 0.6], [-9e3, 4, 1]])).tolist() == [0, 0]
    # nor does a camera that looks away add to what it does not see
    away = View(view.depth, view.camera, pose([0, pi, 0], [0, 0, 0]), 0)
    points = marched(alone, view).points(slice(None))[::50]
    np.testing.assert_allclose(
        2 * built([view, away]).likelihood(points), alone.likelihood(points))


def test_the_cost_of_a_view_does_not_grow_with_those_before():
    rng = np.random.default_rng(0)
    density = VoxelDensity(H1, H3, QUADRATIC, VOXEL, depth_max=2.0)
    touched = []
    for _ in range(50):
        T = pose(rng.normal(0, 0.01, 3), rng.normal(0, 0.01, 3))
        density.add(plane_view(CAMERAS[0], T, NORMAL, 0.6))
        density.refresh()
        last = density.blocks.touched[:density.blocks.size] == density.change
        touched.append(np.count_nonzero(last))
    assert 0.8 < touched[-1] / touched[0] < 1.25
    assert density.blocks.size < 2 * touched[0]


def test_blocks_lie_about_the_surface_only():
    view = plane_view(CAMERA, np.eye(4), [0, 0, 1], 0.6)
    density = built([view])
    places = np.array([place_of(key) for key in density.blocks.key[1:density.blocks.size]])
    side = 8 * VOXEL
    reach = 4 * density.h3(np.array(0.6))
    assert (places[:, 2] * side > 0.6 - reach - side).all()
    assert (places[:, 2] * side < 0.6 + reach).all()
    width, height = 0.6 * np.array([120, 90]) / 200 + 2 * 5 * 0.6 / 200
    assert len(places) <= (width / side + 2) * (height / side + 2) * (2 * reach / side + 2)


def test_the_expected_peak_is_the_likelihood_of_a_frontal_plane():
    views = [plane_view(camera, np.eye(4), [0, 0, 1], 0.6) for camera in (CAMERA, CAMERAS[0])]
    density = built([*views, blank(views[0])])
    points = np.array([[0.01, -0.02, 0.6], [0.05, 0.03, 0.6], [0.0, 0.0, 1.2]])
    h3 = H3 + QUADRATIC * 0.6 ** 2
    total = (1 / (120 * 90) + 1 / (64 * 48)) / (sqrt(2 * pi) * h3)
    np.testing.assert_allclose(density.expected_total(points), [total, total, 0], rtol=0.01)
    np.testing.assert_allclose(density.likelihood(points[:2]), total / 3, rtol=0.02)


def test_bandwidths_and_voxels_must_be_positive():
    with pytest.raises(InputError, match='bandwidth'):
        VoxelDensity(0, 0.001, 0, 0.01, 5)
    with pytest.raises(InputError, match='voxel_size'):
        VoxelDensity(1, 0.001, 0, 0.0, 5)


@pytest.mark.parametrize('depth', [0.37, 0.5, 0.61, 0.83])
def test_aliasing_is_said_once_and_the_voxel_size_it_names_is_fine(depth):
    camera = Camera(64, 48, 120.0, 60.0, 31.5, 23.5)
    view = plane_view(camera, np.eye(4), [0, 0, 1], depth)
    coarse = Settings(voxel_size=0.05, threads=1)
    reconstruction = Reconstruction(coarse)
    first, again = (reconstruction.add(view).notices for _ in range(2))
    reconstruction.close()
    assert len(first) == 1 and not again
    named = first[0].split('voxel_size:=')[1].split()[0]
    # 1.5 of the narrower lateral bandwidth, in metres
    assert 0.9 < float(named) / (1.5 * 1.5 * depth / 120) <= 1
    better = Reconstruction(coarse.updated({'voxel_size': named}))
    assert better.add(view).notices == ()
    better.close()


def test_voxel_size_0_says_what_it_took():
    reconstruction = Reconstruction(Settings(threads=1))
    view = plane_view(CAMERA, np.eye(4), [0, 0, 1], 1.0)
    with pytest.raises(FrameError) as error:
        reconstruction.add(blank(view))
    assert error.value.reason == 'no_valid_depth'
    update = reconstruction.add(view)
    reconstruction.close()
    assert reconstruction.density.voxel_size == pytest.approx(0.005)
    assert any('voxel_size is 5 mm' in notice and '1.00 m' in notice for notice in update.notices)
