# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Rays end at the maximum of the density, or say why not."""
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from scenes_for_tests import bumpy_views, looking_at_origin, plane_view, pose, sphere_view

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.exact_density import ExactDensity
from gr2t_ros.core.ray_march import march, rays_of, Status
from gr2t_ros.core.view import View

CAMERA = Camera(120, 90, 200.0, 200.0, 59.5, 44.5)
H3 = 0.004


def density_of(views, h3=H3, quadratic=0.0):
    density = ExactDensity(1.5, h3, quadratic)
    for view in views:
        density.add(view)
    return density


def marched(density, view, start='robust', pool=None):
    rays = rays_of(density, view, 1, start, pool)
    march(density, rays, np.arange(len(rays.pixels)), pool)
    return rays


def inside(view, points, margin):
    """Tell which world points a view's image holds, that many pixels from its border."""
    T = view.T_world_camera
    pixels = view.camera.project((points - T[:3, 3]) @ T[:3, :3])
    size = [view.camera.width - 1, view.camera.height - 1]
    return ((pixels >= margin) & (pixels <= np.subtract(size, margin))).all(axis=1)


def test_a_tilted_plane_is_found_where_it_is():
    normal = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
    views = [
        plane_view(CAMERA, pose(r, t), normal, 0.6) for r, t in (
            ([0, 0, 0], [0, 0, 0]), ([0, 0.1, 0], [-0.05, 0, 0]), ([0.1, 0, 0.2], [0, 0.04, 0]))]
    rays = marched(density_of(views), views[0])
    points = rays.points(slice(None))
    # a window that an image's border cuts is one-sided, so ask where all views have whole ones
    middle = np.all([inside(view, points, 7) for view in views], axis=0)
    assert middle.sum() > 1000 and rays.converged[middle].all()
    distance = points @ normal - 0.6
    assert np.abs(distance[middle]).max() < 0.005 * H3


def test_a_sphere_shrinks_by_what_its_curvature_predicts():
    """A kernel of lateral width s averages a cap of radius R: its depth moves by s^2 / R."""
    radius, distance = 0.1, 0.5
    view = sphere_view(CAMERA, looking_at_origin([1, 0, 0], distance), radius)
    rays = marched(density_of([view], h3=0.002), view)
    points = rays.points(slice(None))
    frontal = np.linalg.norm(points[:, 1:], axis=1) < 0.01
    lateral = 1.5 * (distance - radius) / CAMERA.fx
    sunk = radius - np.linalg.norm(points[frontal], axis=1)
    np.testing.assert_allclose(sunk, lateral ** 2 / radius, rtol=0.1)


def test_every_converged_ray_is_at_a_maximum():
    views = bumpy_views()
    density = density_of(views, 0.004, 0.002)
    for view in views:
        rays = marched(density, view)
        assert rays.converged.mean() > 0.97
        ok = rays.converged
        origins = np.repeat(rays.origin[None], ok.sum(), axis=0)
        f, f1, f2 = density.along(origins, rays.directions(ok), rays.depth[ok].astype(float))
        h3 = density.h3(rays.start[ok])
        assert (f2 < 0).all()
        # f jumps a little where a pixel enters the window: nearly all are at the very top
        assert np.quantile(np.abs(f1 / f2) / h3, 0.99) < 0.002
        assert (np.abs(rays.depth - rays.start)[ok] <= 4 * h3 * (1 + 1e-6)).all()
        # the likelihood handed out is the density's there
        np.testing.assert_allclose(
            rays.total[ok] / density.size, f, rtol=2e-4)


def test_the_robust_start_brings_outliers_back_and_leaves_the_rest():
    rng = np.random.default_rng(0)
    camera = Camera(160, 120, 200.0, 200.0, 79.5, 59.5)
    clean = plane_view(camera, np.eye(4), [0.1, 0.2, 0.97], 0.6)
    depth = clean.depth + rng.normal(0, H3, clean.depth.shape).astype(np.float32)
    outlier = rng.random(depth.shape) < 0.05
    # uniform beyond the noise, up to 5 cm
    sign = rng.choice([-1, 1], outlier.sum())
    depth[outlier] += (sign * rng.uniform(6 * H3, 0.05, outlier.sum())).astype(np.float32)
    view = View(depth, camera, np.eye(4), 0)
    density = density_of([view])
    robust = marched(density, view, start='robust')
    observed = marched(density, view, start='observed')
    is_outlier = outlier.ravel()[robust.pixels]

    def near(rays):
        return (np.abs(rays.depth - clean.depth.ravel()[rays.pixels]) < 3 * H3) & rays.converged
    assert near(robust)[is_outlier].mean() > 0.98
    assert near(observed)[is_outlier].mean() < 0.2
    inliers = ~is_outlier
    assert (np.abs(robust.start - observed.start)[inliers] > 4 * H3).mean() < 0.002


def test_a_depth_edge_is_not_fattened():
    camera = Camera(80, 60, 200.0, 200.0, 39.5, 29.5)
    depth = np.full((60, 80), 0.5, np.float32)
    depth[:, 40:] = 0.7
    view = View(depth, camera, np.eye(4), 0)
    rays = marched(density_of([view]), view)
    np.testing.assert_allclose(rays.depth, depth.ravel()[rays.pixels], atol=0.01 * H3)


def test_rays_that_find_nothing_say_why():
    flat = plane_view(CAMERA, np.eye(4), [0, 0, 1], 0.6)
    density = density_of([plane_view(CAMERA, np.eye(4), [0, 0, 1], 0.6 + 9 * H3)])
    rays = marched(density, flat, start='observed')
    assert (rays.status == Status.NO_SUPPORT).all() and not rays.converged.any()
    # a steep plane reaches into the window of a ray that crosses it out of the interval
    normal = np.array([np.sin(1.2), 0, np.cos(1.2)])
    steep = plane_view(CAMERA, np.eye(4), normal, 0.6 * np.cos(1.2))
    density = density_of([steep])
    before = View(steep.depth - np.float32(5 * H3), CAMERA, np.eye(4), 0)
    rays = marched(density, before, start='observed')
    assert (rays.status == Status.LEFT_INTERVAL).mean() > 0.5
    assert (np.abs(rays.depth - rays.start) <= 4 * H3 * 1.001).all()


def test_threads_do_not_change_a_bit():
    views = bumpy_views()
    density = density_of(views, 0.004, 0.002)
    with ThreadPoolExecutor(1) as one, ThreadPoolExecutor(4) as four:
        a = marched(density, views[0], pool=one)
        b = marched(density, views[0], pool=four)
        points = a.points(slice(None))
        np.testing.assert_array_equal(
            density.likelihood(points, one), density.likelihood(points, four))
    for name in ('start', 'depth', 'total', 'status', 'iterations'):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_stride_takes_a_subset_of_the_same_rays():
    views = bumpy_views()
    density = density_of(views, 0.004, 0.002)
    whole = marched(density, views[0])
    sparse = rays_of(density, views[0], 3, 'robust')
    march(density, sparse, np.arange(len(sparse.pixels)))
    at = np.searchsorted(whole.pixels, sparse.pixels)
    np.testing.assert_array_equal(whole.depth[at], sparse.depth)
    assert 7 < len(whole.pixels) / len(sparse.pixels) < 11
