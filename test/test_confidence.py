# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The deviation of a maximum follows its error, and an outlier has no confidence."""
import numpy as np
import pytest

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.confidence import confidences, deviations
from gr2t_ros.core.exact_density import ExactDensity
from gr2t_ros.core.ray_march import march, rays_of
from gr2t_ros.core.view import View
from gr2t_ros.core.voxel_density import VoxelDensity

WIDTH, HEIGHT = 64, 48
CAMERA = Camera(WIDTH, HEIGHT, 200.0, 200.0, 31.5, 23.5)
H3, DEPTH = 0.003, 0.4


def plane_views(count, noise=0.0, outliers=()):
    """Return views of a plane that faces them, from the same place."""
    rng = np.random.default_rng(5)
    depths = DEPTH + noise * rng.standard_normal((count, HEIGHT, WIDTH))
    for v, u in outliers:
        depths[0, v, u] += 0.05
    return [View(depth.astype(np.float32), CAMERA, np.eye(4), i)
            for i, depth in enumerate(depths)]


def density_of(views, kind):
    density = (
        ExactDensity(1.5, H3) if kind == 'exact' else VoxelDensity(1.5, H3, 0.0, H3, 2.0))
    for view in views:
        density.add(view)
    return density


def found(density, view, start='observed'):
    """Return the rays, which of them found a maximum away from the image's rim, deviations."""
    rays = rays_of(density, view, 1, start)
    density.refresh()
    march(density, rays, np.arange(len(rays.pixels)))
    v, u = np.divmod(rays.pixels, WIDTH)
    which = np.flatnonzero(
        rays.converged & (np.abs(v - 23.5) < 17) & (np.abs(u - 31.5) < 25))
    return rays, which, deviations(density, rays, which)


@pytest.mark.parametrize('kind', ['exact', 'voxel'])
def test_deviations_are_of_the_size_of_the_errors(kind):
    for count in (1, 4):
        views = plane_views(count, noise=H3)
        rays, which, sigma = found(density_of(views, kind), views[0])
        rms = np.sqrt(np.mean((rays.depth[which] - DEPTH) ** 2))
        assert 0.4 < rms / sigma.mean() < 2.0


def test_more_views_are_surer():
    means = []
    for count in (1, 3, 9):
        views = plane_views(count, noise=H3)
        means.append(found(density_of(views, 'voxel'), views[0])[2].mean())
    assert means[0] > 1.5 * means[1] > 2.0 * means[2]


def test_lattice_and_exact_sum_agree():
    views = plane_views(3, noise=0.5 * H3)
    sigmas = [found(density_of(views, kind), views[0])[2] for kind in ('exact', 'voxel')]
    assert len(sigmas[0]) == len(sigmas[1])
    assert np.median(np.abs(sigmas[1] / sigmas[0] - 1)) < 0.05


@pytest.mark.parametrize('kind', ['exact', 'voxel'])
def test_a_lone_pixel_has_no_confidence(kind):
    places = [(24, 20), (24, 40), (14, 32)]
    views = plane_views(3, noise=0.5 * H3, outliers=places)
    rays, which, sigma = found(density_of(views, kind), views[0])
    confidence = confidences(sigma, np.full(len(sigma), H3))
    alone = np.isin(rays.pixels[which], [v * WIDTH + u for v, u in places])
    assert alone.sum() == 3
    assert (confidence[alone] < 0.01).all()
    assert (confidence[~alone] > 0.5).all()


@pytest.mark.parametrize('kind', ['exact', 'voxel'])
def test_what_kernels_round_is_less_sure_however_many_views_see_it(kind):
    waves = 3 * H3 * np.cos(2 * np.pi * np.arange(WIDTH) / 8).astype(np.float32)
    views = [View(view.depth + waves, CAMERA, np.eye(4), i)
             for i, view in enumerate(plane_views(9))]
    _, _, sigma = found(density_of(views, kind), views[0])
    _, _, flat = found(density_of(plane_views(9), kind), plane_views(1)[0])
    assert sigma.mean() > 5 * flat.mean()


def test_confidence_is_a_half_at_h3_and_0_where_nothing_is_known():
    sigma = np.array([0.0, H3, np.inf], np.float32)
    np.testing.assert_allclose(confidences(sigma, np.full(3, H3)), [1.0, 0.5, 0.0])
