# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Messages that no driver should send, over DDS: the node counts them and goes on."""
from __future__ import annotations

from array import array
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
import re
import struct
from typing import Any
import zlib

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy', reason='ROS 2 is not installed')
pytest.importorskip('tf2_msgs', reason='tf2_msgs is not installed')

from live_for_tests import LiveCamera, pose_message, stamped  # noqa: E402
from ros_for_tests import Isolation, NodeProcess, Observer, plane_views  # noqa: E402
from sensor_msgs.msg import CameraInfo, CompressedImage  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from gr2t_ros.core.view import View  # noqa: E402
from gr2t_ros.io.messages import MAX_BYTES  # noqa: E402

S = 1_000_000_000
NOISE = bytes(range(256)) * 4  # no message of any type


def png(width: int, height: int, data: bytes) -> bytes:
    """Return a compressedDepth image of 16 bits with that size in its header."""
    chunks = ((b'IHDR', struct.pack('>IIBBBBB', width, height, 16, 0, 0, 0, 0)),
              (b'IDAT', zlib.compress(data)), (b'IEND', b''))
    return bytes(12) + b'\x89PNG\r\n\x1a\n' + b''.join(
        struct.pack('>I', len(content)) + name + content
        + struct.pack('>I', zlib.crc32(name + content)) for name, content in chunks)


