# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""What gr2t_node takes from live topics, and what it says of those that it cannot."""
from dataclasses import replace
from pathlib import Path
import re
import signal

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='ROS 2 is not installed')
pytest.importorskip('tf2_msgs', reason='tf2_msgs is not installed')

from diagnostic_msgs.msg import DiagnosticArray
from live_for_tests import (
    BEST_EFFORT,
    LiveCamera,
    mask_message,
    publish_static,
    RELIABLE,
)
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from ros_for_tests import (
    Isolation,
    LIMIT,
    NodeProcess,
    Observer,
    plane_views,
    START_NS,
    wait_until,
)
from scenes_for_tests import plane_view, pose
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger

from gr2t_ros.core.camera import Camera
from gr2t_ros.core.view import View
from gr2t_ros.io.formats import read
from gr2t_ros.tools.recorder import record

FRAMES = 4
FLAT = 0.01  # m from the plane; beside a border kernels are one-sided
PLAIN = ('-p', 'max_wait_for_pose:=10.0')


def wider(view: View) -> View:
    """Return what the same place shows to a camera with a shorter focal length."""
    camera = Camera(96, 72, 70.0, 70.0, 47.5, 35.5)
    again = plane_view(camera, view.T_world_camera, (0, 0, 1), 0.0)
    return replace(again, stamp_ns=view.stamp_ns + 10 ** 10)


def snapshot_is_flat(observer: Observer, node: NodeProcess) -> bool:
    """Tell whether there is a map; if so, it must be the plane."""
    if not observer.call(Trigger, 'save_snapshot').success:
        return False
    mesh = read(max(node.snapshots.iterdir(), key=lambda path: path.stat().st_mtime_ns))
    assert len(mesh.faces) > 100
    assert np.abs(mesh.vertices[:, 2]).max() < FLAT
    return True


@pytest.mark.parametrize(('source', 'encoding', 'compressed', 'profile'), [
    ('tf', '16UC1', True, RELIABLE),
    ('pose', '16UC1', False, BEST_EFFORT),
    ('pose_with_covariance', 'mono16', False, RELIABLE),
    ('odometry', '32FC1', False, BEST_EFFORT),
    ('transform', '32FC1', False, RELIABLE),
])
def test_each_pose_source_encoding_and_transport(
    isolation: Isolation, observer: Observer, tmp_path: Path, source: str, encoding: str,
    compressed: bool, profile: object,
) -> None:
    """
    The poses of odometry are of a base, from which /tf_static leads to the camera.

    Half of the publishers are there before the node. In the end the intrinsics change.
    """
    T_camera_base = np.eye(4)
    child = ''
    if source == 'odometry':
        child, T_camera_base = 'base', pose((0.3, 0.2, 0.1), (0.1, 0.2, 0.3))
        publish_static(observer, 'base', 'camera', np.linalg.inv(T_camera_base))

    def camera() -> LiveCamera:
        return LiveCamera(
            observer, source=source, encoding=encoding, compressed=compressed, profile=profile,
            child=child)

    live = camera() if profile is RELIABLE else None
    with NodeProcess(
            isolation, tmp_path, *PLAIN, '-p', f'pose_source:={source}', '-p',
            f'depth_transport:={"compressedDepth" if compressed else "raw"}', remap=()) as node:
        live = live or camera()
        views = plane_views(FRAMES)

        def delivered(views: list[View]) -> bool:
            """Publish all; some may be lost until the two sides have met."""
            for view in views:
                live.publish(view, T_camera_base)
            return snapshot_is_flat(observer, node)

        observer.spin_until(lambda: live.heard, 'subscribers')
        observer.spin_until(lambda: delivered(views), 'a snapshot')
        observer.call(Trigger, 'reset')
        observer.spin_until(
            lambda: delivered([wider(view) for view in views]), 'a snapshot by other intrinsics')
        assert node.stop() == 0
        if profile is RELIABLE:
            assert '/depth/camera_info: reliable, volatile, as its publishers are' in node.log
        else:
            assert 'as its publishers are' not in node.log


def test_two_cameras_build_one_map(
    isolation: Isolation, observer: Observer, tmp_path: Path
) -> None:
    """Each has its own topics, frame, size and counters."""
    cameras = {
        'front': LiveCamera(observer, '/front', frame='front'),
        'rear': LiveCamera(observer, '/rear', frame='rear', profile=BEST_EFFORT)}
    with NodeProcess(
            isolation, tmp_path, *PLAIN, '-p', 'cameras:=[front, rear]', '-p',
            'queue_size:=1000', remap=()) as node:
        views = {'front': plane_views(FRAMES), 'rear': [
            replace(plane_view(Camera(80, 60, 80.0, 80.0, 39.5, 29.5), view.T_world_camera,
                               (0, 0, 1), 0.0), stamp_ns=view.stamp_ns)
            for view in plane_views(FRAMES)]}
        observer.spin_until(lambda: all(item.heard for item in cameras.values()), 'subscribers')

        def delivered() -> bool:
            for i in range(FRAMES):
                for name, camera in cameras.items():
                    camera.publish(views[name][i])
            return snapshot_is_flat(observer, node) and keyframes() >= FRAMES

        def keyframes() -> int:
            path = max(node.snapshots.iterdir(), key=lambda path: path.stat().st_mtime_ns)
            return int(read(path).attributes['views'].max())

        observer.spin_until(delivered, 'keyframes of both cameras')
        assert node.stop() == 0
        for name in cameras:
            line = next(x for x in node.log.splitlines() if f'frames of {name}: ' in x)
            assert ' 0 dropped' in line and ' 0 integrated' not in line
        assert '/front/depth/image: reliable, volatile, as its publishers are' in node.log
        assert '/rear/depth/image: reliable' not in node.log


