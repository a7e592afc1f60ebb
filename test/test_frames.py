# Copyright 2026 The gr2t_ros developers
# SPDX-License-Identifier: Apache-2.0
"""Images find their camera and their pose, or are counted with a sentence that helps."""
from __future__ import annotations

import struct

import cv2
from frames_for_tests import assembler, at, DEPTH, depth, lost, move, MS, S, settled
from messages_for_tests import camera_info, compressed
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from gr2t_ros.core.poses import inverse
from gr2t_ros.io import frames as frames_module
from gr2t_ros.io import messages
from gr2t_ros.io.frames import FrameAssembler
from gr2t_ros.settings import Settings


class TestWaiting:

    def test_too_many_drop_the_oldest(self):
        frames = assembler(max_waiting=3)
        for i in range(5):
            frames.on_depth(depth(i * 10 * MS))
        assert frames.waiting == 3 and frames.dropped == {'unconnected_frames': 2}
        assert 'given up with 3 later images waiting' in frames.explanations['unconnected_frames']
        move(frames, 0, 100 * MS)
        assert [view.stamp_ns for view in frames.ready()] == [20 * MS, 30 * MS, 40 * MS]

    def test_those_that_have_their_pose_are_not_among_them(self):
        frames = assembler(max_waiting=2)
        move(frames, 0, 100 * MS)
        for i in range(5):
            frames.on_depth(depth(i * 10 * MS))
        assert len(frames.ready()) == 5

    def test_too_long_drops_live_images(self):
        frames = assembler(max_wait_for_pose=1.0)
        frames.on_depth(depth(0), received_ns=50 * S)
        frames.on_depth(depth(10 * MS), received_ns=50 * S + 900 * MS)
        assert frames.ready(now_ns=51 * S) == [] and frames.waiting == 2
        assert frames.ready(now_ns=51 * S + MS) == [] and frames.waiting == 1
        frames.on_depth(depth(20 * MS), received_ns=52 * S)
        frames.ready()
        assert frames.waiting == 1 and frames.dropped == {'unconnected_frames': 2}
        assert 'given up after max_wait_for_pose (1 s)' in \
            frames.explanations['unconnected_frames']

    def test_images_of_a_recording_wait_for_late_tf(self):
        frames = assembler(max_waiting=1000, max_wait_for_pose=0.1)
        for i in range(200):
            frames.on_depth(depth(i * 33 * MS))
            assert frames.ready() == []
        move(frames, *range(0, 7 * S, 10 * MS))
        assert len(frames.ready()) == 200


class TestCameraInfo:

    def pair(self, **options):
        frames = assembler(info=False, **options)
        move(frames, *range(0, 10 * S, 100 * MS))
        return frames

    def test_an_image_waits_for_it(self):
        frames = self.pair()
        frames.on_depth(depth(0))
        assert frames.ready() == []
        frames.on_camera_info(camera_info(stamp_ns=S))
        assert len(frames.ready()) == 1

    def test_stamps_need_not_be_equal_and_the_object_stays_the_same(self):
        frames = self.pair()
        for i in range(3):
            frames.on_camera_info(camera_info(stamp_ns=i * S))
            frames.on_depth(depth(i * S + 300 * MS))
        first, *others = frames.ready()
        assert all(view.camera is first.camera for view in others) and len(others) == 2

    def test_a_change_of_intrinsics_is_taken_from_its_stamp_on(self):
        frames = self.pair()
        frames.on_camera_info(camera_info(stamp_ns=S))
        frames.on_depth(depth(1900 * MS))
        frames.on_depth(depth(2 * S))
        frames.on_camera_info(camera_info(stamp_ns=2 * S, focal=20.0))
        frames.on_depth(depth(2100 * MS))
        assert [view.camera.fx for view in frames.ready()] == [10, 20, 20]
        frames.on_camera_info(camera_info(16, 12, stamp_ns=3 * S, focal=30.0))
        frames.on_depth(depth(3 * S, np.full((12, 16), 1500, np.uint16)))
        assert frames.ready()[0].camera.fx == 30

    def test_of_another_size(self):
        frames = self.pair()
        frames.on_camera_info(camera_info(16, 12))
        frames.on_depth(depth(0))
        assert lost(frames, 'image_size').startswith(
            'depth image is 8x6 pixels, but its camera_info is for 16x12')

    def test_of_another_frame(self):
        frames = self.pair()
        frames.on_camera_info(camera_info(frame='colour'))
        frames.on_depth(depth(0))
        assert 'images are of frame camera, but camera_info only of colour' in lost(
            frames, 'no_camera_info')

    def test_none_at_all(self):
        frames = self.pair()
        frames.on_depth(depth(0))
        assert 'no camera_info has been received' in lost(frames, 'no_camera_info')

    def test_nameless_frames_go_with_any(self):
        frames = self.pair()
        frames.on_camera_info(camera_info(frame=''))
        frames.on_depth(depth(0))
        assert len(frames.ready()) == 1
        frames = self.pair()
        frames.on_camera_info(camera_info())
        frames.on_depth(depth(0, frame=''))
        assert len(frames.ready()) == 1
        frames = self.pair()
        frames.on_camera_info(camera_info(frame=''))
        frames.on_depth(depth(0, frame=''))
        assert 'frame_id' in lost(frames, 'no_frame_id')

    def test_uncalibrated_until_it_is(self):
        frames = self.pair()
        frames.on_camera_info(camera_info(focal=0.0))
        frames.on_depth(depth(0))
        assert 'not calibrated' in lost(frames, 'uncalibrated')
        frames.on_camera_info(camera_info())
        frames.on_depth(depth(0))
        assert len(frames.ready()) == 1

    def test_a_rectified_image_has_the_rectified_camera(self):
        frames = self.pair(rectified=True)
        info = camera_info(focal=20.0)
        info.k = camera_info(focal=10.0).k
        frames.on_camera_info(info)
        frames.on_depth(depth(0))
        assert frames.ready()[0].camera.fx == 20


