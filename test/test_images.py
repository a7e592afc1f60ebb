# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""The newest keyframe as depth image, camera_info and images of how sure the depths are."""
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from scenes_for_tests import looking_at_origin, plane_view

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.reconstruction import Reconstruction
from gr2t_ros.core.view_mesh import view_mesh
from gr2t_ros.io import messages
from gr2t_ros.settings import Settings

pytest.importorskip('rclpy', reason='ROS 2 is not installed')

from rclpy.serialization import deserialize_message, serialize_message
from rclpy.time import Time
from ros_for_tests import Isolation, Observer
from sensor_msgs.msg import CameraInfo, Image

from gr2t_ros.ros.images import ImagePublishers, images
from gr2t_ros.ros.outputs import outputs_profile
from gr2t_ros.ros.timings import Timings

PINHOLE = Camera(49, 36, 45.0, 44.0, 23.5, 17.0)
DISTORTED = replace(PINHOLE, distortion=(0.05, -0.02, 0.001, -0.002, 0.01))
FISHEYE = replace(PINHOLE, model='equidistant', distortion=(0.02, -0.01, 0.0, 0.0))


def map_of(camera: Camera, stride: int) -> Reconstruction:
    """Return a map of one view with a hole."""
    view = plane_view(camera, looking_at_origin((0.2, 0.1, 1.0), 0.6), (0, 0, 1), 0.0)
    view.depth[10:20, 10:20] = np.nan
    reconstruction = Reconstruction(Settings(ray_stride=stride, density='exact'))
    reconstruction.add(replace(view, stamp_ns=1_234_567_890_123, frame_id='optical'))
    reconstruction.close()
    return reconstruction


@pytest.mark.parametrize('camera', [PINHOLE, DISTORTED, FISHEYE])
@pytest.mark.parametrize('stride', [1, 3])
def test_what_others_read_of_it(camera: Camera, stride: int) -> None:
    """Depths and rays are those of the marched pixels, also with a smaller image's camera."""
    reconstruction = map_of(camera, stride)
    keyframe, = reconstruction.keyframes
    sent = {
        topic: deserialize_message(serialize_message(message), type(message))
        for topic, message in images(keyframe, reconstruction.density, stride).items()}
    depth, info = sent['depth/image'], sent['depth/camera_info']
    assert sent.keys() == {
        'depth/image', 'depth/camera_info', 'likelihood/image', 'sigma/image', 'confidence/image'}
    for message in sent.values():
        assert Time.from_msg(message.header.stamp).nanoseconds == 1_234_567_890_123
        assert message.header.frame_id == 'optical'
    v, u = np.divmod(keyframe.rays.pixels[keyframe.rays.converged], camera.width)
    z = messages.depth(depth)
    assert z.shape == (-(-camera.height // stride), -(-camera.width // stride))
    expected = np.full(z.shape, np.nan, np.float32)
    expected[v // stride, u // stride] = keyframe.rays.depth[keyframe.rays.converged]
    assert 0.5 < np.isfinite(expected).mean() < 1
    np.testing.assert_array_equal(z, expected)
    likely, sigma, confidence = (
        messages.depth(sent[f'{name}/image']) for name in ('likelihood', 'sigma', 'confidence'))
    for image in (likely, sigma, confidence):
        assert (image[np.isfinite(z)] > 0).all() and np.isnan(image[np.isnan(z)]).all()
    mesh = view_mesh(reconstruction.density, keyframe.rays, camera.width, stride, 0.0, 0.0)
    np.testing.assert_array_equal(sigma[np.isfinite(z)], mesh.vertex_sigma)
    np.testing.assert_array_equal(confidence[np.isfinite(z)], mesh.vertex_confidence)
    read = messages.camera(info, rectified=False)
    np.testing.assert_allclose(read.rays, camera.rays[::stride, ::stride], atol=1e-7)
    np.testing.assert_array_equal(np.reshape(info.p, (3, 4))[:, :3].ravel(), info.k)


@pytest.fixture
def observer() -> Iterator[Observer]:
    """Return a node that publishes and listens."""
    observer = Observer(Isolation())
    yield observer
    observer.close()


def test_sent_when_something_is_new_to_a_listener(observer: Observer) -> None:
    reconstruction = map_of(PINHOLE, 1)
    outputs = ImagePublishers(observer.node, outputs_profile(1), Timings())
    outputs.change([0])
    assert not outputs.publish(reconstruction), 'nobody listens'
    for kind, topic in (
            (Image, 'depth/image'), (CameraInfo, 'depth/camera_info'),
            (Image, 'likelihood/image'), (Image, 'sigma/image'), (Image, 'confidence/image')):
        received = observer.collect(kind, f'observer/{topic}', outputs_profile(10))
        observer.spin_until(lambda: outputs.publish(reconstruction), 'the new listener')
        observer.spin_until(received.__len__, topic)
        assert not outputs.publish(reconstruction), 'nothing changed'
    outputs.change([0])
    assert outputs.publish(reconstruction)
    outputs.change([0])
    reconstruction.keyframes.append(reconstruction.keyframes[0])
    assert not outputs.publish(reconstruction), 'an older keyframe changed'
    assert not outputs.publish(Reconstruction(Settings()))
