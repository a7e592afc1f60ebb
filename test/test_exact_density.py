# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The density is what DESIGN says it is: against plain sums, formulas and finite differences."""
from math import pi

import numpy as np
import pytest
from scenes_for_tests import bumpy_views, plain_jet, plane_view, pose

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.exact_density import ExactDensity
from gr2t_ros.errors import InputError

H1, H3, QUADRATIC = 1.5, 0.004, 0.002


def lines_near(view, count, rng, spread):
    """Return origins, directions, distances of points within a few h3 of a view's surface."""
    v, u = np.nonzero(np.isfinite(view.depth))
    chosen = rng.choice(len(v), count, replace=False)
    v, u = v[chosen], u[chosen]
    ab1 = np.column_stack([view.camera.rays[v, u], np.ones(count)])
    T = view.T_world_camera
    directions = ab1 @ T[:3, :3].T + rng.normal(0, 0.05, (count, 3))
    distances = view.depth[v, u] + rng.normal(0, spread, count)
    return np.repeat(T[None, :3, 3], count, axis=0), directions, distances


def built(views, truncation):
    density = ExactDensity(H1, H3, QUADRATIC, truncation)
    for view in views:
        density.add(view)
    return density


def test_derivatives_equal_the_plain_sum_over_all_pixels():
    views = bumpy_views()
    density = built(views, truncation=11.0)  # e^-60: nothing is cut
    lines = lines_near(views[0], 60, np.random.default_rng(1), H3)
    f, f1, f2 = density.along(*lines)
    plain = np.array([plain_jet(views, H1, H3, QUADRATIC, *line) for line in zip(*lines)])
    near = plain[:, 0] > 1e-3 * plain[:, 0].max()
    assert near.sum() > 40
    np.testing.assert_allclose(f[near], plain[near, 0], rtol=1e-6)
    # derivatives change sign: their scale is f's over h3
    scale = plain[:, 0].max()
    np.testing.assert_allclose(f1, plain[:, 1], atol=1e-6 * scale / H3)
    np.testing.assert_allclose(f2, plain[:, 2], atol=1e-6 * scale / H3 ** 2)


def test_truncation_leaves_out_less_than_it_may():
    """A kernel cut at 4 bandwidths holds all but 6.3e-5 of its weight on each axis."""
    views = bumpy_views()
    lines = lines_near(views[0], 60, np.random.default_rng(2), H3)
    cut = np.array(built(views, truncation=4.0).along(*lines)).T
    same = np.array([
        plain_jet(views, H1, H3, QUADRATIC, *line, truncation=4.0) for line in zip(*lines)])
    whole = np.array([plain_jet(views, H1, H3, QUADRATIC, *line) for line in zip(*lines)])
    scale = whole[:, 0].max()
    # what it leaves out is what a plain sum with the same cut leaves out ...
    np.testing.assert_allclose(cut[:, 0], same[:, 0], atol=1e-6 * scale)
    # ... which is at most a pixel's kernel at 4 bandwidths for each pixel of the frame
    assert np.all(cut[:, 0] <= whole[:, 0] + 1e-6 * scale)
    assert np.max(whole[:, 0] - cut[:, 0]) < 1e-3 * scale
    assert np.max(np.abs(whole[:, 1] - cut[:, 1])) < 4e-3 * scale / H3


def test_derivatives_are_those_of_the_likelihood():
    views = bumpy_views()
    density = built(views, truncation=11.0)
    origins, directions, distances = lines_near(views[1], 30, np.random.default_rng(3), H3)
    _, f1, f2 = density.along(origins, directions, distances)
    step = 2e-5
    below, at, above = (
        density.along(origins, directions, distances + k * step) for k in (-1, 0, 1))
    scale = at[0].max()
    np.testing.assert_allclose(
        f1, (above[0] - below[0]) / (2 * step), atol=1e-4 * scale / H3)
    np.testing.assert_allclose(
        f2, (above[1] - below[1]) / (2 * step), atol=1e-3 * scale / H3 ** 2)


def test_a_frontal_plane_has_the_formula_s_likelihood():
    """On a wall seen head on the sum over pixels is an integral: lik = 1/(N sqrt(2 pi) h3)."""
    camera = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
    density = ExactDensity(2.0, 0.005, truncation=8.0)
    density.add(plane_view(camera, np.eye(4), [0, 0, 1], 0.8))
    offsets = np.array([-0.01, -0.004, 0.0, 0.004, 0.01])
    points = np.column_stack([np.full(5, 0.01), np.full(5, -0.02), 0.8 + offsets])
    expected = np.exp(-0.5 * (offsets / 0.005) ** 2) / (np.sqrt(2 * pi) * 0.005) / (64 * 48)
    np.testing.assert_allclose(density.likelihood(points), expected, rtol=1e-5)


def test_value_and_jet_agree_and_culling_loses_nothing():
    views = bumpy_views()
    density = built(views, truncation=4.0)
    for view in views:
        origins, directions, distances = lines_near(
            view, 200, np.random.default_rng(4), 3 * H3)
        f, _, _ = density.along(origins, directions, distances)
        points = origins + distances[:, None] * directions
        np.testing.assert_allclose(density.likelihood(points), f, rtol=1e-5, atol=1e-9 * f.max())


def test_windows_over_the_image_border_are_whole():
    views = bumpy_views()[:1]
    density = built(views, truncation=4.0)
    camera = views[0].camera
    pixels = np.array([(-5.9, 3), (64.5, 47), (0, -5.5), (63, 52.8), (-6.5, 10), (31, 54.2)])
    T = views[0].T_world_camera
    ab = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    directions = np.column_stack([ab, np.ones(len(ab))]) @ T[:3, :3].T
    # at the depth of the nearest pixel with one, so that the window's rim counts
    column, row = np.clip(np.round(pixels), 0, [63, 47]).astype(int).T
    depth = np.nan_to_num(views[0].depth, nan=0.5)[row, column].astype(float)
    origins = np.repeat(T[None, :3, 3], len(ab), axis=0)
    f, _, _ = density.along(origins, directions, depth)
    plain = [
        plain_jet(views, H1, H3, QUADRATIC, *line, truncation=4.0)[0]
        for line in zip(origins, directions, depth)]
    np.testing.assert_allclose(f, plain, rtol=2e-5)
    assert f[:4].min() >= 0 and f[4:].max() == 0


def test_a_map_far_from_the_origin_is_as_exact():
    views = bumpy_views()
    lines = lines_near(views[0], 50, np.random.default_rng(5), H3)
    near = built(views, 4.0).along(*lines)
    shift = np.array([4096.0, -2048.0, 512.0])
    moved = [
        type(view)(
            view.depth, view.camera,
            pose([0, 0, 0], shift) @ view.T_world_camera, view.stamp_ns) for view in views]
    far = built(moved, 4.0).along(lines[0] + shift, *lines[1:])
    np.testing.assert_allclose(far[0], near[0], rtol=1e-6, atol=1e-9 * near[0].max())


def test_invalid_pixels_and_empty_densities_contribute_nothing():
    density = ExactDensity(H1, H3)
    assert density.likelihood(np.zeros((2, 3))).tolist() == [0, 0]
    view = bumpy_views()[0]
    density.add(type(view)(
        np.full_like(view.depth, np.nan), view.camera, view.T_world_camera, 0))
    assert density.likelihood(np.array([[0, 0, 0.5], [0, 0, 1e9], [0, 0, -1]])).sum() == 0


def test_bandwidths_must_be_positive():
    with pytest.raises(InputError, match='bandwidth'):
        ExactDensity(0, 0.001)