class TestDepth:

    def one(self, pixels, **fields):
        frames = assembler()
        move(frames, 0)
        frames.on_depth(depth(0, np.asarray(pixels), **fields))
        return frames

    def test_depths_out_of_range_are_invalid(self):
        pixels = np.full((6, 8), 1000, np.uint16)
        pixels[0, :4] = 99, 100, 5000, 5001
        view, = self.one(pixels).ready()
        np.testing.assert_array_equal(
            view.depth[0, :4], np.array([np.nan, 0.1, 5, np.nan], np.float32))

    def test_without_any_valid_pixel(self):
        sentence = lost(self.one(np.zeros((6, 8), np.uint16)), 'no_valid_depth')
        assert sentence == 'depth image has no valid pixel'
        sentence = lost(self.one(np.full((6, 8), 7000, np.uint16)), 'no_valid_depth')
        assert 'depth_max 5 m; their median is 7 m' in sentence

    @pytest.mark.parametrize(('pixels', 'encoding'), [
        (np.full((6, 8), 1234, np.float32), '32FC1'), (np.full((6, 8), 2, np.uint16), '16UC1')])
    def test_a_unit_taken_wrongly_is_said(self, pixels, encoding):
        frames = self.one(pixels, encoding=encoding)
        assert '32FC1 in metres' in lost(frames, 'depth_unit')

    def test_unusable_messages_are_counted_and_the_rest_goes_on(self):
        frames = self.one(DEPTH, encoding='rgb8')
        frames.on_depth(depth(0, step=3))
        frames.on_depth(compressed('jpeg', b''))
        frames.on_depth(depth(0))
        assert len(settled(frames)) == 1
        assert frames.dropped == {'encoding': 2, 'image_size': 1}
        assert "'rgb8'" in frames.explanations['encoding']

    def test_an_image_that_comes_twice_is_used_once(self):
        frames = self.one(DEPTH)
        move(frames, 100 * MS)
        for stamp_ns in (50 * MS, 40 * MS, 50 * MS, 40 * MS):
            frames.on_depth(depth(stamp_ns))
        assert [view.stamp_ns for view in frames.ready()] == [0, 50 * MS, 40 * MS]
        assert frames.dropped == {'duplicate': 2}
        assert 'came a second time' in frames.explanations['duplicate']

    def test_a_loop_is_no_duplicate(self):
        frames = assembler()
        move(frames, 0, 500 * MS)
        for stamp_ns in (0, 200 * MS, 400 * MS, 0, 200 * MS, 400 * MS):
            frames.on_depth(depth(stamp_ns))
        assert len(settled(frames)) == 6

    @pytest.mark.parametrize('stamp_ns', [-1, -(1 << 31) * S, (1 << 31) * S])
    def test_stamps_that_no_clock_has(self, stamp_ns):
        frames = assembler()
        move(frames, 0)
        frames.on_depth(depth(stamp_ns))
        assert 'writes wrong headers' in lost(frames, 'bad_stamp')

    def test_large_images_of_another_size_are_not_even_decoded(self, monkeypatch):
        monkeypatch.setattr(messages, 'depth', None)
        frames = assembler()
        frames.on_depth(depth(0, height=5000, width=5000, step=10000))
        header = struct.pack('>8s I4s IIBBBBB', b'\x89PNG\r\n\x1a\n', 13, b'IHDR', 5000, 5000,
                             16, 0, 0, 0, 0)
        frames.on_depth(compressed('16UC1; compressedDepth png', bytes(12) + header))
        frames.on_depth(compressed(
            '16UC1; compressedDepth rvl', bytes(12) + struct.pack('<II', 5000, 5000)))
        assert '5000x5000 pixels, but its camera_info is for 8x6' in lost(
            frames, 'image_size', 3)

    def test_of_huge_images_fewer_wait(self, monkeypatch):
        monkeypatch.setattr(frames_module, '_MAX_BYTES', 3 * DEPTH.size * 4)
        frames = assembler(max_waiting=10)
        for i in range(5):
            frames.on_depth(depth(i * 10 * MS))
        assert frames.waiting == 3

    def test_compressed_images(self):
        frames = assembler()
        move(frames, 0)
        png = bytes(12) + cv2.imencode('.png', DEPTH)[1].tobytes()
        frames.on_depth(compressed('16UC1; compressedDepth png', png))
        np.testing.assert_allclose(frames.ready()[0].depth, 1.5)


