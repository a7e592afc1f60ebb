# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The noise models: their figures are those of the literature, measured on their output."""
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
import pytest

from gr2t_ros.errors import InputError
from gr2t_ros.tools.noise import axial_sigma, gap_behind, lateral_sigma, Noise, quantised

FOCAL = 525.0
SHAPE = (200, 300)


def _plane(depth=1.0, angle=0.0):
    return np.full(SHAPE, depth), np.full(SHAPE, angle)


def _applied(noise, depth, angle, seed=0):
    return noise.apply(depth, angle, FOCAL, np.random.default_rng(seed))


def test_axial_sigma_is_the_published_one():
    assert axial_sigma(np.array(0.4), np.array(0.0)) == pytest.approx(0.0012)
    assert axial_sigma(np.array(1.4), np.array(0.0)) == pytest.approx(0.0012 + 0.0019)
    # at 60 degrees theta^2 / (pi/2 - theta)^2 = 4
    at_60 = axial_sigma(np.array(0.25), np.array(np.pi / 3))
    assert at_60 == pytest.approx(0.0012 + 0.0019 * 0.15 ** 2 + 0.0001 / 0.5 * 4)


def test_lateral_sigma_is_the_published_one():
    assert lateral_sigma(np.array(0.0)) == pytest.approx(0.8)
    assert lateral_sigma(np.array(np.pi / 4)) == pytest.approx(0.8 + 0.035)
    assert np.isfinite(lateral_sigma(np.array(np.pi / 2)))


def test_no_noise_changes_nothing():
    depth, angle = _plane()
    depth[:, :50] = np.nan
    assert_array_equal(_applied(Noise(), depth, angle), depth)
    assert Noise().offsets(angle, np.random.default_rng(0)) is None


def test_gaussian_noise_has_its_sigma_and_invalid_pixels_stay_invalid():
    depth, angle = _plane()
    depth[:, :50] = np.nan
    measured = _applied(Noise('gaussian', sigma=0.002), depth, angle)
    assert_array_equal(np.isnan(measured), np.isnan(depth))
    error = (measured - depth)[:, 50:]
    assert error.std() == pytest.approx(0.002, rel=0.02)
    assert abs(error.mean()) < 3e-5


@pytest.mark.parametrize('angle', [0.0, 1.2])
def test_kinect_noise_on_a_plane_has_the_axial_and_lateral_sigma(angle):
    depth, angles = _plane(0.8, angle)
    error = _applied(Noise('kinect'), depth, angles) - depth
    assert error.std() == pytest.approx(
        float(axial_sigma(np.array(0.8), np.array(angle))), rel=0.02)
    offsets = Noise('kinect').offsets(angles, np.random.default_rng(0))
    assert offsets.std() == pytest.approx(float(lateral_sigma(np.array(angle))), rel=0.02)


def test_three_in_ten_silhouette_pixels_fly_up_to_15_cm_behind():
    depth, angle = _plane(0.8)
    depth[50:150, 100:200] = np.nan
    error = _applied(Noise('kinect'), depth, angle) - depth
    edge = gap_behind(depth) > 0
    assert edge.sum() == 400
    flying = error[edge] > 0.01
    # uniform from 0 to 15 cm: 1 in 15 of those that fly goes less than 1 cm
    assert flying.mean() == pytest.approx(0.3 * 14 / 15, abs=0.07)
    assert 0.12 < error[edge].max() < 0.16
    assert np.nanmax(np.abs(error[~edge])) < 0.01


def test_flying_pixels_stay_between_the_two_surfaces():
    depth, angle = _plane(0.8)
    depth[:, 150:] = 0.85
    error = _applied(Noise('kinect'), depth, angle) - depth
    assert 0.03 < error[:, 149].max() < 0.06
    assert np.abs(error[:, 150:]).max() < 0.01


def test_a_slanted_surface_has_no_silhouette():
    depth = np.broadcast_to(np.linspace(0.5, 1.0, 300), SHAPE)
    assert not gap_behind(depth).any()


def test_outliers_are_that_share_of_the_valid_pixels_within_5_cm():
    depth, angle = _plane()
    depth[:, :100] = np.nan
    moved = _applied(Noise(outliers=0.1), depth, angle) - depth
    valid = ~np.isnan(depth)
    assert np.mean(moved[valid] != 0) == pytest.approx(0.1, abs=0.01)
    outliers = moved[valid & (moved != 0)]
    assert np.abs(outliers).max() <= 0.05
    assert outliers.std() == pytest.approx(0.05 / np.sqrt(3), rel=0.05)


def test_quantised_depths_are_whole_disparities_that_coarsen_with_the_square_of_the_depth():
    depth = np.linspace(0.5, 4.0, 5000)
    step = 0.125
    rounded = quantised(depth, FOCAL * 0.075, step)
    steps = FOCAL * 0.075 / rounded / step
    assert_allclose(steps, np.round(steps), atol=1e-9)
    # half a step of disparity is z^2 step / (2 f b) of depth
    bound = depth ** 2 * step / (2 * FOCAL * 0.075)
    assert (np.abs(rounded - depth) <= 1.1 * bound).all()
    assert np.abs(rounded - depth)[depth > 3.5].max() > 20 * np.abs(
        rounded - depth)[depth < 0.75].max()
    assert np.isnan(quantised(np.array([1000.0]), FOCAL * 0.075, step))


def test_the_same_seed_gives_the_same_noise():
    depth, angle = _plane()
    noise = Noise('kinect', outliers=0.05)
    assert_array_equal(_applied(noise, depth, angle, 1), _applied(noise, depth, angle, 1))
    assert (_applied(noise, depth, angle, 1) != _applied(noise, depth, angle, 2)).mean() > 0.99


def test_depths_that_noise_moves_behind_the_camera_are_invalid():
    depth, angle = _plane(0.001)
    measured = _applied(Noise('gaussian', sigma=0.01), depth, angle)
    assert np.isnan(measured).any()
    assert np.nanmin(measured) > 0


@pytest.mark.parametrize(('name', 'values'), [
    ('laser', {'kind': 'laser'}), ('sigma', {'sigma': -1.0}), ('sigma', {'sigma': np.nan}),
    ('outliers', {'outliers': 1.5}), ('disparity', {'disparity_step': -0.1}),
])
def test_values_out_of_range_are_refused_by_name(name, values):
    with pytest.raises(InputError, match=name):
        Noise(**values)
