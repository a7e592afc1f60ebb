# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Depths in units of their bandwidth, the lateral weights, and where a view has support."""
import numpy as np
import pytest
from scenes_for_tests import CAMERAS

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.view import View
from gr2t_ros.core.warped import (
    BINS,
    CELL,
    empty_support,
    find_support,
    INVALID,
    robust_starts,
    Scale,
    warped,
    Weights,
)

BANDWIDTHS = [1.0, 1.5, 2.0, 4.0]


def scale_at(scale, z):
    steps = np.arange(len(scale.table)) / scale.per_metre
    return np.interp(z, steps, scale.table.astype(float)) * np.sqrt(32)


def test_the_scale_is_the_integral_of_one_over_h3():
    z = np.linspace(0, 5, 101)
    constant = Scale.of(0.004, 0.0, 0.001, 5.0)
    np.testing.assert_allclose(scale_at(constant, z), z / 0.004, rtol=1e-5, atol=1e-3)
    quadratic = Scale.of(0.003, 0.002, 0.001, 5.0)
    expected = np.arctan(z * np.sqrt(0.002 / 0.003)) / np.sqrt(0.003 * 0.002)
    np.testing.assert_allclose(scale_at(quadratic, z), expected, rtol=1e-5, atol=1e-3)
    floored = Scale.of(0.003, 0.002, 0.01, 5.0)
    kink = np.sqrt(0.007 / 0.002)
    beyond = (np.arctan(z * np.sqrt(2 / 3)) - np.arctan(kink * np.sqrt(2 / 3))) / np.sqrt(6e-6)
    expected = np.where(z < kink, z / 0.01, kink / 0.01 + beyond)
    np.testing.assert_allclose(scale_at(floored, z), expected, rtol=1e-5, atol=1e-3)
    # and back: each bin begins where t is its number over BINS
    depths = quadratic.depth_of_bins()
    np.testing.assert_allclose(
        scale_at(quadratic, depths[:-2]), np.arange(len(depths) - 2) / BINS, atol=1e-3)


