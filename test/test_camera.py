# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Rays and projections of every camera model, against OpenCV and finite differences."""
from __future__ import annotations

import cv2
import numpy as np
import pytest

from gr2t_ros.core.camera import Camera, project_jet
from gr2t_ros.errors import FrameError

SIZE = {'width': 160, 'height': 120, 'fx': 130.0, 'fy': 128.0, 'cx': 80.3, 'cy': 58.9}
K = np.array([[130.0, 0, 80.3], [0, 128.0, 58.9], [0, 0, 1]])

CAMERAS = {
    'pinhole': Camera(**SIZE),
    'plumb_bob': Camera(
        **SIZE, model='plumb_bob', distortion=(0.12, -0.21, 0.002, -0.001, 0.08)),
    # an Azure Kinect's depth camera
    'rational_polynomial': Camera(
        **SIZE, model='rational_polynomial',
        distortion=(1.94, 1.02, 0.0001, -0.00005, 0.053, 2.28, 1.53, 0.27)),
    'equidistant': Camera(
        **SIZE, model='equidistant', distortion=(-0.02, 0.003, -0.004, 0.001)),
}


def opencv(camera, points):
    """Project with OpenCV."""
    zero = np.zeros(3)
    shaped = np.ascontiguousarray(points).reshape(-1, 1, 3)
    if camera.model == 'equidistant':
        pixels, _ = cv2.fisheye.projectPoints(
            shaped, zero, zero, K, np.array(camera.distortion))
    else:
        pixels, _ = cv2.projectPoints(
            shaped, zero, zero, K, np.array(camera.distortion or (0.0,) * 5))
    return pixels.reshape(-1, 2)


def grid(camera):
    return np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1)


@pytest.mark.parametrize('name', CAMERAS)
def test_projections_are_opencvs(name):
    camera = CAMERAS[name]
    rng = np.random.default_rng(1)
    points = rng.uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (500, 3)) * rng.uniform(0.3, 5, (500, 1))
    points = np.vstack([points, [[0, 0, 1], [1e-4, 0, 1], [0, -1e-3, 1]]])
    np.testing.assert_allclose(camera.project(points), opencv(camera, points), atol=1e-8)


@pytest.mark.parametrize('name', CAMERAS)
def test_every_pixel_has_the_ray_that_projects_back_to_it(name):
    camera = CAMERAS[name]
    assert camera.rays.shape == (120, 160, 2) and not camera.rays.flags.writeable
    points = np.dstack([camera.rays, np.ones((120, 160))]).reshape(-1, 3)
    pixels = grid(camera).reshape(-1, 2)
    np.testing.assert_allclose(camera.project(2.5 * points), pixels, atol=1e-3)
    np.testing.assert_allclose(opencv(camera, 2.5 * points), pixels, atol=1e-3)


def test_a_pinhole_by_its_formula():
    camera = CAMERAS['pinhole']
    np.testing.assert_allclose(camera.rays[20, 30], [(30 - 80.3) / 130, (20 - 58.9) / 128])
    np.testing.assert_allclose(
        camera.project(np.array([[0.2, -0.1, 2]])), [[80.3 + 13, 58.9 - 6.4]])


def test_behind_the_camera_nothing_is_seen():
    for camera in CAMERAS.values():
        assert np.isnan(camera.project(np.array([[0, 0, -1.0], [0.1, 0.1, 0]]))).all()


def test_rays_are_nan_where_the_distortion_cannot_be_inverted():
    # its image radius reaches only 2/3 sqrt(5/9) = 0.5 focal lengths, then folds back
    camera = Camera(**SIZE, distortion=(-0.6, 0, 0, 0, 0))
    distance = np.linalg.norm((grid(camera) - [80.3, 58.9]) / [130, 128], axis=-1)
    assert np.isnan(camera.rays[distance > 0.52]).all()
    assert np.isfinite(camera.rays[distance < 0.45]).all()
    # and what folds back into the image is not seen there
    assert np.isnan(camera.project(np.array([[1.29, 0, 1.0]]))).all()