def test_a_recording_gives_the_depths_and_poses_that_it_was_made_of(data):
    frames = assembler(max_waiting=100, rectified=True, info=False)
    views = []
    with AnyReader([data / 'bags' / 'kitchen_sweep']) as reader:
        for connection, _, raw in reader.messages():
            msg = reader.deserialize(raw, connection.msgtype)
            if connection.msgtype.endswith('Image'):
                frames.on_depth(msg)
            elif connection.msgtype.endswith('CameraInfo'):
                frames.on_camera_info(msg)
            else:
                frames.world.on_transforms(msg, connection.topic == '/tf_static')
            views += frames.ready()
            if len(views) == 10:
                break
    assert frames.world.frame == 'map' and not frames.dropped
    assert not frames.explanations and not frames.world.explanations
    original = data / 'real_rgbd' / 'redkitchen'
    for i, view in enumerate(views):
        name = f'frame-{10 * i:06}'
        pixels = cv2.imread(str(original / f'{name}.depth.png'), cv2.IMREAD_UNCHANGED)
        metres = pixels / 1000
        valid = (pixels < 65535) & (metres >= 0.1) & (metres <= 5)
        np.testing.assert_array_equal(np.isfinite(view.depth), valid)
        np.testing.assert_allclose(view.depth[valid], metres[valid], rtol=1e-6)
        # its rotations are of length 1 to four digits
        T_world_camera = np.loadtxt(original / f'{name}.pose.txt')
        np.testing.assert_allclose(view.T_world_camera, T_world_camera, atol=1e-4)
        assert view.camera.fx == 585


def test_rclpy_messages_do():
    """The same code serves the live node."""
    sensor = pytest.importorskip('sensor_msgs.msg')
    geometry = pytest.importorskip('geometry_msgs.msg')
    frames = FrameAssembler(Settings(pose_source='pose'), rectified=False)
    info = sensor.CameraInfo(
        width=8, height=6, distortion_model='plumb_bob', k=[9.0, 0, 4, 0, 9, 3, 0, 0, 1])
    info.header.frame_id = 'camera'
    frames.on_camera_info(info)
    at_pose = geometry.PoseStamped()
    at_pose.header.frame_id = 'map'
    at_pose.pose.position.x = 2.0
    frames.on_pose(at_pose)
    msg = sensor.Image(width=8, height=6, encoding='16UC1', step=16)
    msg.header.frame_id = 'camera'
    msg.data = DEPTH.tobytes()
    frames.on_depth(msg, received_ns=0)
    view, = frames.ready(now_ns=1)
    np.testing.assert_array_equal(inverse(view.T_world_camera), at(-2))
    assert view.camera.fx == 9
