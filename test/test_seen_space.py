# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What depth images say of places before, at, behind and beside what they saw."""
from dataclasses import replace

import numpy as np
import pytest
from scenes_for_tests import CAMERAS, looking_at_origin, plane_view

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.seen_space import seen_images, SeenImage, Space, spaces
from gr2t_ros.core.view import View
from gr2t_ros.settings import Settings

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
ABOVE = looking_at_origin((0.01, 0, 1), 1.0)


def image(view: View, stride: int = 1) -> SeenImage:
    """Return a view's own depths; nothing is within range where they are NaN."""
    depth = view.depth[::stride, ::stride]
    camera = view.camera
    return SeenImage(
        np.where(np.isfinite(depth), depth, np.float32(np.inf)), stride, camera.parameters,
        np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2,
        view.T_world_camera, 2.0)


@pytest.mark.parametrize('camera', [CAMERA, *CAMERAS])
@pytest.mark.parametrize('stride', [1, 3])
def test_before_at_behind_and_beside_a_plane(camera: Camera, stride: int) -> None:
    view = plane_view(camera, ABOVE, (0, 0, 1), 0.0)
    points = np.array([
        (0, 0, 0.5), (0.1, 0.05, 0.1), (0, 0, 0.01), (0, 0, -0.1), (3, 0, 0.1), (0, 0, 1.5),
        (0, 0, -1.5)])
    found = spaces(points, [image(view, stride)], 0.05, 8)
    assert found.tolist() == [
        Space.FREE, Space.FREE, Space.SURFACE, Space.HIDDEN, Space.OUTSIDE, Space.OUTSIDE,
        Space.OUTSIDE]


def test_nothing_within_range_is_one_voice_among_others() -> None:
    """A place that many cameras have behind a surface is hidden; one that looked through wins."""
    wall = plane_view(CAMERA, ABOVE, (0, 0, 1), 0.0)
    nothing = replace(wall, depth=np.full_like(wall.depth, np.nan))
    far = plane_view(CAMERA, ABOVE, (0, 0, 1), -0.5)
    place = np.array([(0.0, 0.0, -0.2)])

    def known(*views: View) -> int:
        return int(spaces(place, [image(view) for view in views], 0.05, 8)[0])

    assert known(nothing) == Space.FREE
    assert known(nothing, *5 * [wall]) == Space.FREE
    assert known(nothing, *10 * [wall]) == Space.HIDDEN
    assert known(*10 * [wall], far) == Space.FREE
    doubtful = replace(image(wall), depth=np.full_like(wall.depth, np.nan))
    assert spaces(place, [doubtful], 0.05, 8)[0] == Space.OUTSIDE


def test_images_of_a_map_hold_what_is_sure() -> None:
    """A hole is empty, an outlier is doubtful, the rest is the denoised depth."""
    view = plane_view(CAMERA, ABOVE, (0, 0, 1), 0.0)
    view.depth[10:16, 12:18] = np.nan
    spoilt = replace(view, depth=view.depth.copy())
    spoilt.depth[30, 40] = 0.6
    reconstruction = Reconstruction(Settings(
        density='exact', ray_stride=2, start='observed', keyframe_translation=0.0))
    for each in (spoilt, view, view):
        reconstruction.add(each)
    reconstruction.keyframes[1].released = True
    found = seen_images(reconstruction)
    reconstruction.close()
    assert len(found) == 2 and found[0].stride == 2
    depth = found[0].depth
    assert depth.shape == (24, 32)
    assert np.isinf(depth[5:8, 6:9]).all() and np.isnan(depth[15, 20])
    rest = np.isfinite(depth)
    assert rest.mean() > 0.9
    np.testing.assert_allclose(depth[rest], view.depth[::2, ::2][rest], atol=1e-3)


def test_large_images_are_looked_at_coarsely() -> None:
    camera = Camera(400, 300, 400.0, 400.0, 199.5, 149.5)
    reconstruction = Reconstruction(Settings(ray_stride=2))
    reconstruction.add(plane_view(camera, ABOVE, (0, 0, 1), 0.0))
    found, = seen_images(reconstruction)
    reconstruction.close()
    assert found.stride == 4 and found.depth.shape == (75, 100)
    np.testing.assert_allclose(
        found.depth, reconstruction.keyframes[0].view.depth[::4, ::4], atol=2e-3)