@pytest.mark.parametrize('name', CAMERAS)
def test_derivatives_along_a_line_are_finite_differences(name):
    camera = CAMERAS[name]
    rng = np.random.default_rng(2)
    lines = [(rng.uniform([-0.4, -0.3, 0.8], [0.4, 0.3, 1.5]), rng.normal(size=3) * 0.5)
             for _ in range(30)]
    # through the axis, and close by, where the fisheye needs a series
    lines += [(np.array([0, 0, 1.0]), np.array([0.3, -0.2, 0.1])),
              (np.array([2e-3, 1e-3, 1.0]), np.array([0.3, -0.2, 0.1])),
              (np.array([0.0, 3.3e-3, 1.0]), np.array([0.1, 0.2, 0.0]))]

    def jet(point, velocity, step):
        x, y, z = point + step * velocity
        seen, *values = project_jet(
            camera.parameters, x, velocity[0], y, velocity[1], z, velocity[2])
        assert seen
        return np.array(values).reshape(2, 3)

    for point, velocity in lines:
        here, h = jet(point, velocity, 0.0), 1e-5
        before, after = jet(point, velocity, -h), jet(point, velocity, h)
        np.testing.assert_allclose(
            here[:, 1], (after[:, 0] - before[:, 0]) / (2 * h), rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(
            here[:, 2], (after[:, 1] - before[:, 1]) / (2 * h), rtol=1e-4, atol=1e-3)


def from_info(**changed):
    given = {
        'width': 640, 'height': 480, 'K': [500, 0, 320, 0, 510, 240, 0, 0, 1],
        'D': [0.1, 0, 0, 0, 0], 'P': [450, 0, 310, 0, 0, 460, 230, 0, 0, 0, 1, 0],
        'model': 'plumb_bob', 'rectified': False, **changed}
    return Camera.from_camera_info(**given)


class TestFromCameraInfo:

    def test_raw_images_go_by_K_and_D(self):
        assert from_info() == Camera(640, 480, 500, 510, 320, 240, 'plumb_bob', (0.1, 0, 0, 0, 0))

    def test_rectified_ones_by_P_where_it_is_filled(self):
        assert from_info(rectified=True) == Camera(640, 480, 450, 460, 310, 230)
        assert from_info(rectified=True, P=[0] * 12) == Camera(640, 480, 500, 510, 320, 240)

    def test_a_region_sees_what_the_whole_image_sees_there(self):
        whole, part = from_info(), from_info(roi=(100, 50, 200, 160))
        assert (part.width, part.height) == (200, 160)
        np.testing.assert_allclose(part.rays, whole.rays[50:210, 100:300], atol=1e-6)

    def test_binning_divides_after_the_region(self):
        camera = from_info(roi=(100, 50, 200, 160), binning=(2, 4))
        assert (camera.width, camera.height) == (100, 40)
        assert (camera.fx, camera.fy) == (250, 127.5)
        assert (camera.cx, camera.cy) == (110, 47.5)
        assert from_info(binning=(0, 0)) == from_info()

    @pytest.mark.parametrize('focal', [0.0, -500.0, np.nan, np.inf])
    def test_an_uncalibrated_camera_is_refused(self, focal):
        with pytest.raises(FrameError, match='not calibrated') as error:
            from_info(K=[focal, 0, 320, 0, focal, 240, 0, 0, 1])
        assert error.value.reason == 'uncalibrated'

    @pytest.mark.parametrize(('model', 'D'), [
        ('thin_prism', [0.1]), ('equidistant', [0.1] * 5), ('plumb_bob', [0.1] * 8)])
    def test_an_unknown_distortion_is_refused(self, model, D):
        with pytest.raises(FrameError, match='publish a rectified image') as error:
            from_info(model=model, D=D)
        assert error.value.reason == 'distortion_model'

    def test_without_distortion_its_model_does_not_matter(self):
        for D in ([], [0.0] * 14):
            assert from_info(model='anything', D=D).project(
                np.array([[0, 0, 1.0]])).tolist() == [[320, 240]]
