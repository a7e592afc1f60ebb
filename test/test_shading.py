# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Triangles written out with their colours, lit or not."""
import numpy as np

from gr2t_ros.core.shading import triangle_corners

LIGHT = np.array([0.36, 0.48, 0.8])


def test_corners_and_brightness_of_each_face() -> None:
    """As numpy says it: from 45 % where a face looks away from the light to 100 % towards it."""
    rng = np.random.default_rng(3)
    vertices = rng.normal(size=(200, 3)) + 1e5  # far from the origin, as in UTM coordinates
    faces = rng.integers(0, 200, (500, 3)).astype(np.int32)
    faces[0] = faces[0, 0]  # no area
    colours = rng.integers(0, 256, (200, 3)).astype(np.uint8)
    points, pure = triangle_corners(vertices, faces, colours, shading=False)
    np.testing.assert_array_equal(points, vertices[faces.ravel()])
    np.testing.assert_array_equal(pure, colours[faces.ravel()])

    again, shaded = triangle_corners(vertices, faces, colours, shading=True)
    np.testing.assert_array_equal(again, points)
    a, b, c = points.reshape(-1, 3, 3).swapaxes(0, 1)
    normal = np.cross(b - a, c - a)
    length = np.maximum(np.linalg.norm(normal, axis=1), 1e-20)
    brightness = 0.45 + 0.55 / 2 * (1 + normal @ LIGHT / length)
    expected = pure * np.repeat(brightness, 3)[:, None]
    assert np.abs(shaded - expected).max() <= 1


def test_no_triangles() -> None:
    points, colours = triangle_corners(
        np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8), shading=True)
    assert points.shape == colours.shape == (0, 3)