def test_wrong_topic_names_are_explained_once(
    isolation: Isolation, observer: Observer, tmp_path: Path
) -> None:
    """The warning names what was asked for, and what there is."""
    LiveCamera(observer, '/my_camera', source='')
    publish_static(observer, 'base', 'camera', np.eye(4))
    states = observer.collect(DiagnosticArray, '/diagnostics', QoSProfile(depth=10))
    with NodeProcess(isolation, tmp_path, remap=()) as node:
        log = node.wait_for('ROS_DOMAIN_ID')
        assert 'nothing came for 5 s on /depth/camera_info, /depth/image' in log
        observer.spin_until(
            lambda: states and 'nobody publishes it' in deserialize_message(
                states[-1], DiagnosticArray).status[0].message, 'the same in the diagnostics')
        for words in (
                '/depth/image (sensor_msgs/msg/Image): nobody publishes it',
                '-r depth/image:=/my_camera/depth/image',
                '-r depth/camera_info:=/my_camera/depth/camera_info',
                'frames that tf knows: base, camera'):
            assert words in log
        assert node.stop() == 0
        assert node.log.count('nothing came for') == 1


def test_an_offer_that_cannot_be_taken_and_a_wrong_world_are_explained(
    isolation: Isolation, observer: Observer, tmp_path: Path
) -> None:
    """Both sides' QoS; the frames that there are."""
    deaf = LiveCamera(observer, source='tf', profile=BEST_EFFORT)
    with NodeProcess(
            isolation, tmp_path, '-p', 'input_qos:=reliable', '-p', 'world_frame:=mpa',
            '-p', 'max_wait_for_pose:=0.2', remap=()) as node:
        log = node.wait_for(
            '/depth/image: /observer offers best effort, volatile, but reliable, volatile is '
            'asked for: none of its messages can come; set input_qos to auto or best_effort')
        log = node.wait_for('nothing came for 5 s')
        assert 'published by /observer (best effort, volatile), asked for reliable' in log
        live = LiveCamera(observer, source='tf')
        observer.spin_until(lambda: live.heard, 'subscribers')
        for view in plane_views(2):
            live.publish(view)
        log = node.wait_for('[unconnected_frames: said once')
        assert 'tf does not know mpa, only camera, map; publish it or set world_frame to map' \
            in log
        assert deaf is not None and node.stop() == 0
        assert node.log.count('offers best effort') == 2


def test_masks_hide_pixels(
    isolation: Isolation, observer: Observer, tmp_path: Path
) -> None:
    """A mask is of the image with its stamp; one of another size is said and counted."""
    live = LiveCamera(observer)
    masks = observer.node.create_publisher(Image, '/depth/mask', RELIABLE)
    with NodeProcess(
            isolation, tmp_path, '-p', 'use_mask:=true', '-p', 'queue_size:=1000', remap=()
    ) as node:
        observer.spin_until(
            lambda: live.heard and masks.get_subscription_count(), 'subscribers')
        left = np.zeros((72, 96), np.uint8)
        left[:, :64] = 255
        view = plane_views(1)[0]

        def delivered() -> bool:
            live.publish(view)
            masks.publish(mask_message(left, view.stamp_ns))
            return snapshot_is_flat(observer, node)

        observer.spin_until(delivered, 'a snapshot')
        path = max(node.snapshots.iterdir(), key=lambda path: path.stat().st_mtime_ns)
        seen = (read(path).vertices - view.T_world_camera[:3, 3]) @ view.T_world_camera[:3, :3]
        assert view.camera.project(seen)[:, 0].min() > 62  # but for a voxel's width
        later = replace(view, stamp_ns=view.stamp_ns + 10 ** 9)
        live.publish(later)
        masks.publish(mask_message(left[:9], later.stamp_ns))
        log = node.wait_for('[mask_size: said once')
        assert 'the mask is 96x9 pixels, but the depth image 96x72' in log
        live.publish(replace(view, stamp_ns=view.stamp_ns + 2 * 10 ** 9))
        node.wait_for('[no_mask: said once')
        assert node.stop() == 0
        assert 'no_mask 1' in node.log


def test_a_recording_that_loops(isolation: Isolation, tmp_path: Path) -> None:
    """With /clock and without: the map is emptied where asked, and goes on."""
    bag = tmp_path / 'plane'
    record(bag, [
        replace(view, stamp_ns=START_NS + i * 500_000_000)
        for i, view in enumerate(plane_views(9))])
    for clock in (True, False):
        with NodeProcess(
                isolation, tmp_path / str(clock), '-p', f'use_sim_time:={clock}', '-p',
                f'reset_on_time_jump:={clock}') as node:
            player = isolation.run(
                'gr2t_ros.ros.bag_player', bag, '--rate', 5, '--loop',
                *(['--clock'] if clock else []))
            try:
                log = node.wait_for('the clock went back to 1700000000')
                wait_until(lambda: node.log.count('the clock went back to') >= 2, 'another time')
            finally:
                player.send_signal(signal.SIGINT)
                assert player.wait(LIMIT) == 130
            assert ('the map is emptied' if clock else 'the map stays') in log
            assert node.stop() == 0
            received, integrated = re.search(
                r'frames: (\d+) received, (\d+) integrated', node.log).groups()
            assert int(received) >= 19
            assert int(integrated) >= int(received) - 6, node.log