@pytest.mark.parametrize('bandwidth', [0.5, *BANDWIDTHS, 8.0])
def test_weights_have_the_gaussian_s_moments_at_every_phase(bandwidth):
    weights = Weights.of(bandwidth)
    table = weights.table.reshape(-1, weights.lanes).astype(float)
    phase = (np.arange(len(table)) + 0.5) / len(table)
    offset = np.arange(weights.lanes) - (weights.lanes // 2 - 1) - phase[:, None]
    np.testing.assert_allclose(table.sum(axis=1), 1, atol=1e-6)
    np.testing.assert_allclose((table * offset).sum(axis=1), 0, atol=1e-6 * bandwidth)
    np.testing.assert_allclose(
        (table * offset ** 2).sum(axis=1), bandwidth ** 2, rtol=1e-6)
    assert weights.lanes % 8 == 0 and weights.lanes >= 5 * bandwidth


def test_invalid_depths_stay_invalid():
    camera = Camera(9, 6, 20.0, 20.0, 4.0, 2.5)
    depth = np.full((6, 9), 1.5, np.float32)
    bad = [(0, 0), (2, 3), (5, 8), (4, 4), (1, 7), (3, 1)]
    for (v, u), value in zip(bad, (np.nan, 0, -1, 2.01, np.inf, 1e9)):
        depth[v, u] = value
    depth[0, 8] = 2.0  # depth_max itself counts
    scale, weights = Scale.of(0.004, 0.002, 0.0, 2.0), Weights.of(1.5)
    image = warped(View(depth, camera, np.eye(4), 0), scale, weights)
    whole = image.image.reshape(-1, image.stride)
    inner = whole[image.pad:-image.pad, image.pad:-image.pad]
    valid = np.ones((6, 9), bool)
    for place in bad:
        valid[place] = False
    np.testing.assert_array_equal(inner != INVALID, valid)
    assert image.valid == valid.sum()
    assert np.count_nonzero(whole != INVALID) == valid.sum()
    np.testing.assert_allclose(
        inner[valid] * np.sqrt(32), scale_at(scale, depth[valid].astype(float)), rtol=1e-5)


def test_a_pixel_without_a_ray_is_invalid():
    camera = Camera(48, 40, 35.0, 35.0, 23.5, 19.5, 'plumb_bob', (-0.45, -0.25, 0.0, 0.0, 0.0))
    blind = np.isnan(camera.rays[..., 0])
    assert 100 < blind.sum() < blind.size
    view = View(np.ones((40, 48), np.float32), camera, np.eye(4), 0)
    image = warped(view, Scale.of(0.01, 0.0, 0.0, 5.0), Weights.of(1.5))
    inner = image.image.reshape(-1, image.stride)[image.pad:-image.pad, image.pad:-image.pad]
    np.testing.assert_array_equal(inner == INVALID, blind)


def depths_of(kind, camera):
    """Return a smooth, a noisy, or a noisy image with jumps and holes."""
    rng = np.random.default_rng(0)
    a, b = camera.rays[..., 0], camera.rays[..., 1]
    depth = 0.5 + 0.1 * a + 0.05 * np.sin(9 * b)
    if kind != 'smooth':
        depth += rng.normal(0, 0.002, a.shape)
    if kind == 'jumpy':
        depth[a > 0.1] += 0.2
        depth[b > 0.15] += 3.0
        depth[rng.random(a.shape) < 0.1] = np.nan
        depth[10:20, 20:27] = np.nan
    return depth.astype(np.float32)


def held_by(support, u, v, t):
    """Tell which points (pixels, pixels, bandwidths) the support of a 61 x 47 image holds."""
    j = np.clip(v, 0, 46).astype(int) // CELL
    i = np.clip(u, 0, 60).astype(int) // CELL
    cell = j * support.columns + i
    bit = ((t * BINS).astype(int) - support.base[cell]) >> support.shift[cell]
    inside = (bit >= 0) & (bit < 64)
    shifted = support.mask[cell] >> np.where(inside, bit, 0).astype(np.uint64)
    return inside & (shifted & np.uint64(1) == 1)


@pytest.mark.parametrize('bandwidth', BANDWIDTHS)
@pytest.mark.parametrize('kind', ['smooth', 'noisy', 'jumpy'])
def test_the_support_misses_nothing(kind, bandwidth):
    """At every point about the image whose density is 2 % of the peak, the bit is set."""
    camera = Camera(61, 47, 60.0, 61.0, 30.2, 23.7)
    scale, weights = Scale.of(0.004, 0.002, 0.0, 5.0), Weights.of(bandwidth)
    image = warped(View(depths_of(kind, camera), camera, np.eye(4), 0), scale, weights)
    support = empty_support(47, 61)
    for rows in ((0, 5), (5, 12)):  # in parts, as tasks do
        find_support(image, 47, 61, weights.lanes, support, *rows)

    rng = np.random.default_rng(1)
    count = 3000
    rim = weights.lanes // 2 - 1
    u, v = rng.uniform(-rim, 60 + rim, count), rng.uniform(-rim, 46 + rim, count)
    t_image = image.image.reshape(-1, image.stride)[image.pad:-image.pad, image.pad:-image.pad]
    t_image = np.where(t_image == INVALID, np.nan, t_image * np.sqrt(32.0))
    # depths that matter: about those of a pixel nearby
    beside = rng.integers(-2, 3, (2, count))
    near = t_image[
        np.clip(np.rint(v).astype(int) + beside[0], 0, 46),
        np.clip(np.rint(u).astype(int) + beside[1], 0, 60)]
    t = near + rng.uniform(-4, 4, count)
    t = np.where(np.isnan(near), 130.0, t)
    rows, columns = np.arange(47), np.arange(61)
    by_row = np.exp(-0.5 * ((rows - v[:, None]) / bandwidth) ** 2)
    by_column = np.exp(-0.5 * ((columns - u[:, None]) / bandwidth) ** 2)
    density = np.array([
        np.nansum(r[:, None] * c * np.exp(-0.5 * (t_image - at) ** 2))
        for r, c, at in zip(by_row, by_column, t)]) / (2 * np.pi * bandwidth ** 2)
    peak = density.max()
    held = held_by(support, u, v, t)
    assert (density > 0.5 * peak).sum() > 50
    assert density[~held].max() < 0.02 * peak
    if kind == 'smooth':  # nor does it hold what is far away
        assert not held_by(support, u, v, t + 60).any()


def test_an_image_without_depth_has_no_support():
    camera = CAMERAS[0]
    view = View(np.full((48, 64), np.nan, np.float32), camera, np.eye(4), 0)
    image = warped(view, Scale.of(0.004, 0.002, 0.0, 5.0), Weights.of(1.5))
    support = empty_support(48, 64)
    find_support(image, 48, 64, 8, support, 0, 12)
    assert not support.mask.any()


@pytest.mark.parametrize('bandwidth', BANDWIDTHS)
def test_outliers_start_at_a_neighbour_s_depth_also_at_the_border(bandwidth):
    camera = Camera(37, 30, 60.0, 60.0, 18.0, 14.5)
    rng = np.random.default_rng(2)
    depth = (0.6 + rng.normal(0, 0.002, (30, 37))).astype(np.float32)
    outliers = [(0, 0), (29, 36), (0, 20), (15, 15), (29, 3)]
    for place in outliers:
        depth[place] = 0.7
    scale, weights = Scale.of(0.004, 0.0, 0.0, 1.0), Weights.of(bandwidth)
    image = warped(View(depth, camera, np.eye(4), 0), scale, weights)
    pixels = np.arange(depth.size, dtype=np.int32)
    starts = depth.ravel().copy()
    robust_starts(image, weights, 37, depth.ravel(), pixels, starts)
    moved = starts != depth.ravel()
    np.testing.assert_array_equal(
        np.argwhere(moved.reshape(depth.shape)), sorted(map(list, outliers)))
    assert np.abs(starts - 0.6).max() < 0.02