class Rig:
    """A node, a camera that is in order, and what else is published on its topics."""

    def __init__(self, observer: Observer, node: NodeProcess, live: LiveCamera) -> None:
        self.observer, self.node, self.live = observer, node, live
        self.count = 0

    def view(self) -> View:
        """Return a view with the next stamp, and publish its pose and camera_info."""
        self.count += 1
        view = plane_views(20)[self.count % 20]
        return replace(view, stamp_ns=view.stamp_ns // S * S + self.count * S // 10)

    def begin(self) -> None:
        """Publish frames that are in order until the map begins."""
        def begun() -> bool:
            self.live.publish(self.view())
            followed = re.findall(r'/depth/\S+: reliable, volatile, as its', self.node.log)
            return 'the map begins' in self.node.log and len(followed) == 2

        self.observer.spin_until(lambda: self.live.heard, 'subscribers')
        self.observer.spin_until(begun, 'the first frame')
        self.observer.call(Trigger, 'timing')  # what was sent before has come

    @property
    def integrated(self) -> int:
        """Return how many frames are in the map."""
        states = self.observer.call(Trigger, 'timing').message
        return int(re.search(r'(\d+) integrated', states)[1])

    def bad(self, reason: str, change: Callable[[Any], Any]) -> None:
        """Publish an image with something changed; wait until it is counted."""
        view = self.view()
        self.live.publish_pose(view)
        message = change(self.live.image_message(view))
        self.live.images.publish(message)
        self.counts(reason)

    def counts(self, reason: str) -> None:
        """Wait until a reason was said."""
        self.observer.spin_until(
            lambda: f'[{reason}: said once' in self.node.log,
            f'{reason} in the log:\n{self.node.log}')


def fields(**values: Any) -> Callable[[Any], Any]:
    """Return what sets fields of a message."""
    def change(message: Any) -> Any:
        for name, value in values.items():
            setattr(message, name, value)
        return message
    return change


def restamped(stamp: Callable[[int], int]) -> Callable[[Any], Any]:
    """Return what changes a message's seconds."""
    def change(message: Any) -> Any:
        message.header.stamp.sec = stamp(message.header.stamp.sec)
        return message
    return change


def test_images_camera_infos_and_transforms(
    isolation: Isolation, observer: Observer, tmp_path: Path
) -> None:
    live = LiveCamera(observer, encoding='32FC1')
    with NodeProcess(isolation, tmp_path, '-p', 'max_wait_for_pose:=1.0', remap=()) as node:
        rig = Rig(observer, node, live)
        rig.begin()

        rig.bad('image_size', fields(step=3))
        rig.bad('image_size', fields(data=array('B', bytes(10))))
        rig.bad('image_size', fields(height=0, width=0, step=0, data=array('B')))
        rig.bad('image_size', fields(height=0xffffffff, width=0xffffffff))
        rig.bad('image_size', fields(height=60_000, width=60_000, step=240_000))
        rig.bad('image_size', fields(data=array('B', bytes(MAX_BYTES + 1))))
        rig.bad('encoding', fields(encoding='x' * 10_000))
        rig.bad('no_valid_depth', lambda message: fields(
            data=array('B', b'\xff' * len(message.data)))(message))
        rig.bad('bad_stamp', restamped(lambda _: -5))
        rig.bad('no_pose', restamped(lambda sec: sec + 3600))
        rig.bad('time_jump', restamped(lambda sec: sec - 3600))

        for k in (
                [np.nan] * 9, [0.0] * 9, [-90.0, 0, 47.5, 0, -90.0, 35.5, 0, 0, 1],
                [1e-9, 0, 47.5, 0, 1e-9, 35.5, 0, 0, 1]):
            view = rig.view()
            live.publish_pose(view)
            live.infos.publish(stamped(
                CameraInfo(height=72, width=96, k=[float(x) for x in k]), 'camera',
                view.stamp_ns))
            live.images.publish(live.image_message(view))
        rig.counts('uncalibrated')

        for T in (np.full((4, 4), np.nan), np.diag([1e300] * 3 + [1.0])):
            view = rig.view()
            message = pose_message('tf', 'map', 'camera', view.stamp_ns, np.eye(4))
            message.transforms[0].transform.translation.x = float(T[0, 0])
            live.poses.publish(message)
            live.infos.publish(live.info_message(view))
            live.images.publish(live.image_message(view))
        rig.counts('bad_pose')
        view = rig.view()
        message = pose_message('tf', 'map', 'camera', view.stamp_ns, np.eye(4))
        message.transforms[0].transform.rotation.w = 0.0
        live.poses.publish(message)
        for number in range(50):
            message.transforms[0].child_frame_id = str(number) * 1000
            message.transforms[0].header.frame_id = ''
            live.poses.publish(message)
        rig.counts('bad_transform')

        for publisher in (live.images, live.infos, live.poses):
            for noise in (b'\x00', b'\x00\x01\x00\x00', NOISE, b'\x00\x01\x00\x00' + NOISE):
                publisher.publish(noise)

        before = rig.integrated
        live.publish(rig.view())
        live.publish(rig.view(), frame='')  # its frame is that of camera_info
        observer.spin_until(
            lambda: rig.integrated == before + 2, 'the frames that are in order')
        assert node.stop() == 0
        assert 'failed:' not in node.log
        assert 'Traceback' not in node.log


def test_compressed_images_and_poses(
    isolation: Isolation, observer: Observer, tmp_path: Path
) -> None:
    live = LiveCamera(observer, source='pose', compressed=True)
    with NodeProcess(
            isolation, tmp_path, '-p', 'max_wait_for_pose:=1.0', '-p', 'pose_source:=pose', '-p',
            'depth_transport:=compressedDepth', remap=()) as node:
        rig = Rig(observer, node, live)
        rig.begin()

        def data(content: bytes, form: str = '16UC1; compressedDepth png') -> Any:
            def change(message: CompressedImage) -> CompressedImage:
                return fields(data=array('B', content), format=form)(message)
            return change

        rvl = '16UC1; compressedDepth rvl'
        rig.bad('image_size', data(png(30_000, 30_000, bytes(100))))
        rig.bad('image_size', data(png(5000, 5000, bytes(100))))
        rig.bad('no_valid_depth', data(png(96, 72, bytes(100_000_000))))
        rig.bad('damaged_image', data(b''))
        rig.bad('damaged_image', data(NOISE))
        rig.bad('damaged_image', data(png(96, 72, bytes(96 * 72 * 2))[:60]))
        rig.bad('image_size', data(bytes(12) + struct.pack('<II', 0xffffffff, 0xffffffff), rvl))
        rig.bad('damaged_image', data(bytes(12) + struct.pack('<II', 96, 72) + NOISE, rvl))
        rig.bad('encoding', data(NOISE, 'y' * 10_000))
        view = rig.view()
        message = pose_message('pose', 'map', '', view.stamp_ns, view.T_world_camera)
        message.pose.orientation.w = message.pose.position.x = float('nan')
        live.poses.publish(message)
        live.images.publish(live.image_message(view))
        rig.counts('bad_pose')
        before = rig.integrated
        live.publish(rig.view())
        observer.spin_until(
            lambda: rig.integrated == before + 1, 'the frame that is in order')
        assert node.stop() == 0
        assert 'failed:' not in node.log
        assert 'Traceback' not in node.log
